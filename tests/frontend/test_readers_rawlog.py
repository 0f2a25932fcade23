"""MRPT rawlogs: both layouts, every version of the classes, strangers, damage and hostile lengths."""

import gzip
import itertools
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frontend.errors import LogError
from frontend.readers import Log, open_log
from frontend.records import LaserScan
from tests.frontend.memory import peak_memory
from tests.frontend.rawlog_bytes import Writer, about_x, about_z, text, ticks

NEW = Writer()
RANGES = (1.0, 2.5, 3.0, 4.25, 5.0)
STRANGER = NEW.object("CObservationImage", 3, b"\x88\x9fmrpt::obs::CObsCObservation\0" * 50)


def written(tmp_path: Path, content: bytes, compress: Callable[[bytes], bytes] = gzip.compress) -> Log:
    path = tmp_path / "log.rawlog"
    path.write_bytes(compress(content))
    return open_log(path)


def read(tmp_path: Path, content: bytes) -> tuple[list[LaserScan], Log]:
    log = written(tmp_path, content)
    return list(log.scans()), log


def outcome(path: Path) -> list[LaserScan] | str:
    try:
        return list(open_log(path).scans())
    except LogError as error:
        return str(error)


def one(tmp_path: Path, scan: bytes, odometry: bytes = NEW.odometry((0, 0, 0), 1e9)) -> LaserScan:
    (got,), log = read(tmp_path, odometry + scan)
    assert log.report.blemishes() == []
    return got


@pytest.mark.parametrize("compress", [gzip.compress, bytes], ids=["gzip", "plain"])
def test_observations_take_odometry_at_their_time(tmp_path: Path, compress: Callable[[bytes], bytes]) -> None:
    content = b"".join(
        NEW.odometry((i, 0.5 * i, 0.1), 1e9 + i, more=bool(i % 2)) + NEW.scan(RANGES, 1e9 + i + 0.25) for i in range(5)
    )
    log = written(tmp_path, content, compress)
    scans = list(log.scans())
    assert log.format == "MRPT rawlog"
    assert [scan.time for scan in scans] == [1e9 + i + 0.25 for i in range(5)]
    for i, scan in enumerate(scans[:-1]):
        np.testing.assert_array_equal(scan.ranges, np.array(RANGES, np.float32))
        np.testing.assert_allclose(scan.odometry, [i + 0.25, 0.5 * (i + 0.25), 0.1])
    np.testing.assert_allclose(scans[-1].odometry, [4, 2, 0.1])
    np.testing.assert_allclose(scans[0].laser.angles, np.radians([-90, -45, 0, 45, 90]), atol=1e-6)
    assert scans[0].laser.max_range == 30.0
    assert log.report.lines == {"CObservationOdometry": 5, "CObservation2DRangeScan": 5}


def test_times_that_are_all_the_same(tmp_path: Path) -> None:
    """As some converters write them: then the odometry before the scan in the file is its own."""
    content = (NEW.odometry((i, 0, 0), 1e9) + NEW.scan((1.0 + i, 2.0), 1e9) for i in range(9))
    scans, _ = read(tmp_path, b"".join(content))
    assert [scan.odometry[0] for scan in scans] == list(range(9))


def poses_of_frames(writer: Writer, *versions: int, whole: bool = False) -> bytes:
    """A robot that drives a square, one side a frame."""
    entries = []
    for i, version in enumerate(versions):
        motion = (1.0, 0.0, np.pi / 2) if i else (0.0, 0.0, 0.0)
        entries.append(writer.actions(writer.movement(motion, version, more=bool(i % 2))))
        entries.append(writer.frame(writer.scan(RANGES, 1e9 + i)))
    return writer.rawlog(*entries) if whole else b"".join(entries)


@pytest.mark.parametrize("whole", [False, True], ids=["objects", "one CRawlog"])
@pytest.mark.parametrize(
    "writer", [NEW, Writer(plain=True), Writer(old=True)], ids=["with namespace", "without", "before 0.5.5"]
)
@pytest.mark.parametrize("version", range(8))
def test_frames_are_where_the_movements_add_up_to(tmp_path: Path, writer: Writer, version: int, whole: bool) -> None:
    scans, log = read(tmp_path, poses_of_frames(writer, *[version] * 5, whole=whole))
    assert log.report.skipped == 0
    expected = [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]
    np.testing.assert_allclose([scan.odometry[:2] for scan in scans], expected, atol=1e-6)
    assert [scan.time for scan in scans] == [1e9 + i for i in range(5)]


