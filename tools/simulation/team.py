"""Several robots in one building: who is where by one clock, and what each records."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from frontend.records import FloatArray
from tools.simulation.driving import Driving
from tools.simulation.laser import LMS200, LaserModel
from tools.simulation.log import Journey, SimulatedLog, record, travel
from tools.simulation.odometry import OdometryNoise
from tools.simulation.plan import FloorPlan, SimulationError

COLOURS = ("red", "blue", "green", "orange", "purple", "brown", "pink", "olive")


def robot_names(count: int) -> list[str]:
    """red, blue, ...; beyond the colours robot09, robot10, ..."""
    return [COLOURS[i] if i < len(COLOURS) else f"robot{i + 1:02d}" for i in range(count)]


@dataclass(frozen=True, slots=True)
class TeamRobot:
    """One robot of a team.

    Attributes:
        name: of the robot and of the route it drives.
        start: team time of its first scan, seconds.
        clock: what its own clock says then, seconds.
        seed: of its log.
        journey: where it is, by seconds since its start.
    """

    name: str
    start: float
    clock: float
    seed: int
    journey: Journey

    @property
    def end(self) -> float:
        """Team time of its last scan."""
        return self.start + float(self.journey.scan_times[-1])

    def at(self, times: FloatArray) -> FloatArray:
        """(T, 3) plan_T_robot at team times; before its start and after its end it stands there."""
        return self.journey.at(times - self.start)


@dataclass(frozen=True, slots=True)
class SimulatedTeam:
    """Robots in a building; they neither know nor dodge each other."""

    plan: FloorPlan
    robots: tuple[TeamRobot, ...]
    laser: LaserModel

    def log(self, robot: TeamRobot) -> Iterator[SimulatedLog]:
        """What the robot records by its own clock, piece by piece; the other robots are in the laser's way."""
        times = robot.start + robot.journey.scan_times
        bodies = bodies_at([other for other in self.robots if other is not robot], times)
        return record(self.plan, robot.journey, self.laser, robot.seed, start_time=robot.clock, others=bodies)

    def nearest(self) -> tuple[float, float, str, str]:
        """Metres between the centres of the two robots that come nearest to each other, when, and who."""
        best = (np.inf, 0.0, "", "")
        for i, robot in enumerate(self.robots):
            times = robot.start + robot.journey.times
            at = robot.at(times)[:, :2]
            for other in self.robots[i + 1 :]:
                apart = np.hypot(*(other.at(times)[:, :2] - at).T)
                closest = int(np.argmin(apart))
                if apart[closest] < best[0]:
                    best = (float(apart[closest]), float(times[closest]), robot.name, other.name)
        return best


def bodies_at(robots: list[TeamRobot], times: FloatArray) -> FloatArray:
    """(T, K, 2) where the robots are at team times, in the plan's frame."""
    if not robots:
        return np.empty((len(times), 0, 2))
    return np.stack([robot.at(times)[:, :2] for robot in robots], axis=1)


def simulate_team(
    plan: FloorPlan,
    routes: list[str],
    laser: LaserModel = LMS200,
    noise: OdometryNoise = OdometryNoise(),  # noqa: B008 (frozen)
    seed: int = 0,
    *,
    driving: Driving = Driving(),  # noqa: B008 (frozen)
    start_every: float = 0.0,
    seconds: float = np.inf,
) -> SimulatedTeam:
    """Drives one robot along each of the routes; it is named like its route.

    Args:
        plan: the building.
        routes: names of routes of it.
        laser: every robot's scanner.
        noise: the odometry's errors; each robot has its own.
        seed: of everything random, 0 or above.
        driving: how the robots are driven.
        start_every: each robot starts this much later than the one before it, seconds.
        seconds: no robot drives for longer than this.

    Raises:
        SimulationError: a route is unknown, comes twice or cannot be driven.
    """
    if len(set(routes)) < len(routes):
        raise SimulationError(f"plan {plan.name!r}: two robots on one route: {', '.join(sorted(routes))}")
    seeds = np.random.SeedSequence(seed).generate_state(len(routes)).tolist()
    clocks = 1e9 + np.random.default_rng(np.random.SeedSequence((seed, 1))).integers(0, 10**8, len(routes)) / 1000
    robots = []
    for i, route in enumerate(routes):
        journey = travel(plan, route, laser.rate, noise, seeds[i], driving=driving).until(seconds)
        robots.append(TeamRobot(route, round(i * start_every, 3), float(clocks[i]), seeds[i], journey))
    return SimulatedTeam(plan, tuple(robots), laser)


def divided(plan: FloorPlan, route: str, names: list[str], overlap: float = 0.4) -> FloorPlan:
    """The plan with one route of it dealt out: each name gets a section, every second one in reverse.

    So neighbours meet, and see a part of the building twice.

    Args:
        plan: the building.
        route: name of a route of it; one that ends where it starts is dealt out as a ring.
        names: of the new routes, which replace all others.
        overlap: of a section with the next, as a fraction of its length.

    Raises:
        SimulationError: the route is unknown or has fewer than two waypoints.
    """
    points = plan.route(route)
    if len(points) < 2:
        raise SimulationError(f"plan {plan.name!r}, route {route!r}: needs two waypoints")
    closed = bool(np.hypot(*(points[0] - points[-1])[:2]) < 1e-6)
    whole = np.vstack((points, points[1:])) if closed and len(names) > 1 else points
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(whole[:, :2], axis=0).T))))
    length = along[len(points) - 1] / len(names)
    routes = {}
    for i, name in enumerate(names):
        begin, end = i * length, min((i + 1 + overlap) * length, along[-1])
        inside = whole[(along > begin + 0.3) & (along < end - 0.3)]
        ends = np.column_stack([np.interp((begin, end), along, whole[:, axis]) for axis in (0, 1)])
        section = np.vstack(((*ends[0], 0.0), inside, (*ends[1], 0.0)))
        routes[name] = [tuple(point[: 2 + (point[2] > 0)]) for point in section[:: -1 if i % 2 else 1].tolist()]
    return FloorPlan(plan.name, plan.walls, plan.boxes, plan.circles, routes)
