"""Player 1.x logs: messages, odometry at the laser's time, reflective tags."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frontend.errors import LogError
from frontend.readers import Log, Record, open_log
from frontend.readers.tags import find_tags
from frontend.records import Laser, LaserScan, Sighting


def position(
    time: float, x: float = 0.0, y: float = 0.0, theta: float = 0.0, robot: str = "intel0 7000", index: str = "01"
) -> str:
    pose = f"{x:+07.3f} {y:+07.3f} {theta:+07.3f} +0.000 +0.000 +0.000"
    return f"{time + 0.01:.3f} {robot} position {index} {time:.3f} {pose}"


def laser(
    time: float,
    ranges: Sequence[float] = (2.0,) * 181,
    bright: Mapping[int, int] | None = None,
    robot: str = "intel0 7000",
    index: str = "00",
    first: float = -90.0,
) -> str:
    intensities = bright or {}
    beams = " ".join(f"{r:.3f} {np.radians(first + i):.3f} {intensities.get(i, 0)}" for i, r in enumerate(ranges))
    return f"{time + 0.2:.3f} {robot} laser {index} {time:.3f} {beams}"


def log_of(tmp_path: Path, lines: Iterable[str]) -> Log:
    path = tmp_path / "onboard.log"
    path.write_text("## Player log\n" + "".join(f"{line}\n" for line in lines))
    return open_log(path)


def read(tmp_path: Path, lines: Iterable[str]) -> tuple[list[LaserScan], list[Sighting], Log]:
    log = log_of(tmp_path, lines)
    records = list(log.records())
    scans = [record for record in records if isinstance(record, LaserScan)]
    return scans, [record for record in records if isinstance(record, Sighting)], log


def outcome(path: Path) -> list[Record] | str:
    try:
        return list(open_log(path).records())
    except LogError as error:
        return str(error)


def test_the_lines_of_the_format_description(tmp_path: Path) -> None:
    lines = [
        "1075329039.144 intel0 7000 position 01 1075329039.034 +01.000 -02.000 -0.500 +0.000 +0.000 +0.000",
        "1075329039.148 intel0 7000 laser 00 1075329038.984 0.620 -1.571 0 0.630 -1.553 0 0.640 -1.536 0",
    ]
    (scan,), sightings, log = read(tmp_path, lines)
    assert (log.format, scan.time, sightings) == ("Player", 1075329038.984, [])
    np.testing.assert_array_equal(scan.ranges, np.array([0.62, 0.63, 0.64], np.float32))
    np.testing.assert_allclose(scan.laser.angles, np.radians([-90, -89, -88]), atol=6e-4)
    np.testing.assert_array_equal(scan.odometry, [1, -2, -0.5])
    assert log.report.lines == {"#": 1, "position": 1, "laser": 1}
    assert log.report.blemishes() == []


def test_bearings_are_finer_than_their_three_decimals(tmp_path: Path) -> None:
    (scan,), _, _ = read(tmp_path, [position(0.0), laser(0.0)])
    np.testing.assert_allclose(scan.laser.angles, np.radians(np.arange(-90, 91)), atol=1e-4)


def test_odometry_is_interpolated_at_the_time_of_the_data(tmp_path: Path) -> None:
    def x(time: float) -> float:
        return 0.5 * time

    # As in real logs: the laser's data is older than its line, and older than positions logged before it.
    lines = []
    for i in range(100):
        lines.append(position(0.1 * i, x=x(0.1 * i)))
        if i >= 3 and i % 2:
            lines.append(laser(0.1 * i - 0.13, [2.0, 2.0]))
    lines.append(laser(9.95, [2.0, 2.1]))  # newer than the last position
    scans, _, _ = read(tmp_path, lines)
    assert len(scans) == 50
    assert [scan.time for scan in scans] == sorted(scan.time for scan in scans)
    for scan in scans[:-1]:
        assert scan.odometry[0] == pytest.approx(x(scan.time), abs=1.1e-3)
    assert scans[-1].odometry[0] == pytest.approx(x(9.9), abs=1e-3)


def test_a_turn_past_pi_is_interpolated_the_short_way(tmp_path: Path) -> None:
    lines = [position(0.0, theta=3.1), position(1.0, theta=-3.1), laser(0.5, [2.0, 2.0])]
    (scan,), _, _ = read(tmp_path, lines)
    assert abs(scan.odometry[2]) == pytest.approx(np.pi, abs=1e-6)


def test_nothing_is_interpolated_across_a_step_of_the_clock(tmp_path: Path) -> None:
    lines = [position(10.0, x=1.0), laser(10.5, [2.0, 2.0]), position(5.0, x=3.0), laser(5.0, [2.0, 2.1])]
    scans, _, log = read(tmp_path, lines)
    assert [scan.odometry[0] for scan in scans] == [1.0, 3.0]
    assert log.report.backward_steps == 1
    (scan,), _, _ = read(tmp_path, [position(10.0, x=1.0), position(5.0, x=3.0), laser(9.0, [2.0, 2.0])])
    assert scan.odometry[0] == 3.0


def test_a_time_far_ahead_holds_nothing_up_for_long(tmp_path: Path) -> None:
    lines = [position(0.0), laser(1e9, [2.0, 2.0])]
    for i in range(1, 1500):
        lines += [position(i, x=float(i)), laser(i, [2.0, 2.0])]
    scans, _, _ = read(tmp_path, lines)
    assert [scan.odometry[0] for scan in scans[1:]] == list(range(1, 1500))


def test_other_devices_lasers_and_robots_are_left_out_and_counted(tmp_path: Path) -> None:
    lines = [
        "1.0 intel0 7000 sync 00 1.0",
        "1.0 intel0 7000 power 00 1.0 12.3",
        "1.0 intel0 7000 fiducial 00 1.0 1 2 3",
        "1.0 intel0 7000 lmap 00 1.0 0 0 0",
        position(1.0, x=1.0),
        position(1.0, x=7.0, index="02"),
        position(1.0, x=8.0, robot="intel1 7001"),
        laser(1.0, [2.0, 2.0]),
        laser(1.0, [3.0, 3.0], index="01"),
        laser(1.0, [4.0, 4.0], robot="intel1 7001"),
    ]
    (scan,), _, log = read(tmp_path, lines)
    assert (scan.ranges[0], scan.odometry[0]) == (2.0, 1.0)
    counts = {"#": 1, "sync": 1, "power": 1, "fiducial": 1, "lmap": 1, "position": 3, "laser": 3}
    assert log.report.lines == counts
    assert log.report.other_lasers == {"intel0 7000 laser 01": 1, "intel1 7001 laser 00": 1}


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1.0 intel0 7000 laser", "fewer fields"),
        ("1.0 intel0 7000 laser 00 1.0", "no data or no time"),
        ("1.0 intel0 7000 laser 00 nan 1.0 -1.571 0 1.0 -1.553 0", "no data or no time"),
        ("1.0 intel0 7000 laser 00 1.0 1.0 -1.571 0 1.0 -1.553", "not a range, a bearing and an intensity"),
        ("1.0 intel0 7000 laser 00 1.0 1.0 -1.571 0 1.0 -1.6 0", "do not rise in even steps"),
        ("1.0 intel0 7000 laser 00 1.0 1.0 -1.571 0 1.0 -1.5 0 1.0 -1.3 0", "do not rise in even steps"),
        ("1.0 intel0 7000 laser 00 1.0 1.0 -1.571 0 1.0 nan 0", "do not rise in even steps"),
        ("1.0 intel0 7000 laser 00 1.0 1.0 -1.571 0 1.0 x 0", "not a number"),
        ("1.0 intel0 7000 laser 00 1.0 1.0 -1.571 0 1.0 -1.553 0 1.0 -1.535 0", "3 beams, the scans before have 2"),
        ("1.0 intel0 7000 position 01 1.0 1.0 2.0 3.0", "not x y theta vx vy vtheta"),
        ("1.0 intel0 7000 position 01 1.0 1.0 2.0 inf 0 0 0", "not x y theta vx vy vtheta"),
        ("1.0 intel0 7000 \x07\x01 01 1.0 1.0 2.0", "is not the name of a message"),
    ],
)
def test_what_cannot_be_read_is_skipped_and_named(tmp_path: Path, line: str, reason: str) -> None:
    lines = [position(1.0), laser(1.0, [2.0, 2.0]), line, position(2.0), laser(2.0, [2.0, 2.1])]
    scans, _, log = read(tmp_path, lines)
    assert [scan.time for scan in scans] == [1.0, 2.0]
    ((number, said),) = log.report.skipped_examples
    assert number == 4
    assert reason in said


def test_scans_before_any_odometry_are_skipped_and_a_log_without_is_refused(tmp_path: Path) -> None:
    scans, _, log = read(tmp_path, [laser(0.5, [2.0, 2.0]), position(1.0), laser(1.0, [2.0, 2.1])])
    assert len(scans) == 1
    assert log.report.skipped_examples == [(2, "laser: no position line before it")]
    with pytest.raises(LogError, match="need position lines"):
        read(tmp_path, [laser(0.5), laser(1.0)])


def test_logs_of_later_players_are_not_taken_for_one(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text("1075329039.144 16777343 6665 laser 00 004 001 +0.000 +0.000 -1.5708 1.5708 0.0174 8.0 181\n" * 3)
    with pytest.raises(LogError, match="not a log of a known format"):
        open_log(path)


def test_a_tag_is_one_sighting_seen_from_the_robot(tmp_path: Path) -> None:
    ranges = [5.0] * 181
    ranges[119:123] = [2.0, 2.02, 2.02, 2.0]
    lines = [position(1.0), laser(1.0, ranges, {119: 1, 120: 2, 121: 1, 122: 1}), position(2.0), laser(2.0, ranges)]
    log = log_of(tmp_path, lines)
    records: list[Record] = list(log.records())
    assert [type(record) for record in records] == [LaserScan, Sighting, LaserScan]
    sighting = records[1]
    assert isinstance(sighting, Sighting)
    assert sighting.time == 1.0
    assert sighting.range == pytest.approx(2.01, abs=5e-3)
    assert sighting.bearing == pytest.approx(np.radians(30.5), abs=1e-3)
    assert log.report.sightings == 1
    assert len(list(log.scans())) == 2


def test_a_sighting_is_in_the_robots_frame_wherever_the_laser_sits() -> None:
    laser = Laser(np.radians([0.0, 1.0, 90.0]), np.array([0.5, 1.0, np.pi / 2]), 50.0)
    ranges = np.array([2.0, 2.0, 3.0], np.float32)
    (ahead,) = find_tags(7.0, ranges, np.array([True, False, False]), laser)
    assert (ahead.time, ahead.range, ahead.bearing) == pytest.approx((7.0, np.hypot(0.5, 3.0), np.arctan2(3.0, 0.5)))
    (left,) = find_tags(7.0, ranges, np.array([False, False, True]), laser)
    assert (left.range, left.bearing) == pytest.approx((np.hypot(2.5, 1.0), np.arctan2(1.0, -2.5)))


@pytest.mark.parametrize(
    ("bright", "near", "count"),
    [
        ((10, 11, 13, 14), {}, 1),  # one dim beam in between
        ((10, 11, 14, 15), {}, 2),
        ((10, 100), {}, 2),
        ((10, 11, 12, 13), {12: 1.0, 13: 1.0}, 2),  # two tags, one behind the other
        ((10,), {}, 1),
        (range(10, 60), {}, 0),  # a bright wall
        ((10,), {10: 60.0}, 0),  # hit nothing
        ((10,), {10: 0.0}, 0),
    ],
)
def test_adjacent_bright_beams_are_one_tag(
    tmp_path: Path, bright: Sequence[int], near: Mapping[int, float], count: int
) -> None:
    ranges = [near.get(i, 3.0) for i in range(181)]
    _, sightings, log = read(tmp_path, [position(1.0), laser(1.0, ranges, dict.fromkeys(bright, 1))])
    assert len(sightings) == log.report.sightings == count


def test_a_log_cut_anywhere_gives_what_it_holds(tmp_path: Path) -> None:
    lines = [line for i in range(6) for line in (position(i), laser(i, [2.0 + i] * 5, {2: 1}))]
    whole = ("\n".join(lines) + "\n").encode()
    path = tmp_path / "log"
    most = 0
    for end in range(len(whole) // 2, len(whole)):
        path.write_bytes(whole[:end])
        log = open_log(path)
        times = [scan.time for scan in log.scans()]
        assert times == [float(i) for i in range(len(times))]
        assert {len(scan.ranges) for scan in log.scans()} == {5}
        assert log.report.skipped == (not whole[:end].endswith(b"\n"))
        most = max(most, len(times))
    assert most == 5  # the sixth lacks the end of its line


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    body=st.lists(
        st.one_of(
            st.binary(max_size=80),
            st.text("0123456789 .-+einfa", max_size=60).map(lambda t: "1.0 r 1 laser 00 1.0 " + t),
            st.text("0123456789 .-+einfa", max_size=60).map(lambda t: "1.0 r 1 laser 00 " + t),
            st.text("0123456789 .-+einfa", max_size=60).map(lambda t: "1.0 r 1 position 00 1.0 " + t),
        ).map(lambda part: part if isinstance(part, bytes) else part.encode()),
        max_size=12,
    )
)
def test_any_lines_end_in_records_or_one_error(tmp_path: Path, body: list[bytes]) -> None:
    path = tmp_path / "log"
    path.write_bytes((position(0.0, robot="r 1", index="00") + "\n").encode() + b"\n".join(body) + b"\n")
    got = outcome(path)
    assert isinstance(got, str) or all(np.isfinite(record.time) for record in got)
    assert not isinstance(got, str) or "\n" not in got