def test_odometry_is_preferred_to_a_scan_matcher(tmp_path: Path) -> None:
    matched, driven = NEW.movement((9, 9, 0), by_odometry=False), NEW.movement((1, 0, 0))
    frames = [NEW.frame(NEW.scan(RANGES, i)) for i in (1, 2, 3)]
    content = NEW.actions(matched, driven) + frames[0] + NEW.actions(driven, matched) + frames[1]
    scans, _ = read(tmp_path, content + NEW.actions(matched) + frames[2])
    np.testing.assert_allclose([scan.odometry[:2] for scan in scans], [(1, 0), (2, 0), (11, 9)])


def test_actions_without_a_frame_between_them_add_up(tmp_path: Path) -> None:
    (scan,), _ = read(tmp_path, NEW.actions(NEW.movement((1, 0, 0))) * 3 + NEW.frame(NEW.scan(RANGES, 1)))
    assert scan.odometry[0] == 3.0


def test_odometry_observations_in_frames_count_more_than_actions(tmp_path: Path) -> None:
    content = NEW.actions() + NEW.frame(NEW.odometry((5, 6, 0.5), 10), NEW.scan(RANGES, 10))
    (scan,), _ = read(tmp_path, content)
    np.testing.assert_allclose(scan.odometry, [5, 6, 0.5])


@pytest.mark.parametrize("version", [0, 1, 2])
def test_versions_of_odometry(tmp_path: Path, version: int) -> None:
    for more in (False, True):
        scan = one(tmp_path, NEW.scan(RANGES, 1e9), NEW.odometry((1, 2, 3), 1e9, version, more))
        np.testing.assert_allclose(scan.odometry, [1, 2, 3])


@pytest.mark.parametrize("pose_version", range(4))
@pytest.mark.parametrize("version", range(8))
@pytest.mark.parametrize("old", [False, True])
def test_versions_of_scans(tmp_path: Path, version: int, pose_version: int, old: bool) -> None:
    writer = Writer(old=old)
    pose = {"position": (0.2, -0.1, 0.5), "rotation": about_z(0.3), "pose_version": pose_version}
    scan = writer.scan(RANGES, 1e9, version, intensities=True, **pose)  # type: ignore[arg-type]
    # Before version 3 a scan has no time of its own, the frame has.
    (got,), log = read(tmp_path, writer.actions() + writer.frame(scan, version=0, time=1e9))
    assert log.report.blemishes() == []
    assert got.time == 1e9
    np.testing.assert_array_equal(got.ranges, np.array(RANGES, np.float32))
    np.testing.assert_allclose(got.laser.mount, [0.2, -0.1, 0.3], atol=1e-6)


def test_a_scan_without_any_time_is_skipped(tmp_path: Path) -> None:
    content = NEW.actions() + NEW.frame(NEW.scan(RANGES, 0, 2)) + NEW.frame(NEW.scan(RANGES, 1e9))
    (_,), log = read(tmp_path, content)
    assert log.report.skipped_examples == [(3, "CObservation2DRangeScan: no time")]
    assert f"{log.path}: object 3: CObservation2DRangeScan: no time" in log.report.blemishes()


def test_a_laser_that_turns_the_other_way_or_hangs_upside_down(tmp_path: Path) -> None:
    upright = one(tmp_path, NEW.scan(RANGES, 1e9))
    clockwise = one(tmp_path, NEW.scan(RANGES[::-1], 1e9, right_to_left=False))
    hanging = one(tmp_path, NEW.scan(RANGES[::-1], 1e9, rotation=about_z(0.3) @ about_x(np.pi)))
    both = one(tmp_path, NEW.scan(RANGES, 1e9, rotation=about_x(np.pi), right_to_left=False))
    for scan in (clockwise, hanging, both):
        np.testing.assert_array_equal(scan.ranges, upright.ranges)
        np.testing.assert_allclose(scan.laser.angles, upright.laser.angles)
    assert hanging.laser.mount[2] == pytest.approx(0.3)


def test_a_tilted_laser_is_skipped(tmp_path: Path) -> None:
    tilted = NEW.scan(RANGES, 1e9, rotation=about_x(0.5))
    (_,), log = read(tmp_path, NEW.odometry((0, 0, 0), 1e9) + tilted + NEW.scan(RANGES, 1e9))
    assert log.report.skipped_examples == [(2, "CObservation2DRangeScan: the laser is tilted by 29 deg")]


