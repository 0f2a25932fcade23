"""MRPT rawlogs (``.rawlog``): objects of MRPT's binary archive, in either of the two ways MRPT lays a log out.

- Observations only: CObservation2DRangeScan and CObservationOdometry, each with its time. A scan takes its odometry
  interpolated at its time.
- Sensory frames: CActionCollection and CSensoryFrame in turn. The scans of a frame are where the movements
  (CActionRobotMovement2D) before it add up to; odometry's movement is preferred to a scan matcher's.

The first laser met is read, by its label. Objects of other classes are counted and skipped: since their length is not
told, the next header is searched. Layouts known: CObservation2DRangeScan up to version 7, CObservationOdometry up to 2,
CActionRobotMovement2D up to 7, CSensoryFrame up to 2 (MRPT 0.5 to 2.14). Source: MRPT's serializeFrom of each.
"""

from collections.abc import Callable, Iterator

import numpy as np

from frontend import se2
from frontend.errors import LogError
from frontend.readers.lines import Unreadable
from frontend.readers.mrpt_archive import Archive, EndOfArchive, known
from frontend.readers.report import Report
from frontend.readers.scans import FARTHEST_ODOMETRY, RawScan, Record, assemble, wrap
from frontend.readers.track import OdometryTrack
from frontend.records import FloatArray, Odometry

NAME = "MRPT rawlog"

MOST_BEAMS = 1 << 13
STEEPEST = np.radians(10.0)
# A time is in units of 100 ns since 1601; this many until 1970.
_UNIX_EPOCH = 116_444_736_000_000_000
_TICKS = 1e7


def sniff(head: bytes) -> bool:
    """Whether the first bytes of a file are an archive's."""
    try:
        return Archive(iter([head[:200]])).header()[0] != "nullptr"
    except (Unreadable, EndOfArchive):
        return False


def read(blocks: Iterator[bytes], report: Report) -> Iterator[Record]:
    """Yield the scans of the log's laser in file order.

    Args:
        blocks: the file's content.
        report: filled on the way.

    Raises:
        LogError: the number of beams or their bearings change, or there is no odometry at all.
    """
    report.unit = "object"
    return assemble(_Rawlog(Archive(blocks), report).scans(), report)


class _Rawlog:
    def __init__(self, archive: Archive, report: Report) -> None:
        self._archive = archive
        self._report = report
        self._track = OdometryTrack()
        self._laser: bytes | None = None
        self._homeless = False
        # Of the layout with sensory frames: where the robot is, what moves it there next, and the time of the frame.
        self._pose: FloatArray = np.zeros(3)
        self._movement: tuple[bool, FloatArray] | None = None
        self._in_frames = False
        self._frame_time = 0
        self._readers: dict[str, Callable[[int, int], Iterator[RawScan]]] = {
            "CRawlog": self._read_rawlog,
            "CSensoryFrame": self._read_frame,
            "CActionCollection": self._read_actions,
            "CActionRobotMovement2D": self._read_movement,
            "CObservationOdometry": self._read_odometry,
            "CObservation2DRangeScan": self._read_scan,
            "nullptr": lambda number, version: iter(()),
        }

    def scans(self) -> Iterator[RawScan]:
        archive, report = self._archive, self._report
        number = 0
        found = archive.next_object()
        while found:
            number += 1
            name = "object"
            try:
                name, version = archive.header()
                if name in self._readers:
                    report.lines[name] += 1
                    yield from self._readers[name](number, version)
                    found = archive.next_object()
                else:
                    report.count_unknown(number, name.encode())
                    found = archive.skip_object()
            except Unreadable as reason:
                report.skip(number, f"{name}: {reason}")
                found = archive.skip_object()
            except EndOfArchive:
                report.damage = report.damage or f"it ends in the middle of object {number}, a {name}"
                break
        if self._homeless and not self._track.started:
            raise LogError(f"{report.path}: scans need odometry observations or actions and the log has neither")
        yield from self._track.rest()

    def _read_rawlog(self, number: int, version: int) -> Iterator[RawScan]:
        known("CRawlog", version, 1)
        self._archive.one("I")
        yield from ()

    def _read_actions(self, number: int, version: int) -> Iterator[RawScan]:
        known("CActionCollection", version, 0)
        self._archive.one("I")
        self._move()
        self._in_frames = True
        yield from ()

    def _read_frame(self, number: int, version: int) -> Iterator[RawScan]:
        known("CSensoryFrame", version, 2)
        if version < 2:
            self._archive.one("I")
        self._frame_time = self._archive.one("Q") if version == 0 else 0
        self._archive.one("I")
        self._move()
        self._in_frames = True
        yield from ()

    def _move(self) -> None:
        """Add up what the last collection of actions held."""
        if self._movement is not None:
            self._pose = se2.compose(self._pose, self._movement[1])
            self._movement = None

    def _read_movement(self, number: int, version: int) -> Iterator[RawScan]:
        by_odometry, movement = _movement(self._archive, version)
        self._archive.close()
        if not np.all(np.abs(movement) < 1e3):  # written so that NaN fails
            raise Unreadable(f"a movement by ({', '.join(f'{value:g}' for value in movement)})")
        if self._movement is None or (by_odometry and not self._movement[0]):
            self._movement = by_odometry, movement
        yield from ()

    def _read_odometry(self, number: int, version: int) -> Iterator[RawScan]:
        archive = self._archive
        known("CObservationOdometry", version, 2)
        pose = archive.pose2d()
        archive.text()
        time = _seconds(archive.one("Q"))
        if version:
            if archive.flag() or version < 2:
                archive.take(8)  # ticks of the encoders
            if archive.flag() or version < 2:
                archive.take(24 if version == 2 else 8)  # velocities
        archive.close()
        if not np.all(np.isfinite(pose)):
            raise Unreadable("a pose that is not finite")
        yield from self._track.add(Odometry(time, pose))

    def _read_scan(self, number: int, version: int) -> Iterator[RawScan]:
        label, scan = _scan(self._archive, number, version, self._frame_time)
        self._archive.close()
        if self._laser is None:
            self._laser = label
        if label != self._laser:
            self._report.leave_out(label)
        elif self._track.started:
            yield from self._track.place(scan)
        elif self._in_frames:
            scan.odometry[:] = self._pose
            yield scan
        else:
            self._homeless = True
            raise Unreadable("no odometry before it")


