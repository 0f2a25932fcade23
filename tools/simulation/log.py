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
from tools.simulation.poses import between, compose, exponential, logarithm

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
    journey = travel(plan, route, laser.rate, noise, seed, driving=driving, laps=laps, hours=hours)
    yield from record(plan, journey, laser, seed, start_time=start_time)


@dataclass(frozen=True, slots=True)
class Journey:
    """Where a robot is and what its wheels say, M times, evenly spaced and dense.

    Attributes:
        times: (M,) seconds from 0.
        poses: (M, 3) plan_T_robot: the truth.
        odometry: (M, 3) odom_T_robot, the first at the origin.
        every: each how-manieth of them comes with a scan.
    """

    times: FloatArray
    poses: FloatArray
    odometry: FloatArray
    every: int

    @property
    def scan_times(self) -> FloatArray:
        """(N,) seconds from 0."""
        return self.times[:: self.every]

    def until(self, seconds: float) -> "Journey":
        """Its beginning, with one scan at least."""
        count = max(1, int(np.searchsorted(self.times, seconds, side="right")))
        return Journey(self.times[:count], self.poses[:count], self.odometry[:count], self.every)

    def at(self, times: FloatArray) -> FloatArray:
        """(T, 3) plan_T_robot at these times; the robot stands at its ends before and after."""
        clipped = np.clip(times, 0.0, self.times[-1])
        before = np.clip(np.searchsorted(self.times, clipped, side="right") - 1, 0, max(0, len(self.times) - 2))
        after = np.minimum(before + 1, len(self.times) - 1)
        spans = self.times[after] - self.times[before]
        fraction = np.divide(clipped - self.times[before], spans, out=np.zeros(len(clipped)), where=spans > 0)
        motion = logarithm(between(self.poses[before], self.poses[after]))
        return compose(self.poses[before], exponential(motion * fraction[:, None]))


def travel(
    plan: FloorPlan,
    route: str,
    rate: float,
    noise: OdometryNoise,
    seed: int,
    *,
    driving: Driving = Driving(),  # noqa: B008 (frozen)
    laps: int = 1,
    hours: float = 0.0,
) -> Journey:
    """Drives the route with ``rate`` scans a second; other arguments and errors as in ``stream``."""
    path_rng, wheel_rng, _ = _generators(seed)
    steps = max(1, int(np.ceil(WHEEL_RATE / rate)))
    times, poses = drive(plan, route, driving, rate * steps, path_rng, laps, hours)
    return Journey(times, poses, dead_reckon(times, poses, noise, wheel_rng), steps)


def record(
    plan: FloorPlan,
    journey: Journey,
    laser: LaserModel,
    seed: int,
    *,
    start_time: float,
    others: FloatArray | None = None,
) -> Iterator[SimulatedLog]:
    """What the laser sees on the journey, piece by piece.

    Args:
        plan: the building.
        journey: with the laser's rate.
        laser: the scanner.
        seed: that of the journey.
        start_time: seconds, the log's clock at the first scan.
        others: (N, K, 2) where other robots are at the time of each scan, in the plan's frame.
    """
    laser_rng = _generators(seed)[2]
    times = np.round(start_time + journey.scan_times, 6)
    poses, odometry = (values[:: journey.every].copy() for values in (journey.poses, journey.odometry))
    for begin in range(0, len(times), CHUNK):
        chunk = slice(begin, begin + CHUNK)
        around = None if others is None else others[chunk]
        ranges = measure(laser, plan.segments, poses[chunk], laser_rng, around)
        yield SimulatedLog(times[chunk], odometry[chunk], poses[chunk], ranges, laser)


def _generators(seed: int) -> list[np.random.Generator]:
    """Of the path, the wheels and the laser."""
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3)]