def test_invalid_readings_are_masked_unless_they_hit_nothing(tmp_path: Path) -> None:
    content = NEW.odometry((0, 0, 0), 1e9) + NEW.scan(
        (*RANGES[:3], 30.0, 0.0), 1e9, valid=[True, False, True, False, False]
    )
    (got,), log = read(tmp_path, content)
    np.testing.assert_array_equal(got.ranges, np.array([1.0, np.nan, 3.0, np.inf, np.nan], np.float32))
    assert (log.report.masked, log.report.no_returns) == (2, 1)


@pytest.mark.parametrize(
    ("beams", "aperture", "last"),
    [(180, np.pi, 89.0), (360, np.pi, 89.5), (181, np.pi, 90.0), (361, np.pi, 90.0), (180, np.pi / 2, 45.0)],
)
def test_beams_are_spread_over_the_aperture_but_for_a_sick_that_lost_its_last(
    tmp_path: Path, beams: int, aperture: float, last: float
) -> None:
    scan = one(tmp_path, NEW.scan([2.0] * beams, 1e9, aperture=aperture))
    assert np.degrees(scan.laser.angles[-1]) == pytest.approx(last, abs=1e-4)


def test_one_laser_is_read_the_others_are_counted(tmp_path: Path) -> None:
    pair = [NEW.scan(RANGES, 1e9, label=label) for label in (b"FRONT", b"REAR\n1")]
    (scan,), log = read(tmp_path, NEW.odometry((0, 0, 0), 1e9) + b"".join(pair))
    assert log.report.other_lasers == {"REAR\\n1": 1}
    assert log.report.laser.startswith("FRONT, 5 beams")
    assert scan.time == 1e9


def test_objects_of_other_classes_are_skipped_and_counted(tmp_path: Path) -> None:
    null = b"\x87nullptr\x88"
    gps = NEW.object("CObservationGPS", 11, bytes(range(256)) * 3)
    body = (NEW.odometry((i, 0, 0), i) + STRANGER + NEW.scan(RANGES, i) + gps + null for i in range(1, 4))
    scans, log = read(tmp_path, gps + b"".join(body) + STRANGER)
    assert [scan.odometry[0] for scan in scans] == [1, 2, 3]
    assert (log.report.lines["CObservationImage"], log.report.lines["CObservationGPS"]) == (4, 4)
    assert log.report.blemishes() == []


def test_objects_of_other_classes_inside_frames(tmp_path: Path) -> None:
    content = b""
    for i in range(4):
        inside = [NEW.scan(RANGES, i + 1), STRANGER] if i % 2 else [STRANGER, NEW.scan(RANGES, i + 1)]
        content += NEW.actions(NEW.movement((1, 0, 0)), STRANGER) + NEW.frame(*inside)
    scans, log = read(tmp_path, content)
    assert [scan.odometry[0] for scan in scans] == [1, 2, 3, 4]
    assert log.report.skipped == 0


def test_a_version_to_come_is_named_and_the_rest_is_read(tmp_path: Path) -> None:
    new = bytearray(NEW.scan(RANGES, 1e9))
    new[new.index(b"RangeScan") + len(b"RangeScan")] = 8
    (_,), log = read(tmp_path, NEW.odometry((0, 0, 0), 1e9) + bytes(new) + NEW.scan(RANGES, 1e9))
    reason = "CObservation2DRangeScan: version 8 of CObservation2DRangeScan, the newest known is 7"
    assert log.report.skipped_examples == [(2, reason)]
    with pytest.raises(LogError, match=r"no usable scan; object 2: .* the newest known is 7"):
        read(tmp_path, NEW.odometry((0, 0, 0), 1e9) + bytes(new) * 3)


def test_a_log_without_odometry_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="scans need odometry observations or actions"):
        read(tmp_path, NEW.scan(RANGES, 1) + NEW.scan(RANGES, 2))


