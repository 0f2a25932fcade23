"""What a log holds, without mapping it."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from frontend.readers import Report, open_log
from frontend.records import FloatArray, Laser, LaserScan

# A clock that reads less than this, 1990, does not count from 1970.
_SINCE_1970 = 631_152_000.0


@dataclass(frozen=True, slots=True)
class LogInfo:
    """A log from its first to its last scan.

    Attributes:
        format: of the log, for example "CARMEN".
        laser: the scanner.
        path_length: metres the robot drove by its odometry.
        turned: radians it turned, either way, by its odometry.
        report: counts of scans, lines, sightings and blemishes.
    """

    format: str
    laser: Laser
    path_length: float
    turned: float
    report: Report


def log_info(path: Path) -> LogInfo:
    """Read a log once, in memory that does not grow with it.

    Raises:
        LogError: the log cannot be read or holds no usable scan.
    """
    log = open_log(path)
    driven = turned = 0.0
    previous: LaserScan | None = None
    for scan in log.scans():
        if previous is not None:
            dx, dy, turn = (scan.odometry - previous.odometry).tolist()
            driven += math.hypot(dx, dy)
            turned += abs(math.remainder(turn, 2.0 * math.pi))
        previous = scan
    assert previous is not None  # a log without a scan has raised
    return LogInfo(log.format, previous.laser, driven, turned, log.report)


def describe(info: LogInfo) -> Iterator[str]:
    """The lines `mrtm info` prints: one a fact, then the blemishes."""
    report, laser = info.report, info.laser
    width, count = np.degrees(np.ptp(laser.angles)), len(laser.angles)
    facts = {
        "format": info.format,
        "time": _time(report),
        "scans": f"{report.scans}{_rate(report)}",
        "laser": report.laser.partition(",")[0],
        "beams": f"{count}, {width / (count - 1):.4g} deg apart",
        "field of view": f"{width:.4g} deg, from {_degrees(laser.angles, 0)} to {_degrees(laser.angles, -1)}",
        "max range": f"{laser.max_range:g} m; {_share(report.no_returns, report)} of the readings hit nothing",
        "mount": "({:.4g} m, {:.4g} m, {:.4g} deg) on the robot".format(*laser.mount[:2], np.degrees(laser.mount[2])),
        "path": f"{info.path_length:.1f} m driven, {np.degrees(info.turned):.0f} deg turned, by odometry",
        "sightings": f"{report.sightings} of other robots, by reflective tags" if report.sightings else "none",
        f"{report.unit}s": ", ".join(f"{number} {name}" for name, number in report.lines.most_common()),
    }
    for name, fact in facts.items():
        yield f"{name:<14}{fact}"
    blemishes = report.blemishes()
    yield f"{'blemishes':<14}{'' if blemishes else 'none'}".rstrip()
    for blemish in blemishes:
        yield f"  {blemish}"


def _time(report: Report) -> str:
    text = f"{report.duration:.1f} s, from {report.first_time:.3f} to {report.last_time:.3f}"
    try:
        begin = datetime.fromtimestamp(report.first_time, UTC)
    except (OverflowError, ValueError, OSError):
        return text
    return f"{text} ({begin:%Y-%m-%d %H:%M:%S} UTC)" if report.first_time > _SINCE_1970 else text


def _rate(report: Report) -> str:
    return f", {(report.scans - 1) / report.duration:.3g} a second" if report.duration > 0.0 else ""


def _degrees(angles: FloatArray, index: int) -> str:
    return f"{np.degrees(angles[index]):.4g}"


def _share(count: int, report: Report) -> str:
    return f"{100.0 * count / max(report.readings, 1):.2g} %"
