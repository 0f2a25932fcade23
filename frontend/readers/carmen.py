"""CARMEN logs, old (``FLASER``, ``RLASER``) and new (``RAWLASER1-4``, ``ROBOTLASER1-2``): one message a line.

    ODOM x y theta tv rv accel
    FLASER n [ranges] x y theta odom_x odom_y odom_theta
    RAWLASER1 type start fov step max_range accuracy remission_mode n [ranges] m [remissions]
    ROBOTLASER1 (as RAWLASER1) x y theta robot_x robot_y robot_theta tv rv forward_safety side_safety turn_axis

each followed by ``ipc_time host logger_time``; the time of a message is its ipc time. The pose ``x y theta`` is the
laser's. Source: CARMEN's own reader and logger (readlog.c, writelog.c). Early ROBOTLASER lines, as the header of
their logs says, have no remissions, and may lack the turn axis; the number of fields tells them apart.

A log may hold several lasers. One is read, the best of those met in the first 500 lines: front before rear, with
odometry in its own line before without. A RAWLASER takes its odometry from the ODOM lines, interpolated at its time.
"""

from collections.abc import Iterable, Iterator
from itertools import chain, islice

import numpy as np

from frontend.errors import LogError
from frontend.readers.lines import Unreadable, numbers, split_lines
from frontend.readers.report import Report
from frontend.readers.scans import RawScan, Record, assemble, wrap
from frontend.readers.track import OdometryTrack
from frontend.records import FloatArray, Odometry

NAME = "CARMEN"

LASERS = (
    *("FLASER", "ROBOTLASER1", "RAWLASER1"),
    *("RLASER", "ROBOTLASER2", "RAWLASER2", "RAWLASER3", "RAWLASER4"),
)
_LASER_WORDS = {name.encode(): name for name in LASERS}
_REAR = ("RLASER", "ROBOTLASER2", "RAWLASER2")
_OTHER_WORDS = {word.encode(): word for word in ("ODOM", "SYNC", "COMMENT", "TRUEPOS")}
# What a CARMEN log starts with: its logger's header, or a message.
_STARTS = (b"# message_name", b"# message formats", b"# CARMEN", b"PARAM ", b"ODOM ")
_LOOK_AHEAD = 500

# (degrees from the first to the last beam, degrees a beam) by number of readings, for the old messages, which do not
# say: what a SICK LMS (CARMEN's own guesses, which give 180 readings the 181 beams' bearings less the last), a
# Hokuyo URG or UTM gives.
_FANS = {
    **dict.fromkeys((180, 181), (180.0, 1.0)),
    **dict.fromkeys((360, 361), (180.0, 0.5)),
    **dict.fromkeys((400, 401), (100.0, 0.25)),
    **dict.fromkeys((540, 541), (270.0, 0.5)),
    682: (681 * 360 / 1024, 360 / 1024),
    683: (682 * 360 / 1024, 360 / 1024),
    769: (270.0, 360 / 1024),
    **dict.fromkeys((1080, 1081), (270.0, 0.25)),
}


def sniff(head: bytes) -> bool:
    """Whether the first bytes of a file are a CARMEN log's."""
    return any(line.startswith(_STARTS) or _first_word(line) in _LASER_WORDS for line in head.split(b"\n"))


def read(blocks: Iterator[bytes], report: Report) -> Iterator[Record]:
    """Yield the scans of the log's laser in file order.

    Args:
        blocks: the file's content.
        report: filled on the way.

    Raises:
        LogError: the number of beams or their bearings change, or a RAWLASER has no odometry at all.
    """
    lines = split_lines(blocks, report)
    ahead = list(islice(lines, _LOOK_AHEAD))
    words = {_first_word(line) for _, line in ahead}
    laser = next((name for word, name in _LASER_WORDS.items() if word in words), "")
    parameters: dict[str, float] = {}
    messages = _messages(chain(ahead, lines), laser, parameters, report)
    return assemble(_raw_scans(messages, parameters, report), report)


def _messages(
    lines: Iterable[tuple[int, bytes]], laser: str, parameters: dict[str, float], report: Report
) -> Iterator[tuple[int, str, bytes]]:
    """Yield (line number, name, line) of the laser's lines, and of ODOM once a RAWLASER is what is read."""
    counts = report.lines
    needs_odometry = laser.startswith("RAWLASER")
    for number, line in lines:
        word = _first_word(line)
        if word in _LASER_WORDS:
            name = _LASER_WORDS[word]
            counts[name] += 1
            if not laser:
                laser, needs_odometry = name, name.startswith("RAWLASER")
            if name == laser:
                yield number, name, line
            else:
                report.other_lasers[name] += 1
        elif word in _OTHER_WORDS:
            counts[_OTHER_WORDS[word]] += 1
            if needs_odometry and word == b"ODOM":
                yield number, "ODOM", line
        elif word == b"PARAM":
            counts["PARAM"] += 1
            _read_parameter(line, parameters)
        elif word.startswith(b"#"):
            counts["#"] += 1
        elif word:
            report.count_unknown(number, word)