def _movement(archive: Archive, version: int) -> tuple[bool, FloatArray]:
    """Whether odometry measured it, and (3,) the movement in the robot's frame."""
    known("CActionRobotMovement2D", version, 7)
    if version < 2:
        movement = archive.pose_pdf_mean()
        by_odometry = archive.one("i") == 0
    else:
        by_odometry = archive.one("i") == 0
        movement = archive.pose2d() if by_odometry else archive.pose_pdf_mean()
        if by_odometry:
            archive.take({2: 44, 3: 44, 4: 48}.get(version, 56))  # parameters of the motion model
    if version:
        if archive.flag() or version < 7:
            archive.take(24 if version == 7 else 8)  # velocities
        if archive.flag() or version < 7:
            archive.take(8)  # ticks of the encoders
    if version >= 6:
        archive.take(8)  # time
    return by_odometry, movement


def _scan(archive: Archive, number: int, version: int, frame_time: int) -> tuple[bytes, RawScan]:
    """The laser's label and the scan, still without odometry."""
    known("CObservation2DRangeScan", version, 7)
    aperture = float(archive.array("f4", 1)[0])
    right_to_left = archive.flag()
    max_range = float(archive.array("f4", 1)[0])
    position, rotation = archive.pose3d()
    if version < 6:
        archive.matrix()  # covariance of the laser's pose
    beams = archive.one("I")
    if not 2 <= beams <= MOST_BEAMS:
        raise Unreadable(f"{beams} beams")
    ranges = archive.array("f4", beams)
    valid = np.frombuffer(archive.take(beams), np.uint8) != 0 if version else ranges < max_range
    if version >= 2:
        archive.take(4)  # standard deviation of a range
    ticks = archive.one("Q") if version >= 3 else 0
    label = b""
    if version >= 4:
        archive.take(4)  # width of a beam
    if version >= 5:
        label = archive.text()
        archive.take(8)  # pitch from the first to the last beam
    if version == 7 and archive.flag():
        archive.take(4 * beams)  # intensities, of no known scale

    if not 0.0 < aperture < 6.3:
        raise Unreadable(f"an aperture of {aperture:g} rad")
    tilt = np.arccos(np.clip(abs(rotation[2, 2]), 0.0, 1.0))
    if not tilt < STEEPEST:
        raise Unreadable(f"the laser is tilted by {np.degrees(tilt):.0f} deg")
    if right_to_left != (rotation[2, 2] > 0.0):  # clockwise, or counter-clockwise and upside down
        ranges, valid = ranges[::-1], valid[::-1]
    start, step = _fan(aperture, beams)
    mount = np.array([position[0], position[1], wrap(float(np.arctan2(rotation[1, 0], rotation[0, 0])))])
    if not np.all(np.abs(mount) < FARTHEST_ODOMETRY):  # written so that NaN fails
        raise Unreadable("the laser's place on the robot is not finite")
    return label, RawScan(
        laser=label.decode("ascii", "replace")[:40] if label.isalnum() else "laser",
        line=number,
        time=_seconds(ticks or frame_time),
        # What the log calls invalid and is not at the end of the laser's reach is an error.
        ranges=np.where(valid | (ranges >= max_range), ranges, np.nan),
        odometry=np.zeros(3),
        start=start,
        step=step,
        laser_pose=None,
        mount=lambda: mount,
        declared_max=max_range,
    )


def _fan(aperture: float, beams: int) -> tuple[float, float]:
    """Bearing of the first beam and radians between beams.

    MRPT spreads the beams evenly over the aperture. But half a turn of 180 or 360 readings is what converters make of
    a SICK LMS whose 181st or 361st reading the log left out: its steps are 1 and 0.5 degrees.
    """
    of_a_sick = beams in (180, 360) and abs(aperture - np.pi) < 1e-3
    return -aperture / 2.0, aperture / (beams if of_a_sick else beams - 1)


def _seconds(ticks: int) -> float:
    if not ticks:
        raise Unreadable("no time")
    return (ticks - _UNIX_EPOCH) / _TICKS
