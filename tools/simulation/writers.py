"""Logs and trajectories on disk. The same log gives the same bytes."""

import bz2
import gzip
import io
import lzma
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import IO, TextIO, cast

import numpy as np

from frontend.records import FloatArray
from tools.simulation.laser import LaserModel
from tools.simulation.log import SimulatedLog
from tools.simulation.poses import between, compose

HOST = "simulator"


def write_carmen(log: SimulatedLog | Iterable[SimulatedLog], path: Path) -> None:
    """Writes a CARMEN log: PARAM, then ODOM and the laser message of each scan.

    A forward-looking half circle as the SICK's is written as FLASER, any other scanner as ROBOTLASER1, which
    carries its geometry.

    Args:
        log: a log, or its pieces in order.
        path: compressed when it ends in .gz, .bz2 or .xz.
    """
    parts = iter([log] if isinstance(log, SimulatedLog) else log)
    first = next(parts)  # if the route cannot be driven, an older file stays as it was
    begin = float(first.times[0])
    previous: SimulatedLog | None = None
    with _opened(path) as file:
        file.writelines(_header(first.laser))
        for part in chain([first], parts):
            _write_scans(file, part, begin, _speeds(part, previous))
            previous = part


def write_tum(times: FloatArray, poses: FloatArray, path: Path) -> None:
    """Writes poses (N, 3) as ``t x y z qx qy qz qw``, one a line; compressed by suffix."""
    half = poses[:, 2] / 2
    # Adding zero after rounding turns -0.0 into 0.0: the sign of nothing differs between machines.
    columns = np.round(np.column_stack((poses[:, :2], np.sin(half), np.cos(half))), 6) + 0.0
    with _opened(path) as file:
        for time, (x, y, qz, qw) in zip(times, columns, strict=True):
            file.write(f"{time:.6f} {x:.6f} {y:.6f} 0 0 0 {qz:.6f} {qw:.6f}\n")


@contextmanager
def _opened(path: Path) -> Iterator[TextIO]:
    with (
        path.open("wb") as raw,
        _compressed(raw, path.suffix) as binary,
        io.TextIOWrapper(binary, "ascii", newline="\n") as text,
    ):
        yield text


def _compressed(raw: IO[bytes], suffix: str) -> IO[bytes]:
    if suffix == ".gz":  # neither name nor time in the header
        return cast(IO[bytes], gzip.GzipFile("", "wb", compresslevel=9, fileobj=raw, mtime=0))
    if suffix == ".bz2":
        return cast(IO[bytes], bz2.BZ2File(raw, "wb"))
    if suffix == ".xz":
        return cast(IO[bytes], lzma.LZMAFile(raw, "wb"))
    return raw


def _is_flaser(laser: LaserModel) -> bool:
    """Whether readers of FLASER, which know nothing but the number of readings, guess these angles."""
    degrees = {180: 1.0, 181: 1.0, 360: 0.5, 361: 0.5}.get(laser.beams, math.nan)
    geometry = math.isclose(laser.step, math.radians(degrees)) and math.isclose(laser.first, -math.pi / 2)
    # FLASER can only say where the laser is through an offset ahead.
    return geometry and laser.mount[1:] == (0.0, 0.0)


def _header(laser: LaserModel) -> list[str]:
    values = {
        "robot_frontlaser_offset": laser.mount[0],
        "robot_front_laser_max": laser.max_range,
        "laser_front_laser_resolution": math.degrees(laser.step),
    }
    comment = "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp\n"
    return [comment] + [f"PARAM {name} {value:.6g} {HOST} 0\n" for name, value in values.items()]


def _write_scans(file: TextIO, log: SimulatedLog, begin: float, speeds: FloatArray) -> None:
    laser = log.laser
    decimals = max(2, math.ceil(-math.log10(laser.resolution) - 1e-9)) if laser.resolution > 0 else 6
    reading = f"{{:.{decimals}f}}".format
    before = (
        f"FLASER {laser.beams}"
        if _is_flaser(laser)
        else f"ROBOTLASER1 0 {laser.first:.8f} {laser.step * (laser.beams - 1):.8f} {laser.step:.8f} "
        f"{laser.max_range:g} {laser.sigma:g} 0 {laser.beams}"
    )
    robot = np.round(log.odometry, 6) + 0.0
    scanner = np.round(compose(log.odometry, np.array(laser.mount)), 6) + 0.0
    readings = np.where(np.isinf(log.ranges), laser.no_return, log.ranges)
    for time, ranges, at, sees_from, speed in zip(log.times, readings, robot, scanner, speeds, strict=True):
        stamp = f"{time:.6f} {HOST} {time - begin:.6f}\n"
        pose, laser_pose, velocity = (" ".join(f"{value:.6f}" for value in row) for row in (at, sees_from, speed))
        file.write(f"ODOM {pose} {velocity} 0.000000 {stamp}")
        measured = f"{before} {' '.join(map(reading, ranges.tolist()))}"
        if _is_flaser(laser):
            file.write(f"{measured} {laser_pose} {pose} {stamp}")
        else:
            # No remissions; then the poses, the speeds, two safety distances and the turn axis.
            file.write(f"{measured} 0 {laser_pose} {pose} {velocity} 0 0 0 {stamp}")


def _speeds(log: SimulatedLog, previous: SimulatedLog | None) -> FloatArray:
    """(N, 2) m/s and rad/s between each scan and the one before it, by odometry; zero for the very first."""
    last = previous if previous is not None else log
    index = -1 if previous is not None else 0
    poses = np.vstack((last.odometry[index], log.odometry))
    seconds = np.diff(np.concatenate(([last.times[index]], log.times)))
    forward, _, turned = between(poses[:-1], poses[1:]).T
    speeds = np.column_stack((forward, turned)) / np.where(seconds > 0, seconds, 1.0)[:, None]
    return np.asarray(np.round(speeds, 6) + 0.0)