def _raw_scans(
    messages: Iterable[tuple[int, str, bytes]], parameters: dict[str, float], report: Report
) -> Iterator[RawScan]:
    """Parse the lines; scans without odometry of their own take it from the ODOM lines."""
    track = OdometryTrack()
    homeless = ""
    for number, name, line in messages:
        try:
            if name == "ODOM":
                yield from track.add(_odometry(line))
            elif not name.startswith("RAWLASER"):
                yield _scan(number, name, line, parameters)
            elif track.started:
                yield from track.place(_scan(number, name, line, parameters))
            else:
                homeless = name
                raise Unreadable("no ODOM line before it")
        except Unreadable as reason:
            report.skip(number, f"{name}: {reason}")
    if homeless and not track.started:
        raise LogError(f"{report.path}: {homeless} needs ODOM lines and the log has none that can be read")
    yield from track.rest()


def _first_word(line: bytes) -> bytes:
    words = line[:64].split(None, 1)
    return words[0] if words else b""


def _numbers(line: bytes) -> tuple[FloatArray, int]:
    """The numbers between the message's name and the host; the last one is the ipc time."""
    parts = line.rsplit(None, 2)
    if len(parts) < 3:
        raise Unreadable("too few fields")
    body = parts[0].split(None, 1)
    values = numbers(body[1]) if len(body) > 1 else np.empty(0)
    return values, values.size


def _scan(number: int, name: str, line: bytes, parameters: dict[str, float]) -> RawScan:
    values, size = _numbers(line)
    old = name in ("FLASER", "RLASER")
    at = 0 if old else 7  # where the number of readings stands
    if size <= at:
        raise Unreadable(f"only {size} fields")
    told = values[at]
    if not (2 <= told <= size and told == int(told)):
        raise Unreadable(f"{told:g} readings in {size} fields")
    beams = int(told)
    tail = values[at + 1 + beams :]
    if old:
        _expect(tail.size == 7, beams, size)
        fan, step = _FANS.get(beams, (180.0, 180.0 / (beams - 1)))
        start, step = np.radians(-fan / 2.0), np.radians(step)
        declared = parameters.get("robot_front_laser_max" if name == "FLASER" else "robot_rear_laser_max")
    else:
        tail = _without_remissions(tail, name, beams, size)
        start, step, declared = float(values[1]), float(values[3]), float(values[4])
        if not (abs(start) < 10.0 and 0.0 < step * beams < 10.0):
            raise Unreadable(f"{beams} beams from {start:g} in steps of {step:g} rad")
    raw = name.startswith("RAWLASER")
    return RawScan(
        laser=name,
        line=number,
        time=float(values[-1]),
        ranges=values[at + 1 : at + 1 + beams],
        odometry=np.zeros(3) if raw else tail[3:6].copy(),
        start=float(start),
        step=float(step),
        laser_pose=None if raw else tail[:3].copy(),
        mount=lambda: _mount(name, parameters),
        declared_max=declared,
    )


def _without_remissions(tail: FloatArray, name: str, beams: int, size: int) -> FloatArray:
    """What follows the ranges and, if there are any, the remissions."""
    rest = 1 if name.startswith("RAWLASER") else 12
    remissions = tail[0] if tail.size else 0.0
    if tail.size == rest + 1 + remissions:
        return tail[tail.size - rest :]
    _expect(rest == 12 and tail.size in (11, 12), beams, size)
    return tail


def _expect(fits: bool, beams: int, size: int) -> None:
    if not fits:
        raise Unreadable(f"{size} fields do not fit {beams} readings")


def _odometry(line: bytes) -> Odometry:
    values, size = _numbers(line)
    if size != 7 or not np.all(np.isfinite(values)):
        raise Unreadable("not x y theta tv rv accel ipc_time host logger_time in finite numbers")
    return Odometry(time=float(values[6]), pose=values[:3].copy())


def _read_parameter(line: bytes, parameters: dict[str, float]) -> None:
    """Keep ``PARAM name value``, if the value is a number: the others say nothing of the laser."""
    words = line.split(None, 3)
    try:
        name, value = words[1].decode(), float(words[2])
    except (IndexError, ValueError):
        return
    if name.startswith("robot_") and np.isfinite(value):
        parameters[name] = value


def _mount(name: str, parameters: dict[str, float]) -> FloatArray:
    """robot_T_laser from the parameters: front lasers look ahead, rear lasers back."""
    rear = name in _REAR
    prefix = "robot_rearlaser" if rear else "robot_frontlaser"
    x, y, turn = (parameters.get(f"{prefix}{part}_offset", 0.0) for part in ("", "_side", "_angular"))
    return np.array([x, y, wrap(turn + np.pi if rear and abs(turn) < np.pi / 2 else turn)])
