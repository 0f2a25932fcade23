"""Small simulated logs whose truth is known, and the small configuration that maps them in about a second."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np

from frontend import se2
from frontend.records import FloatArray, LaserScan
from mrtm.config import Config, load_config
from mrtm.evaluation import Statistics, TimedPoses, evaluate_ate
from mrtm.result import RunResult
from mrtm.session import map_scans
from tools.honesty.runs import VERTEX, Sample, samples_of
from tools.simulation import LMS200, FloorPlan, LaserModel, OdometryNoise, SimulatedLog, loop, office, simulate
from tools.simulation.construction import shell, wall

SIDE = 8.0
"""Width of the travel square of ``small``, metres."""

NOISE = OdometryNoise()


def small(*options: str) -> Config:
    """Few particles and small squares: a vertex every few metres."""
    frontend = {"particles": 10, "travel_square": SIDE, "sensing_range": 10, "map_width": 32}
    return load_config(options=[*(f"frontend.{key}={value}" for key, value in frontend.items()), *options])


@cache
def ring(laps: int = 1, seed: int = 1, noise: OdometryNoise = NOISE) -> SimulatedLog:
    """Around a ring of plain corridors, 33 m a lap, 190 scans."""
    return simulate(loop(1, 16.0, 14.0), "ring", LMS200, noise, seed, laps=laps)


@cache
def office_ring(laps: int = 1, seed: int = 1, laser: LaserModel = LMS200) -> SimulatedLog:
    """Around an office floor, 44 m a lap, 270 scans; the rooms behind the doors make no two places alike."""
    return simulate(office(1, 24.0, 20.0), "ring", laser, seed=seed, laps=laps)


@cache
def there_and_back() -> SimulatedLog:
    """Along two sides of the office ring and back the same way."""
    plan = office(1, 24.0, 20.0)
    start, corner, end = plan.routes["ring"][:3]
    return simulate(replace(plan, routes={"back": [start, corner, end, corner, start]}), "back", seed=1)


@cache
def hotel_visit(seed: int, slips: float) -> SimulatedLog:
    """Into five rooms that are exactly alike, 4 m apart along a corridor, and back into three of them."""
    rooms, pitch = 5, 4.0
    walls = shell(rooms * pitch, 6.0) + wall(
        (0, 4.0), (rooms * pitch, 4.0), [((i + 0.5) * pitch,) for i in range(rooms)]
    )
    for i in range(1, rooms):
        walls += wall((i * pitch, 0.0), (i * pitch, 4.0))
    boxes: list[tuple[float, ...]] = [(i * pitch + 0.6, 1.2, 0.6, 1.6, 0.0) for i in range(rooms)]
    route: list[tuple[float, ...]] = [(1.0, 5.0)]
    for room in (0, 1, 2, 3, 4, 4.5, 4, 2, 0):
        x = (room + 0.5) * pitch - 1.0 * (room == 4.5)  # 4.5 is the corridor's end
        route += [(x, 5.0)] if room == 4.5 else [(x, 5.0), (x, 3.2), (x, 2.0, 1.0), (x, 3.2), (x, 5.0)]
    plan = FloorPlan("hotel", walls, boxes, routes={"visit": [*route, (1.0, 5.0)]})
    return simulate(plan, "visit", noise=OdometryNoise(slips_per_minute=slips), seed=seed)


@cache
def room(laser: LaserModel = LMS200, laps: int = 2) -> SimulatedLog:
    """Rounds in one furnished room, smaller than a travel square."""
    plan = FloorPlan(
        "room",
        shell(8.0, 7.0),
        boxes=[(0.6, 2.0, 0.8, 1.5, 0.0), (7.2, 5.5, 1.0, 0.6, 0.3), (3.0, 6.5, 2.0, 0.7, 0.0)],
        circles=[(4.0, 3.4, 0.3)],
        routes={"rounds": [(2.5, 1.8), (5.8, 1.8), (5.8, 4.9), (2.5, 4.9), (2.5, 1.8)]},
    )
    return simulate(plan, "rounds", laser, seed=3, laps=laps)


def jumped(log: SimulatedLog, at: int, jump: tuple[float, float, float]) -> SimulatedLog:
    """The odometry's frame moves: ``jump`` is added, robot frame, to the increment that leads to scan ``at``."""
    odometry = log.odometry.copy()
    start = se2.compose(odometry[at - 1], np.array(jump))
    odometry[at:] = se2.compose(start, se2.between(odometry[at - 1], odometry[at:]))
    return replace(log, odometry=odometry)


def kidnapped(log: SimulatedLog, at: int, back: int) -> SimulatedLog:
    """The robot is carried from where it is at scan ``at`` to where it is at scan ``back``; its wheels stand still."""
    kept = np.r_[0:at, back : len(log.times)]
    odometry = log.odometry.copy()
    odometry[back:] = se2.compose(odometry[at - 1], se2.between(odometry[back], odometry[back:]))
    return SimulatedLog(log.times[: len(kept)], odometry[kept], log.poses[kept], log.ranges[kept], log.laser)


def mapped(log: SimulatedLog, config: Config | None = None, scans: Iterable[LaserScan] | None = None) -> RunResult:
    """The run over a log, or over ``scans`` made from it."""
    return map_scans(log.scans() if scans is None else scans, config or small())


def poses(result: RunResult) -> FloatArray:
    """(n, 3) joint_T_robot of the run's only robot."""
    (trajectory,) = result.trajectories.values()
    return trajectory.poses


def errors(log: SimulatedLog, result: RunResult, part: slice = slice(None)) -> Statistics:
    """Metres between true and estimated positions, in a part of the log that is aligned by itself."""
    estimate = poses(result)
    times = np.arange(len(estimate), dtype=np.float64)[part]  # of no matter: a clock that steps is no error of the map
    truth = {"robot": TimedPoses(times, log.poses[: len(estimate)][part])}
    return evaluate_ate(truth, {"robot": TimedPoses(times, estimate[part])}, max_gap=2.0).translation


def edge_errors(log: SimulatedLog, result: RunResult) -> list[Sample]:
    """Every version of every edge that ever was in the graph, against its truth."""
    return [sample for sample in samples_of(result, log.poses, "", 0) if sample.kind != VERTEX]


def false_edges(log: SimulatedLog, result: RunResult) -> list[str]:
    """Edges that are wrong, not just inexact."""
    return [f"{e.name}: {e.distance:.2f} m off" for e in edge_errors(log, result) if e.is_false]
