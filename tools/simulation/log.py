"""The simulator: plan, route, laser and noise in, a log with its truth out."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from frontend.records import FloatArray, LaserScan
from tools.simulation.driving import Driving, drive
from tools.simulation.laser import LMS200, LaserModel, measure
from tools.simulation.odometry import OdometryNoise, dead_reckon
from tools.simulation.plan import FloorPlan

WHEEL_RATE = 20.0  # wheel readings a second, at least
CHUNK = 1000  # scans computed at a time


@dataclass(frozen=True, slots=True)
class SimulatedLog:
    """N scans and their truth.

    Attributes:
        times: (N,) seconds, rising.
        odometry: (N, 3) odom_T_robot, the first at the origin.
        poses: (N, 3) plan_T_robot: the truth.
        ranges: (N, B) metres, inf where nothing was seen.
        laser: the scanner.
    """

    times: FloatArray
    odometry: FloatArray
    poses: FloatArray
    ranges: npt.NDArray[np.float32]
    laser: LaserModel

    def scans(self) -> Iterator[LaserScan]:
        """The log as a reader would give it."""
        laser = self.laser.record()
        for time, ranges, odometry in zip(self.times, self.ranges, self.odometry, strict=True):
            yield LaserScan(float(time), ranges, odometry, laser)


def simulate(
    plan: FloorPlan,
    route: str,
    laser: LaserModel = LMS200,
    noise: OdometryNoise = OdometryNoise(),  # noqa: B008 (frozen)
    seed: int = 0,
    *,
    driving: Driving = Driving(),  # noqa: B008 (frozen)
    laps: int = 1,
    hours: float = 0.0,
    start_time: float = 1e9,
) -> SimulatedLog:
    """Drives the route and records it; the whole log in memory. See ``stream``."""
    parts = list(
        stream(plan, route, laser, noise, seed, driving=driving, laps=laps, hours=hours, start_time=start_time)
    )
    return SimulatedLog(
        np.concatenate([part.times for part in parts]),
        np.concatenate([part.odometry for part in parts]),
        np.concatenate([part.poses for part in parts]),
        np.concatenate([part.ranges for part in parts]),
        laser,
    )


def stream(
    plan: FloorPlan,
    route: str,
    laser: LaserModel = LMS200,
    noise: OdometryNoise = OdometryNoise(),  # noqa: B008 (frozen)
    seed: int = 0,
    *,
    driving: Driving = Driving(),  # noqa: B008 (frozen)
    laps: int = 1,
    hours: float = 0.0,
    start_time: float = 1e9,
) -> Iterator[SimulatedLog]:
    """Drives the route and records it, piece by piece: a day of scans need not fit in memory.

    Path, odometry and laser draw from generators of their own: another laser sees the same drive.

    Args:
        plan: the building.
        route: name of a route of it.
        laser: the scanner.
        noise: the odometry's errors.
        seed: of everything random, 0 or above.
        driving: how the robot is driven.
        laps: times the route is driven.
        hours: as many laps as fill about this time, if that is more.
        start_time: seconds, the log's clock at the first scan.

    Raises:
        SimulationError: the route is unknown or cannot be driven.
    """
    path_rng, wheel_rng, laser_rng = (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3))
    steps = max(1, int(np.ceil(WHEEL_RATE / laser.rate)))
    times, poses = drive(plan, route, driving, laser.rate * steps, path_rng, laps, hours)
    odometry = dead_reckon(times, poses, noise, wheel_rng)
    times = np.round(start_time + times[::steps], 6)
    poses, odometry = poses[::steps].copy(), odometry[::steps].copy()
    for begin in range(0, len(times), CHUNK):
        chunk = slice(begin, begin + CHUNK)
        ranges = measure(laser, plan.segments, poses[chunk], laser_rng)
        yield SimulatedLog(times[chunk], odometry[chunk], poses[chunk], ranges, laser)