def hostile() -> dict[str, bytes]:
    """Objects whose lengths promise far more than there is."""
    most = struct.pack("<I", 0xFFFFFFFF)
    pose = NEW.pose3d((0, 0, 0), np.eye(3))
    start = struct.pack("<f?f", np.pi, True, 30.0)
    return {
        "beams": NEW.scan(RANGES, 1e9, beams=0xFFFFFFFF),
        "no beams": NEW.scan((), 1e9),
        "label": NEW.object(
            "CObservation2DRangeScan",
            7,
            start + pose + struct.pack("<I", 2) + bytes(8 + 2 + 4) + ticks(1e9) + bytes(4) + most + bytes(40),
        ),
        "matrix": NEW.object(
            "CObservation2DRangeScan", 5, start + pose + NEW.object("CMatrix", 0, most + most + bytes(40), "math")
        ),
        "pose": NEW.object("CObservationOdometry", 2, NEW.matrix(np.eye(4)) + text(b"")),
        "aperture": NEW.scan(RANGES, 1e9, aperture=np.nan),
        "movement": NEW.movement((np.nan, 0, 0)),
        "pdf": NEW.object("CActionRobotMovement2D", 7, struct.pack("<i", 1) + NEW.object("CPosePDFSOG", 2, bytes(99))),
        "no object": b"\x85hello, this is no object",
        "end flag": NEW.odometry((0, 0, 0), 1e9)[:-1] + b"\x07",
    }


@pytest.mark.parametrize("kind", hostile())
def test_a_hostile_object_costs_nothing_but_itself(tmp_path: Path, kind: str) -> None:
    before, after = (NEW.odometry((0, 0, 0), i) + NEW.scan(RANGES, i) for i in (1, 2))
    tracemalloc.start()
    scans, log = read(tmp_path, before + hostile()[kind] + after)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert [scan.time for scan in scans] == [1, 2]
    assert log.report.skipped == 1
    assert log.report.skipped_examples[0][0] == 3
    assert most < 5e6


def test_a_count_is_no_promise(tmp_path: Path) -> None:
    """Containers are read as they come: their counts cost no memory."""
    frame = NEW.frame(NEW.scan(RANGES, 1e9))
    at = frame.index(b"CSensoryFrame") + len(b"CSensoryFrame") + 1
    (_,), log = read(tmp_path, frame[:at] + b"\xff\xff\xff\xff" + frame[at + 4 :])
    assert log.report.skipped == 0


def test_a_log_cut_anywhere_gives_what_it_holds(tmp_path: Path) -> None:
    whole = poses_of_frames(NEW, 7, 7, 7)
    ends = [
        i + len(part) for part in [NEW.scan(RANGES, 1e9)] for i in range(len(whole)) if whole.startswith(part[:24], i)
    ]
    path = tmp_path / "log"
    for end in range(len(whole) // 3 + 60, len(whole)):
        path.write_bytes(whole[:end])
        log = open_log(path)
        times = [scan.time for scan in log.scans()]
        assert times == [1e9 + i for i in range(len(times))]
        assert len(times) == sum(stop <= end for stop in ends)
        assert log.report.skipped == 0


def test_a_log_cut_inside_an_object_says_so(tmp_path: Path) -> None:
    whole = poses_of_frames(NEW, 7, 7, 7)
    _, log = read(tmp_path, whole[:-50])
    assert log.report.damage == "it ends in the middle of object 12, a CObservation2DRangeScan"


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_change_ends_in_scans_or_one_error(tmp_path: Path, data: st.DataObject) -> None:
    whole = bytearray(poses_of_frames(NEW, 7, 5, 1) + STRANGER + NEW.odometry((0, 0, 0), 1) + NEW.scan(RANGES, 2, 3))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(whole) - 1))
        whole[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=8))
    path = tmp_path / "log"
    path.write_bytes(bytes(whole))
    got = outcome(path)
    if isinstance(got, str):
        assert "\n" not in got
    else:
        assert all(np.isfinite(scan.time) and np.isfinite(scan.odometry).all() for scan in got)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    def peak(count: int) -> int:
        blocks = (NEW.odometry((i, 0, 0), i) + NEW.scan([2.0] * 100, i) + STRANGER for i in range(1, count))
        log = written(tmp_path, b"".join(blocks))
        return peak_memory(log)

    assert peak(3600) < 1.2 * peak(1200)


def test_headers_are_found_across_blocks(tmp_path: Path) -> None:
    """Objects of every length before a header, so that the header lies at every place of a block."""
    content = b""
    for i in itertools.count(1):
        content += NEW.object("CObservationImage", 3, bytes(997)) + NEW.odometry((i, 0, 0), i) + NEW.scan(RANGES, i)
        if len(content) > 600_000:
            break
    scans, log = read(tmp_path, content)
    assert len(scans) == log.report.lines["CObservationImage"] == i
    assert log.report.blemishes() == []
