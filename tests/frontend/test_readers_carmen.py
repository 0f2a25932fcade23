"""CARMEN messages, one kind at a time, and every blemish a line can have."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from frontend.errors import LogError
from frontend.readers import Log, open_log
from frontend.records import LaserScan


def log_of(tmp_path: Path, lines: Iterable[str]) -> Log:
    path = tmp_path / "log.clf"
    path.write_text("# CARMEN Logfile\n" + "".join(f"{line}\n" for line in lines))
    return open_log(path)


def read(tmp_path: Path, lines: Iterable[str]) -> tuple[list[LaserScan], Log]:
    log = log_of(tmp_path, lines)
    return list(log.scans()), log


def join(*parts: object) -> str:
    return " ".join(str(part) for part in parts)


def flaser(
    ranges: Sequence[object] = (1.0, 2.0, 3.0),
    laser: Sequence[object] = (0, 0, 0),
    odometry: Sequence[object] = (0, 0, 0),
    time: object = 1.0,
    name: str = "FLASER",
) -> str:
    return join(name, len(ranges), *ranges, *laser, *odometry, time, "host", 0.0)


def robotlaser(
    ranges: Sequence[object] = (1.0, 2.0, 3.0),
    laser: Sequence[object] = (0, 0, 0),
    robot: Sequence[object] = (0, 0, 0),
    time: object = 1.0,
    name: str = "ROBOTLASER1",
    geometry: tuple[float, float, float] = (-0.5, 1.0, 0.5),
    max_range: float = 20.0,
    remissions: Sequence[object] | None = (),
    tail: Sequence[object] = (0, 0, 0.3, 0.3, 1e6),
) -> str:
    remitted = [] if remissions is None else [len(remissions), *remissions]
    config = (0, *geometry, max_range, 0.01, 0)
    return join(name, *config, len(ranges), *ranges, *remitted, *laser, *robot, *tail, time, "host", 0.0)


def rawlaser(ranges: Sequence[object] = (1.0, 2.0, 3.0), time: object = 1.0, name: str = "RAWLASER1") -> str:
    return join(name, 0, -0.5, 1.0, 0.5, 20.0, 0.01, 0, len(ranges), *ranges, 2, 7, 8, time, "host", 0.0)


def odom(x: object = 0.0, y: object = 0.0, theta: object = 0.0, time: object = 1.0) -> str:
    return join("ODOM", x, y, theta, 0, 0, 0, time, "host", 0.0)


def test_flaser(tmp_path: Path) -> None:
    (scan,), log = read(tmp_path, [flaser((1.5, 2.5, 3.5), (9, 8, 7), (4, 5, 4.0), 976052857.337530)])
    assert scan.time == 976052857.337530
    assert scan.ranges.dtype == np.float32
    np.testing.assert_array_equal(scan.ranges, [1.5, 2.5, 3.5])
    np.testing.assert_allclose(scan.odometry, [4, 5, 4.0 - 2 * np.pi])
    assert log.report.lines == {"#": 1, "FLASER": 1}


@pytest.mark.parametrize(
    ("beams", "first", "last"),
    [
        *((180, -90, 89), (181, -90, 90), (360, -90, 89.5), (361, -90, 90), (401, -50, 50), (541, -135, 135)),
        *((91, -90, 90), (90, -90, 90), (1081, -135, 135), (683, -341 * 360 / 1024, 341 * 360 / 1024)),
    ],
)
def test_old_messages_imply_the_bearings(tmp_path: Path, beams: int, first: float, last: float) -> None:
    (scan,), _ = read(tmp_path, [flaser([2.0] * beams)])
    assert len(scan.laser.angles) == beams
    np.testing.assert_allclose(np.degrees(scan.laser.angles[[0, -1]]), [first, last], atol=1e-9)
    np.testing.assert_allclose(np.diff(scan.laser.angles, 2), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("remissions", "tail"),
    [
        ((), (0, 0, 0.3, 0.3, 1e6)),
        ((5, 6, 7), (0, 0, 0.3, 0.3, 1e6)),
        (None, (0, 0, 0.3, 0.3, 1e6)),
        (None, (0, 0, 0.3, 0.3)),
    ],
)
def test_robotlaser_in_all_its_ages(
    tmp_path: Path, remissions: Sequence[object] | None, tail: Sequence[object]
) -> None:
    line = robotlaser(laser=(1.2, 2, 0), robot=(1, 2, 0), time=7.5, remissions=remissions, tail=tail)
    (scan,), _ = read(tmp_path, [line])
    assert scan.time == 7.5
    np.testing.assert_array_equal(scan.ranges, [1, 2, 3])
    np.testing.assert_array_equal(scan.odometry, [1, 2, 0])
    np.testing.assert_allclose(scan.laser.angles, [-0.5, 0, 0.5])
    np.testing.assert_allclose(scan.laser.mount, [0.2, 0, 0], atol=1e-12)
    assert scan.laser.max_range == 20.0


def test_rawlaser_takes_odometry_between_the_odom_lines(tmp_path: Path) -> None:
    lines = [
        rawlaser(time=0.5),
        odom(0, 0, 3.0, time=1.0),
        rawlaser(time=1.25),
        rawlaser(time=1.5),
        odom(1, 2, -3.0, time=2.0),
        rawlaser(time=2.5),
    ]
    scans, log = read(tmp_path, lines)
    assert [scan.time for scan in scans] == [1.25, 1.5, 2.5]
    turn = 2 * np.pi - 6.0
    np.testing.assert_allclose(scans[0].odometry, [0.25, 0.5, 3.0 + 0.25 * turn])
    np.testing.assert_allclose(np.abs(scans[1].odometry), [0.5, 1.0, np.pi], atol=1e-9)
    np.testing.assert_allclose(scans[2].odometry, [1, 2, -3.0])
    assert log.report.skipped_examples == [(2, "RAWLASER1: no ODOM line before it")]


def test_rawlaser_goes_on_when_odometry_stops(tmp_path: Path) -> None:
    scans, _ = read(tmp_path, [odom(1, 2, 0.5, time=0), *(rawlaser(time=1 + 0.1 * i) for i in range(500))])
    assert [scan.time for scan in scans] == [1 + 0.1 * i for i in range(500)]
    assert all(np.array_equal(scan.odometry, [1, 2, 0.5]) for scan in scans)


def test_rawlaser_without_odom(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="RAWLASER1 needs ODOM lines"):
        read(tmp_path, [rawlaser(), rawlaser(time=2)])


def turning(mount: tuple[float, float, float], count: int = 30) -> list[str]:
    """FLASER lines of a robot that drives a curve with its laser at ``mount``."""
    lines = []
    for i in range(count):
        x, y, t = 0.1 * i, 0.02 * i, 0.05 * i
        c, s = np.cos(t), np.sin(t)
        laser = (x + c * mount[0] - s * mount[1], y + s * mount[0] + c * mount[1], t + mount[2])
        lines.append(flaser((1, 2, 3), [f"{v:.6f}" for v in laser], (x, y, t), i))
    return lines


@pytest.mark.parametrize("mount", [(0.2, 0.05, 0.1), (-0.15, 0, np.pi)])
def test_mount_follows_from_the_poses_in_the_lines(tmp_path: Path, mount: tuple[float, float, float]) -> None:
    scans, _ = read(tmp_path, ["PARAM robot_frontlaser_offset 0.7 nohost 0", *turning(mount)])
    difference = scans[0].laser.mount - mount
    np.testing.assert_allclose([*difference[:2], np.sin(difference[2])], 0, atol=1e-5)


def test_a_corrected_trajectory_is_no_mount(tmp_path: Path) -> None:
    # The laser's pose is that of another frame, as in logs that a mapper has been over.
    lines = [flaser((1, 2, 3), (0.5, 0.1 * i, 1.5), (0.1 * i, 0, 0.02 * i), i) for i in range(60)]
    scans, _ = read(tmp_path, ["PARAM robot_frontlaser_offset 0.3 nohost 0", *lines])
    np.testing.assert_allclose(scans[0].laser.mount, [0.3, 0, 0])


def test_parameters_give_the_mount_if_the_lines_do_not(tmp_path: Path) -> None:
    parameters = [
        "PARAM robot_frontlaser_offset 0.3 nohost 0",
        "PARAM robot_frontlaser_side_offset 0.1 nohost 0",
        "PARAM robot_frontlaser_angular_offset 0.2 nohost 0",
        "PARAM robot_frontlaser_use on nohost 0",
        "PARAM robot_name",
    ]
    scans, log = read(tmp_path, [*parameters, flaser()])
    np.testing.assert_allclose(scans[0].laser.mount, [0.3, 0.1, 0.2])
    assert log.report.lines["PARAM"] == 5


@pytest.mark.parametrize("line", [flaser(name="RLASER"), robotlaser(name="ROBOTLASER2")])
def test_rear_lasers_look_back(tmp_path: Path, line: str) -> None:
    (scan,), _ = read(tmp_path, ["PARAM robot_rearlaser_offset -0.25 nohost 0", line])
    np.testing.assert_allclose(scan.laser.mount, [-0.25, 0, np.pi])


def test_of_several_lasers_the_front_one_is_read(tmp_path: Path) -> None:
    lines = [odom(), flaser([5.0] * 4, name="RLASER"), rawlaser(), flaser(), rawlaser(name="RAWLASER3")] * 3
    scans, log = read(tmp_path, [*lines, flaser(time=2)])
    assert {len(scan.ranges) for scan in scans} == {3}
    assert log.report.laser.startswith("FLASER, 3 beams")
    assert log.report.other_lasers == {"RLASER": 3, "RAWLASER1": 3, "RAWLASER3": 3}
    assert any("left out 3 scans of another laser, RLASER" in line for line in log.report.blemishes())


def test_unknown_messages_are_counted_by_name(tmp_path: Path) -> None:
    lines = ["SYNC tag 1 host 0", "TRUEPOS 0 0 0 0 0 0 1 host 0", "NMEAGGA 1 2", "", "  ", "NMEAGGA 3", "\x07\x01 2"]
    _, log = read(tmp_path, [*lines, flaser()])
    assert log.report.lines == {"#": 1, "SYNC": 1, "TRUEPOS": 1, "NMEAGGA": 2, "FLASER": 1}
    assert log.report.skipped_examples == [(8, r"'\x07\x01' is not the name of a message")]


def test_a_flood_of_names_does_not_fill_the_memory(tmp_path: Path) -> None:
    _, log = read(tmp_path, [flaser(), *(f"NAME{i} 1" for i in range(1000))])
    assert len(log.report.lines) < 60
    assert sum(log.report.lines.values()) == 1002


def test_unusable_ranges_are_masked_and_counted(tmp_path: Path) -> None:
    ranges = ("nan", "-1.0", "0.0", "-inf", "0.001", "inf", "81.91", "50", "49.9")
    (scan,), log = read(tmp_path, [flaser(ranges)])
    inf, nan = np.inf, np.nan
    np.testing.assert_array_equal(scan.ranges, np.array([nan] * 4 + [0.001, inf, inf, inf, 49.9], np.float32))
    assert (log.report.readings, log.report.masked, log.report.no_returns) == (9, 4, 3)
    assert any("masked 4 unusable ranges" in line for line in log.report.blemishes())


@pytest.mark.parametrize(
    ("lines", "max_range"),
    [
        ([flaser((1, 2, 30))], 50.0),
        ([flaser((1, 2, 8.19))], 8.18),
        ([flaser((1, 2, 8.183)), flaser((1, 2, 8.3), time=2)], 50.0),
        ([flaser((1, 2, 16.38)), flaser((1, 81.91, 3), time=2)], 16.37),
        (["PARAM robot_front_laser_max 30 nohost 0", flaser((1, 2, 30))], 30.0),
        (["PARAM robot_front_laser_max 30 nohost 0", flaser((1, 2, 45))], 50.0),
        (["PARAM robot_front_laser_max 81.9 nohost 0", flaser((1, 2, 45))], 50.0),
        (["PARAM robot_front_laser_max 0 nohost 0", flaser((1, 2, 3))], 50.0),
        ([robotlaser((1, 5.6, 3), max_range=5.6)], 5.6),
        ([robotlaser((1, 5.6, 3), max_range=0.0)], 50.0),
    ],
)
def test_where_nothing_was_hit(tmp_path: Path, lines: list[str], max_range: float) -> None:
    scans, _ = read(tmp_path, lines)
    for scan in scans:
        assert scan.laser.max_range == max_range
        assert not np.any(np.isfinite(scan.ranges) & (scan.ranges >= max_range))
    if max_range < 50 and len(scans) == 1:
        assert np.isinf(scans[0].ranges).sum() == 1


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("FLASER", "FLASER: too few fields"),
        ("FLASER host 1", "FLASER: only 0 fields"),
        ("FLASER 3 host 1", "FLASER: 3 readings in 1 fields"),
        ("FLASER 3 1 2 3 0 0 0 0 0 0 1 host", "FLASER: 10 fields do not fit 3 readings"),
        (flaser((1, "x", 3)), "FLASER: a field is not a number"),
        (flaser((1, "1_0", 3)), "FLASER: a field is not a number"),
        (flaser() + " 5", "FLASER: a field is not a number"),
        ("FLASER 4 1 2 3 0 0 0 0 0 0 1 host 0", "FLASER: 11 fields do not fit 4 readings"),
        ("FLASER 2 1 2 3 0 0 0 0 0 0 1 host 0", "FLASER: 11 fields do not fit 2 readings"),
        ("FLASER 1000000000 1 2 3 0 0 0 0 0 0 1 host 0", "FLASER: 1e+09 readings in 11 fields"),
        ("FLASER -3 1 2 3 0 0 0 0 0 0 1 host 0", "FLASER: -3 readings in 11 fields"),
        ("FLASER 0 0 0 0 0 0 0 1 host 0", "FLASER: 0 readings in 8 fields"),
        ("FLASER nan 1 2 3 0 0 0 0 0 0 1 host 0", "FLASER: nan readings in 11 fields"),
        ("FLASER 2.5 1 2 3 0 0 0 0 0 0 1 host 0", "FLASER: 2.5 readings in 11 fields"),
        (flaser(odometry=("nan", 0, 0)), "odometry (nan, 0, 0) is not a pose"),
        (flaser(odometry=(0, "1e300", 0)), "odometry (0, 1e+300, 0) is not a pose"),
        (flaser(odometry=(0, 0, "inf")), "odometry (0, 0, inf) is not a pose"),
        (flaser(time="nan"), "time nan is not a time in seconds"),
    ],
)
def test_a_line_that_cannot_be_read_is_skipped_and_named(tmp_path: Path, line: str, reason: str) -> None:
    scans, log = read(tmp_path, [flaser(time=1), line, flaser(time=2)])
    assert [scan.time for scan in scans] == [1, 2]
    assert log.report.skipped == 1
    assert log.report.skipped_examples == [(3, reason)]
    assert f"{log.path}:3: {reason}" in log.report.blemishes()


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (robotlaser(remissions=(1, 2)).replace(" 2 1 2 ", " 3 1 2 "), "fields do not fit 3 readings"),
        (robotlaser(geometry=(-0.5, 1.0, 0.0)), "3 beams from -0.5 in steps of 0 rad"),
        (robotlaser(geometry=(float("nan"), 1.0, 0.5)), "3 beams from nan in steps of 0.5 rad"),
        ("ROBOTLASER1 0 -0.5 1 host 0", "only 3 fields"),
    ],
)
def test_robotlaser_lines_that_cannot_be_read(tmp_path: Path, line: str, reason: str) -> None:
    scans, log = read(tmp_path, [robotlaser(time=1), line, robotlaser(time=2)])
    assert [scan.time for scan in scans] == [1, 2]
    ((number, said),) = log.report.skipped_examples
    assert (number, said.startswith("ROBOTLASER1: ") and reason in said) == (3, True)


def test_only_the_first_ten_reasons_are_kept(tmp_path: Path) -> None:
    _, log = read(tmp_path, [flaser(), *["FLASER 3 1"] * 25])
    assert log.report.skipped == 25
    assert [number for number, _ in log.report.skipped_examples] == list(range(3, 13))


def test_a_clock_that_steps_back_keeps_the_order_of_the_file(tmp_path: Path) -> None:
    times = [10.0, 11.0, 10.5, 12.0, 3.0]
    scans, log = read(tmp_path, [flaser((1, 2, i + 1), time=t) for i, t in enumerate(times)])
    assert [scan.time for scan in scans] == times
    assert log.report.backward_steps == 2
    assert (log.report.first_time, log.report.last_time, log.report.duration) == (3.0, 12.0, 9.0)
    assert f"{log.path}: the clock steps back 2 times" in log.report.blemishes()


def test_repeated_scans_are_dropped_once_each(tmp_path: Path) -> None:
    again = flaser(("nan", 2, 3), time=1)
    scans, log = read(tmp_path, [again, again, again, flaser(("nan", 2, 3), time=2), flaser((1, 2, 3), time=2)])
    assert [scan.time for scan in scans] == [1, 2, 2]
    assert log.report.duplicates == 2


@pytest.mark.parametrize("after", [3, 1500])
def test_a_change_of_beam_count_is_refused(tmp_path: Path, after: int) -> None:
    log = log_of(tmp_path, [*(flaser(time=i) for i in range(after)), flaser([1.0] * 5, time=after)])
    with pytest.raises(LogError, match=rf"log\.clf:{after + 2}: the scan has 5 beams, the ones before 3"):
        list(log.scans())


def test_a_change_of_bearings_is_refused(tmp_path: Path) -> None:
    lines = [robotlaser(time=1), robotlaser(time=2, geometry=(-1.0, 2.0, 1.0))]
    with pytest.raises(LogError, match=r"log\.clf:3: the beams go from -1 in steps of 1 rad"):
        read(tmp_path, lines)


def test_lines_end_as_they_like(tmp_path: Path) -> None:
    scans, log = read(tmp_path, [flaser(time=1) + "\r", "\t" + flaser(time=2).replace(" ", "  ") + "  "])
    assert [scan.time for scan in scans] == [1, 2]
    assert log.report.blemishes() == []


def test_all_scans_share_one_laser_and_own_their_arrays(tmp_path: Path) -> None:
    scans, _ = read(tmp_path, [flaser(time=i) for i in range(150)])
    assert all(scan.laser is scans[0].laser for scan in scans)
    assert all(scan.ranges.base is None and scan.odometry.base is None for scan in scans)
