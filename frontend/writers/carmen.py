"""CARMEN logs: PARAM, then ODOM and the laser message of each scan."""

import math
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from frontend import se2
from frontend.records import FloatArray, Laser, LaserScan
from frontend.writers.text import new_text

# Written where nothing was hit, if the laser sees farther than any reader takes for a wall: a SICK LMS's own.
NO_RETURN = 81.91
_FARTHEST_DECLARED = 50.0


def write_carmen(
    scans: Iterable[LaserScan], path: Path, *, no_return: float | None = None, sigma: float = 0.01, host: str = "mrtm"
) -> int:
    """Write a CARMEN log that ``frontend.readers`` reads back to the same scans; returns their number.

    Times and ranges are the same bit for bit; odometry, angles and mount to a millionth of a metre or radian.

    A forward-looking half circle as the SICK's is written as FLASER, any other scanner as ROBOTLASER1, which carries
    its geometry. Unusable ranges become 0.

    Args:
        scans: at least one; all of one laser.
        path: compressed when it ends in .gz, .bz2 or .xz; an older file is replaced when all scans are written.
        no_return: metres written where nothing was hit, at least the laser's max_range.
        sigma: standard deviation of a range, metres, as ROBOTLASER1 tells it.
        host: the name of the machine in every line.

    Raises:
        OSError: the file cannot be written.
    """
    stream = iter(scans)
    first = next(stream)
    laser = first.laser
    if no_return is None:
        no_return = laser.max_range if laser.max_range < _FARTHEST_DECLARED else NO_RETURN
    with new_text(path) as file:
        file.writelines(_header(laser, host))
        count = 0
        for line in _lines(chain([first], stream), laser, no_return, sigma, host):
            file.write(line)
            count += 1
    return count


def _header(laser: Laser, host: str) -> Iterator[str]:
    yield "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp\n"
    x, y, theta = laser.mount.tolist()
    values = {"robot_frontlaser_offset": x}
    if (y, theta) != (0.0, 0.0):
        values |= {"robot_frontlaser_side_offset": y, "robot_frontlaser_angular_offset": theta}
    values |= {
        "robot_front_laser_max": laser.max_range,
        "laser_front_laser_resolution": math.degrees(laser.angles[1] - laser.angles[0]),
    }
    for name, value in values.items():
        yield f"PARAM {name} {value:.6g} {host} 0\n"


def _lines(scans: Iterable[LaserScan], laser: Laser, no_return: float, sigma: float, host: str) -> Iterator[str]:
    """The ODOM and laser line of each scan, together."""
    beams = len(laser.angles)
    step = float(laser.angles[-1] - laser.angles[0]) / (beams - 1)
    old = _is_flaser(laser)
    before = (
        f"FLASER {beams}"
        if old
        else f"ROBOTLASER1 0 {laser.angles[0]:.8f} {step * (beams - 1):.8f} {step:.8f} "
        f"{laser.max_range:g} {sigma:g} 0 {beams}"
    )
    previous: LaserScan | None = None
    begin = 0.0
    for scan in scans:
        if previous is None:
            previous, begin = scan, scan.time
        stamp = f"{_time(scan.time)} {host} {scan.time - begin:.6f}\n"
        pose = " ".join(map(_rounded, scan.odometry.tolist()))
        laser_pose = " ".join(map(_rounded, se2.compose(scan.odometry, laser.mount).tolist()))
        velocity = " ".join(map(_rounded, _speeds(previous, scan)))
        measured = f"{before} {_ranges(scan, no_return)}"
        # ROBOTLASER1: no remissions; then the poses, the speeds, two safety distances and the turn axis.
        message = f"{measured} {laser_pose} {pose}" if old else f"{measured} 0 {laser_pose} {pose} {velocity} 0 0 0"
        yield f"ODOM {pose} {velocity} 0.000000 {stamp}{message} {stamp}"
        previous = scan


def _is_flaser(laser: Laser) -> bool:
    """Whether readers of FLASER, which know nothing but the number of readings, guess these angles."""
    degrees = {180: 1.0, 181: 1.0, 360: 0.5, 361: 0.5}.get(len(laser.angles), math.nan)
    guess = np.radians(-90.0 + degrees * np.arange(len(laser.angles)))
    # FLASER can only say where the laser is through an offset ahead.
    return np.allclose(laser.angles, guess, rtol=0.0, atol=1e-6) and not laser.mount[1:].any()


def _speeds(previous: LaserScan, scan: LaserScan) -> tuple[float, float]:
    """m/s ahead and rad/s since the scan before, by odometry."""
    forward, _, turned = se2.between(previous.odometry, scan.odometry).tolist()
    seconds = scan.time - previous.time
    return (forward / seconds, turned / seconds) if seconds > 0.0 else (forward, turned)


def _ranges(scan: LaserScan, no_return: float) -> str:
    ranges = np.nan_to_num(scan.ranges, nan=0.0, posinf=no_return)
    # Two decimals, as loggers write them, if they say it all; else as many as it takes.
    hundredths: FloatArray = np.rint(ranges.astype(np.float64) * 100.0)
    if np.array_equal((hundredths / 100.0).astype(np.float32), ranges):
        return " ".join(map("{:.2f}".format, (hundredths / 100.0).tolist()))
    return " ".join(map(str, ranges.astype("U32").tolist()))


def _time(seconds: float) -> str:
    text = f"{seconds:.6f}"
    return text if float(text) == seconds else repr(seconds)


def _rounded(value: float) -> str:
    # Adding zero after rounding turns -0.0 into 0.0: the sign of nothing differs between machines.
    return f"{round(value, 6) + 0.0:.6f}"
