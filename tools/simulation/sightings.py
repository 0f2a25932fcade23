"""Which robot sees which, when, and what it believes to see: true and false sightings, and their CSV."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from frontend.records import FloatArray
from tools.simulation.laser import BODY
from tools.simulation.plan import SimulationError
from tools.simulation.poses import between, compose, wrapped
from tools.simulation.raycast import cast, shade
from tools.simulation.team import SimulatedTeam, TeamRobot, bodies_at

HEADER = "time,observer,observed,range,bearing,heading,sigma_range,sigma_bearing,sigma_heading"


@dataclass(frozen=True)
class SightingModel:
    """A sensor that recognises other robots, in the laser's field of view.

    Attributes:
        max_range: metres.
        rate: sightings a second of a robot that stays in view.
        sigma_range: standard deviation, metres.
        sigma_bearing: the same, radians.
        sigma_heading: the same, radians; None if the sensor does not tell the other's heading.
        false_share: of all sightings, how many show a robot that is not there, 0 to below 1.
    """

    max_range: float = 8.0
    rate: float = 1.0
    sigma_range: float = 0.05
    sigma_bearing: float = 0.02
    sigma_heading: float | None = 0.05
    false_share: float = 0.0


@dataclass(frozen=True, slots=True)
class SimulatedSighting:
    """``observer`` believes to see ``observed``: range, bearing, heading of observer_T_observed.

    ``time`` is team time, ``sigmas`` those of range, bearing and heading; ``heading`` and its sigma may be None.
    """

    time: float
    observer: str
    observed: str
    range: float
    bearing: float
    heading: float | None
    sigmas: tuple[float, float, float | None]

    def row(self) -> str:
        """The line of the CSV."""
        heading = "" if self.heading is None else f"{self.heading:.5f}"
        sigmas = ",".join("" if sigma is None else f"{sigma:g}" for sigma in self.sigmas)
        return f"{self.time:.3f},{self.observer},{self.observed},{self.range:.4f},{self.bearing:.5f},{heading},{sigmas}"


def write_sightings(sightings: Iterable[SimulatedSighting], path: Path) -> None:
    """Writes them as a team session has them, in the given order."""
    path.write_text("\n".join([HEADER, *(sighting.row() for sighting in sightings)]) + "\n", encoding="ascii")


def in_order(sightings: Iterable[SimulatedSighting]) -> list[SimulatedSighting]:
    """By time, then by name."""
    return sorted(sightings, key=lambda sighting: (sighting.time, sighting.observer, sighting.observed, sighting.range))


def true_sightings(team: SimulatedTeam, model: SightingModel, seed: int) -> list[SimulatedSighting]:
    """All that robots see of each other, in order.

    A robot looks ``rate`` times a second from its first scan to its last, and sees others that run, whose centre is
    within range, ahead of its laser, and not behind a wall, furniture or another robot.
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, 2)))
    found: list[SimulatedSighting] = []
    for observer in team.robots:
        looks = np.arange(int((observer.end - observer.start) * model.rate) + 1)
        times = np.round(observer.start + looks / model.rate, 3)
        times = times[times <= observer.end]
        for observed in team.robots:
            if observed is not observer:
                at = times[(times >= observed.start) & (times <= observed.end)]
                found += _seen(team, model, observer, observed, at, rng)
    return in_order(found)


def _seen(
    team: SimulatedTeam,
    model: SightingModel,
    observer: TeamRobot,
    observed: TeamRobot,
    times: FloatArray,
    rng: np.random.Generator,
) -> list[SimulatedSighting]:
    truth = between(observer.at(times), observed.at(times))
    away = np.hypot(truth[:, 0], truth[:, 1])
    near = (away <= model.max_range) & (away > 2 * BODY)
    times, truth = times[near], truth[near]
    clear = in_sight(team, observer, observed, times)
    times, truth = times[clear], truth[clear]
    return sightings_of((observer.name, observed.name), times, noisy(truth, model, rng), model)


