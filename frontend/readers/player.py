"""Player 1.x text logs, as of Fort AP Hill: one message a line, ``server_time robot port device index data_time data``.

    position   x y theta vx vy vtheta
    laser      (range bearing intensity) a beam

Times in seconds, the data's own is the one used; metres, radians. The robot of the first line is read, with its first
laser and its first position device: the log of a team holds one robot a file. Odometry is interpolated at the laser's
time. An intensity above 0 is a reflective tag and makes a ``Sighting``. Other devices (power, fiducial, lmap, sync)
are counted.
"""

import math
import re
from collections.abc import Iterator

import numpy as np

from frontend.errors import LogError
from frontend.readers.lines import Unreadable, numbers, split_lines
from frontend.readers.report import Report
from frontend.readers.scans import RawScan, Record, assemble
from frontend.readers.track import OdometryTrack
from frontend.records import FloatArray, Odometry

NAME = "Player"

_LINE = re.compile(rb"^\d+\.\d+[ \t]+\S+[ \t]+\d+[ \t]+[a-z]\w*[ \t]+\d+[ \t]+\d+\.\d+", re.MULTILINE)
# Bearings are written with three decimals.
_EVEN = 2e-3


def sniff(head: bytes) -> bool:
    """Whether the first bytes of a file are a Player log's."""
    return _LINE.search(head) is not None


def read(blocks: Iterator[bytes], report: Report) -> Iterator[Record]:
    """Yield the scans of the robot's laser in file order, each followed by the sightings in it.

    Args:
        blocks: the file's content.
        report: filled on the way.

    Raises:
        LogError: the bearings change, or there is no position line at all.
    """
    return assemble(_raw_scans(split_lines(blocks, report), report), report)


def _raw_scans(lines: Iterator[tuple[int, bytes]], report: Report) -> Iterator[RawScan]:
    track = OdometryTrack()
    beams = 0
    homeless = 0
    for number, device, time, data in _messages(lines, report):
        try:
            if device == b"position":
                yield from track.add(Odometry(time, _pose(data)))
                continue
            scan = _scan(number, time, data)
            beams = beams or len(scan.ranges)
            if len(scan.ranges) != beams:  # a line torn by a logger that was killed
                raise Unreadable(f"{len(scan.ranges)} beams, the scans before have {beams}")
            if not track.started:
                homeless += 1
                raise Unreadable("no position line before it")
            yield from track.place(scan)
        except Unreadable as reason:
            report.skip(number, f"{device.decode()}: {reason}")
    if homeless and not track.started:
        raise LogError(f"{report.path}: laser lines need position lines and the log has none that can be read")
    yield from track.rest()


def _messages(lines: Iterator[tuple[int, bytes]], report: Report) -> Iterator[tuple[int, bytes, float, bytes]]:
    """Yield (line number, device, data time, data) of the one laser and the one position device that are read."""
    robot: tuple[bytes, bytes] | None = None
    chosen: dict[bytes, bytes] = {}
    for number, line in lines:
        words = line.split(None, 6)
        if not words:
            continue
        if words[0].startswith(b"#"):
            report.lines["#"] += 1
            continue
        if len(words) < 6:
            report.skip(number, "fewer fields than server_time robot port device index data_time")
            continue
        _, name, port, device, index, time = words[:6]
        if device not in (b"position", b"laser"):
            report.count_unknown(number, device)
            continue
        report.lines[device.decode()] += 1
        if len(words) < 7 or not _is_number(time):
            report.skip(number, f"{device.decode()}: no data or no time")
            continue
        robot = robot or (name, port)
        if robot == (name, port) and chosen.setdefault(device, index) == index:
            yield number, device, float(time), words[6]
        elif device == b"laser":
            report.leave_out(b" ".join((name, port, device, index)))


def _is_number(word: bytes) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def _pose(data: bytes) -> FloatArray:
    values = numbers(data)
    if values.size != 6 or not np.all(np.isfinite(values)):
        raise Unreadable("not x y theta vx vy vtheta in finite numbers")
    return values[:3].copy()


def _scan(number: int, time: float, data: bytes) -> RawScan:
    values = numbers(data)
    if values.size % 3 or values.size < 6:
        raise Unreadable(f"{values.size} numbers are not a range, a bearing and an intensity for each beam")
    ranges, bearings, intensities = values.reshape(-1, 3).T
    if not np.all(np.abs(bearings) < 10.0):  # written so that NaN fails
        raise Unreadable("the bearings do not rise in even steps")
    # The line through all bearings is finer than their three decimals.
    beam = np.arange(len(bearings)) - (len(bearings) - 1) / 2
    step = float(beam @ bearings / (beam @ beam))
    start = float(bearings.mean() + step * beam[0])
    if not (0.0 < step * len(bearings) < 10.0 and np.abs(start + step * (beam - beam[0]) - bearings).max() < _EVEN):
        raise Unreadable("the bearings do not rise in even steps")
    return RawScan(
        laser="laser",
        line=number,
        time=time,
        ranges=ranges.copy(),
        odometry=np.zeros(3),
        start=start,
        step=step,
        laser_pose=None,
        mount=lambda: np.zeros(3),
        declared_max=None,
        bright=intensities > 0,
    )
