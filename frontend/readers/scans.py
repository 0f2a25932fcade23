"""From what one line of a log says to a ``LaserScan`` and its sightings: the checks and rules every format shares."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np
import numpy.typing as npt

from frontend.errors import LogError
from frontend.readers.continuity import Continuity
from frontend.readers.report import Report
from frontend.readers.tags import find_tags
from frontend.records import FloatArray, Laser, LaserScan, Sighting

Record = LaserScan | Sighting

# A reading this far is no wall of a building: 81.83 or 81.91 m of a SICK LMS in its 80 m mode, 50 m of many loggers.
FARTHEST_WALL = 50.0
# The top codes of a SICK LMS telegram mean "no return"; with 13, 14 and 15 bits in millimetres these are, in metres:
SICK_NO_RETURN = ((8.18, 8.195), (16.37, 16.385), (32.755, 32.77))
FARTHEST_ODOMETRY = 1e6
LATEST = 1e12
# More beams are no laser's; what is held back at the start is bounded by this.
MOST_BEAMS = 1 << 13
# Scans held back at the start, to learn the mount and the no-return reading from more than one of them.
FIRST_LOOK = (100, 1000)
TURN_TO_TELL = 0.2
SAME_MOUNT = (2e-3, 2e-3)
FARTHEST_MOUNT = 3.0


@dataclass(frozen=True, slots=True)
class RawScan:
    """A scan as its line gives it.

    Attributes:
        laser: the laser's name in the log.
        line: line number.
        time: seconds.
        ranges: (B,) metres, unmasked.
        odometry: (3,) odom_T_robot.
        start, step: bearing of the first beam and between beams, laser frame, radians.
        laser_pose: (3,) pose of the laser in the frame of the odometry, as the line claims; None if it has none.
        mount: gives (3,) robot_T_laser as the log's parameters have it.
        declared_max: range at which the log says the laser ends, metres; None if it does not say.
        bright: (B,) beams that came back from a reflective tag; None if the laser cannot tell.
    """

    laser: str
    line: int
    time: float
    ranges: FloatArray
    odometry: FloatArray
    start: float
    step: float
    laser_pose: FloatArray | None
    mount: Callable[[], FloatArray]
    declared_max: float | None
    bright: npt.NDArray[np.bool_] | None = None


def assemble(raw: Iterable[RawScan], report: Report) -> Iterator[Record]:
    """Turn the raw scans of one laser into laser scans, in file order, each followed by the sightings in it.

    Skipped and counted: a scan with odometry or time that is not finite, and one that repeats the scan before it.
    Odometry that jumps farther than a robot can drive is counted, and goes on from where it was.
    The first scans (100, or up to 1000 until the robot has turned by 0.2 rad) are held back to settle two things:

    - The mount is the laser's pose seen from the robot's, if the lines give both, the difference is the same in
      all the first scans, and it is not zero; else what the log's parameters say. Some logs give a corrected
      trajectory in place of the laser's pose: it does not stay constant when the robot turns. If the robot does
      not turn in the first scans, only a laser on the robot's axis that looks straight ahead or back is believed.
    - A reading counts as "nothing hit" from the least of: 50 m; what the log declares, unless readings between
      that and 50 m prove it wrong; the top codes of a SICK LMS (8.18, 16.37, 32.76 m), if the largest reading
      is one.

    Args:
        raw: scans of one laser.
        report: filled on the way.

    Raises:
        LogError: the number of beams or their bearings change on the way.
    """
    scans = _usable(raw, report)
    first = _first_look(scans)
    if not first:
        return
    beams, start, step = len(first[0].ranges), first[0].start, first[0].step
    angles: FloatArray = start + step * np.arange(beams, dtype=np.float64)
    max_range = _no_return_range(first)
    laser = Laser(angles=angles, mount=_mount(first), max_range=max_range)
    report.laser = (
        f"{first[0].laser}, {beams} beams from {np.degrees(angles[0]):.4g} to {np.degrees(angles[-1]):.4g} deg, "
        f"nothing hit from {max_range:g} m, mounted at ({', '.join(f'{v:.4g}' for v in laser.mount)})"
    )
    previous = first[0].time
    continuity = Continuity(report)
    for scan in chain(first, scans):
        if len(scan.ranges) != beams:
            raise LogError(
                f"{report.place(scan.line)}: the scan has {len(scan.ranges)} beams, the ones before {beams}; "
                "split the log there"
            )
        if abs(scan.start - start) + beams * abs(scan.step - step) > 1e-2:
            raise LogError(
                f"{report.place(scan.line)}: the beams go from {scan.start:.4g} in steps of {scan.step:.4g} rad, "
                f"the ones before from {start:.4g} in steps of {step:.4g}; split the log there"
            )
        report.scans += 1
        report.backward_steps += scan.time < previous
        previous = scan.time
        report.first_time = min(scan.time, report.first_time) if report.scans > 1 else scan.time
        report.last_time = max(scan.time, report.last_time) if report.scans > 1 else scan.time
        ranges = _masked(scan.ranges, max_range, report)
        yield LaserScan(scan.time, ranges, continuity.joined(scan.line, scan.time, scan.odometry), laser)
        if scan.bright is not None:
            for sighting in find_tags(scan.time, ranges, scan.bright, laser):
                report.sightings += 1
                yield sighting


def wrap(angle: float) -> float:
    """The same angle in (-pi, pi]."""
    return float(np.pi - (np.pi - angle) % (2.0 * np.pi))


def _usable(raw: Iterable[RawScan], report: Report) -> Iterator[RawScan]:
    previous: RawScan | None = None
    for scan in raw:
        if len(scan.ranges) > MOST_BEAMS:
            report.skip(scan.line, f"a scan of {len(scan.ranges)} beams, more than {MOST_BEAMS}")
            continue
        x, y, theta = scan.odometry.tolist()
        # Written so that NaN fails.
        if not (abs(x) < FARTHEST_ODOMETRY and abs(y) < FARTHEST_ODOMETRY and abs(theta) < FARTHEST_ODOMETRY):
            report.skip(scan.line, f"odometry ({x:g}, {y:g}, {theta:g}) is not a pose")
            continue
        if not abs(scan.time) < LATEST:
            report.skip(scan.line, f"time {scan.time:g} is not a time in seconds")
            continue
        if (
            previous is not None
            and scan.time == previous.time
            and np.array_equal(scan.odometry, previous.odometry)
            and np.array_equal(scan.ranges, previous.ranges, equal_nan=True)
        ):
            report.duplicates += 1
            continue
        previous = scan
        scan.odometry[2] = wrap(theta)
        yield scan


def _first_look(scans: Iterator[RawScan]) -> list[RawScan]:
    least, most = FIRST_LOOK
    first: list[RawScan] = []
    turned = False
    for scan in scans:
        first.append(scan)
        turned = turned or abs(wrap(scan.odometry[2] - first[0].odometry[2])) > TURN_TO_TELL
        if len(first) >= (least if turned else most):
            break
    return first


def _mount(first: list[RawScan]) -> FloatArray:
    otherwise = first[0].mount()
    posed = [
        (scan.odometry, scan.laser_pose)
        for scan in first
        if scan.laser_pose is not None and np.all(np.abs(scan.laser_pose) < FARTHEST_ODOMETRY)  # NaN fails
    ]
    if not posed:
        return otherwise
    robot = np.array([odometry for odometry, _ in posed])
    laser = np.array([pose for _, pose in posed])
    dx, dy = (laser - robot)[:, :2].T
    cos, sin = np.cos(robot[:, 2]), np.sin(robot[:, 2])
    turn = np.array([wrap(angle) for angle in laser[:, 2] - robot[:, 2]])
    # Unwrapped, because a rear laser looks along pi or -pi.
    seen = np.column_stack((cos * dx + sin * dy, cos * dy - sin * dx, np.unwrap(turn)))
    turned = max(abs(wrap(angle)) for angle in robot[:, 2] - robot[0, 2]) > TURN_TO_TELL
    spread = np.ptp(seen, axis=0)
    constant = bool(np.all(spread[:2] < SAME_MOUNT[0]) and spread[2] < SAME_MOUNT[1])
    mount: FloatArray = np.median(seen, axis=0)
    mount[2] = wrap(mount[2])
    told = np.hypot(mount[0], mount[1]) > SAME_MOUNT[0] or abs(mount[2]) > SAME_MOUNT[1]
    near = np.hypot(mount[0], mount[1]) < FARTHEST_MOUNT
    on_axis = abs(mount[1]) < SAME_MOUNT[0] and abs(np.sin(mount[2])) < SAME_MOUNT[1]
    return mount if constant and told and near and (turned or on_axis) else otherwise


def _no_return_range(first: list[RawScan]) -> float:
    largest = max((_largest_below(scan.ranges, FARTHEST_WALL) for scan in first), default=0.0)
    limits = [FARTHEST_WALL]
    limits += [bottom for bottom, top in SICK_NO_RETURN if bottom <= largest <= top]
    declared = first[0].declared_max
    if declared is not None and declared > 0.0 and largest <= declared * 1.01:
        limits.append(declared)
    return min(limits)


def _largest_below(ranges: FloatArray, limit: float) -> float:
    near = ranges[ranges < limit]
    return float(near.max()) if near.size else 0.0


def _masked(ranges: FloatArray, max_range: float, report: Report) -> npt.NDArray[np.float32]:
    far = ranges >= max_range - 1e-3
    masked = np.clip(ranges, 0.0, FARTHEST_WALL).astype(np.float32)  # 1e300 has no float32, 1e-97 is zero in it
    usable = masked > 0.0  # false for NaN
    count = np.count_nonzero(usable)
    report.readings += ranges.size
    report.no_returns += int(np.count_nonzero(far))
    masked[far] = np.inf
    if count < ranges.size:
        report.masked += ranges.size - int(count)
        masked[~usable] = np.nan
    return masked