def noisy(relative: FloatArray, model: SightingModel, rng: np.random.Generator) -> FloatArray:
    """(T, 3) range, bearing and heading as measured of true observer_T_observed (T, 3)."""
    noise = rng.standard_normal((len(relative), 3)) * (model.sigma_range, model.sigma_bearing, model.sigma_heading or 0)
    ranges = np.maximum(np.hypot(relative[:, 0], relative[:, 1]) + noise[:, 0], 0.01)
    bearings = wrapped(np.arctan2(relative[:, 1], relative[:, 0]) + noise[:, 1])
    return np.column_stack((ranges, bearings, wrapped(relative[:, 2] + noise[:, 2])))


def in_sight(
    team: SimulatedTeam, observer: TeamRobot, observed: TeamRobot, times: FloatArray
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """(T,) whether the observer's laser could meet the other's centre at team times, however far it is."""
    if not len(times):
        return np.empty(0, dtype=np.bool_)
    laser = team.laser
    eyes = compose(observer.at(times), np.array(laser.mount))
    centres = observed.at(times)[:, :2]
    ways = centres - eyes[:, :2]
    away, directions = np.hypot(ways[:, 0], ways[:, 1]), np.arctan2(ways[:, 1], ways[:, 0])
    bearings = wrapped(directions - eyes[:, 2])
    last = laser.first + laser.step * (laser.beams - 1)
    rays = np.column_stack((eyes[:, :2], directions))
    reach = cast(team.plan.segments, rays, 0.0, 1.0, 1, float(away.max()))
    others = [robot for robot in team.robots if robot is not observer and robot is not observed]
    shade(reach, bodies_at(others, times), BODY, rays, 0.0, 1.0)
    return np.asarray((bearings >= laser.first) & (bearings <= last) & (reach[:, 0] > away))


def false_sightings(
    spans: dict[str, tuple[float, float]],
    model: SightingModel,
    true: int,
    rng: np.random.Generator,
    *,
    bearings: tuple[float, float] = (-math.pi / 2, math.pi / 2),
) -> list[SimulatedSighting]:
    """Robots that are not there: anybody sees anybody anywhere, at any time at which both run. In order.

    Args:
        spans: first and last team time of each robot.
        model: of the sensor; its ``false_share`` is that of the session when these are added.
        true: number of the sightings that they are added to.
        rng: draws pair, time, range, bearing and heading, each uniformly.
        bearings: lowest and highest, radians.

    Raises:
        SimulationError: the share is not in [0, 1), or no two robots run at the same time.
    """
    if not 0 <= model.false_share < 1:
        raise SimulationError(f"share of false sightings {model.false_share:g}: must be 0 or more and below 1")
    count = round(true * model.false_share / (1 - model.false_share))
    pairs = [(a, b) for a in spans for b in spans if a != b and _common(spans[a], spans[b])]
    if count and not pairs:
        raise SimulationError("no two robots run at the same time: there is nothing to see, not even falsely")
    found: list[SimulatedSighting] = []
    for _ in range(count):
        a, b = pairs[rng.integers(len(pairs))]
        overlap = max(spans[a][0], spans[b][0]), min(spans[a][1], spans[b][1])
        low = (overlap[0], 2 * BODY, bearings[0], -np.pi)
        high = (overlap[1], model.max_range, bearings[1], np.pi)
        time, away, bearing, heading = rng.uniform(low, high)[:, None]
        found += sightings_of((a, b), time, np.stack((away, bearing, heading), axis=1), model)
    return in_order(found)


def _common(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return max(a[0], b[0]) < min(a[1], b[1])


def sightings_of(
    pair: tuple[str, str], times: FloatArray, measured: FloatArray, model: SightingModel
) -> list[SimulatedSighting]:
    """As the sensor reports them.

    Args:
        pair: observer and observed.
        times: (T,) team times.
        measured: (T, 3) range, bearing, heading.
        model: of the sensor.
    """
    sigmas = (model.sigma_range, model.sigma_bearing, model.sigma_heading)
    return [
        SimulatedSighting(time, *pair, away, bearing, None if model.sigma_heading is None else heading, sigmas)
        for time, (away, bearing, heading) in zip(times.tolist(), measured.tolist(), strict=True)
    ]
