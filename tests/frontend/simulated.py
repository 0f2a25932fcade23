"""What the tests of the front end's core share: rooms, scans taken in them, and maps drawn of those scans."""

from functools import lru_cache

import numpy as np

from frontend import grid, se2
from frontend.grid import Maps
from frontend.parameters import FilterParameters
from frontend.points import Points, points_of
from frontend.records import FloatArray, LaserScan
from tools.simulation import LMS200, FloorPlan, LaserModel, SimulatedLog, simulate
from tools.simulation.laser import measure

WIDTH = 16.0
RESOLUTION = 0.05
PARAMETERS = FilterParameters(particles=8, map_width=WIDTH, resolution=RESOLUTION)

# No two places or directions of it look alike.
ROOM = FloorPlan(
    "room",
    [(-4, -3, 5, -3), (5, -3, 5, 2), (5, 2, 2, 2), (2, 2, 2, 4), (2, 4, -4, 4), (-4, 4, -4, -3)],
    boxes=[(2.0, -1.0, 0.6, 0.9, 0.3), (-2.0, 2.2, 0.8, 0.5, 0.0)],
    circles=[(-2.5, -1.5, 0.3)],
    routes={"tour": [(-3.0, 0.2), (0.5, 0.5), (0.8, 3.0), (0.5, 0.5), (3.5, 1.0), (4.0, -2.0), (-1.0, -2.0)]},
)
CORRIDOR = FloorPlan("corridor", [(-60, -1.1, 60, -1.1), (-60, 1.1, 60, 1.1)])


def scan_of(ranges: FloatArray, laser: LaserModel = LMS200) -> LaserScan:
    """A scan with these ranges, odometry at the origin."""
    return LaserScan(0.0, np.asarray(ranges, np.float32), np.zeros(3), laser.record())


def look(plan: FloorPlan, poses: FloatArray, laser: LaserModel = LMS200, sensing_range: float = 25.0) -> list[Points]:
    """What a robot sees from each of the poses (n, 3), with the laser's noise."""
    ranges = measure(laser, plan.segments, poses, np.random.default_rng(0))
    return [points_of(scan_of(r, laser), sensing_range, 181) for r in ranges]


def insert(maps: Maps, points: Points, pose: FloatArray) -> None:
    """Add a scan to map 0 of a stack."""
    maps.counts[0] = grid.insert(
        *maps.layers(0)[:3], maps.counts[0], maps.touched[0], maps.resolution,
        pose, points.hits, points.clear, points.sensor,
    )  # fmt: skip


def drawn(points: list[Points], poses: FloatArray, width: float = WIDTH) -> Maps:
    """A map (a stack of one) of scans at known poses."""
    maps = Maps.empty(1, width, RESOLUTION)
    for scan, pose in zip(points, poses, strict=True):
        insert(maps, scan, pose)
    return maps


@lru_cache(maxsize=1)
def room() -> tuple[FloatArray, list[Points], Maps]:
    """Poses all over ROOM, what is seen from them, and the map of that; not to be changed."""
    steps = np.arange(20, dtype=np.float64)
    poses = np.column_stack((np.linspace(-3.0, 1.5, 20), 0.5 * np.sin(steps), se2.wrap(0.7 * steps)))
    points = look(ROOM, poses)
    return poses, points, drawn(points, poses)


@lru_cache(maxsize=1)
def drive() -> tuple[SimulatedLog, list[Points], FloatArray]:
    """A drive through ROOM: the log, its scans as points, the odometry increments (n, 3); not to be changed."""
    log = simulate(ROOM, "tour", seed=5)
    points = [points_of(scan, 25.0, 181) for scan in log.scans()]
    increments = np.vstack((np.zeros(3), se2.between(log.odometry[:-1], log.odometry[1:])))
    return log, points, increments
