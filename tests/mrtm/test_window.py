"""The part of a log that a robot is played from."""

import math
from pathlib import Path

import pytest

from frontend.readers import open_log
from mrtm.team.errors import SessionError
from mrtm.team.session_file import Member, open_session
from mrtm.team.window import windowed


def log_of(path: Path, times: list[float]) -> Path:
    """A log with a scan at each of these times; its ranges differ, so that none repeats the one before."""
    path.write_text(
        "".join(f"FLASER 3 1 2 {3 + k / 8} {k} 0 0 {k} 0 0 {time} host {k}\n" for k, time in enumerate(times))
    )
    return path


def times(log: Path, begin: float, end: float, start: float = 0.0) -> list[tuple[float, float]]:
    found = windowed(open_log(log), Member("red", log, begin, end, start))
    return [(team_time, scan.time) for team_time, scan in found]


def test_a_window_is_half_open_and_counts_from_the_first_scan(tmp_path: Path) -> None:
    log = log_of(tmp_path / "red.clf", [100, 101, 102, 103, 104])
    assert times(log, 0.0, math.inf) == [(0, 100), (1, 101), (2, 102), (3, 103), (4, 104)]
    assert times(log, 1.0, 3.0, start=50.0) == [(50, 101), (51, 102)]
    assert times(log, 1.5, 2.5) == [(0.5, 102)]


def test_each_scan_is_judged_by_its_own_time(tmp_path: Path) -> None:
    log = log_of(tmp_path / "red.clf", [100, 101, 99.5, 102, 103, 101.5, 104, 102.5])
    assert [scan for _, scan in times(log, 1.0, 3.0)] == [101, 102, 101.5, 102.5]
    assert times(log, 0.0, 1.0) == [(0, 100), (-0.5, 99.5)]  # a log is never without a window


def test_windows_side_by_side_share_out_the_log(tmp_path: Path) -> None:
    stamps = [round(100 + 0.37 * k - 0.9 * (k % 3), 2) for k in range(60)]
    log = log_of(tmp_path / "red.clf", stamps)
    parts = [times(log, begin, end) for begin, end in ((0, 7), (7, 14), (14, math.inf))]
    assert all(parts)
    assert sorted(scan for part in parts for _, scan in part) == sorted(stamps)


def test_a_window_without_a_scan_is_named(tmp_path: Path) -> None:
    log = log_of(tmp_path / "red.clf", [100, 101, 105.25])
    for begin, end in ((2.0, 4.0), (6.0, math.inf)):
        with pytest.raises(SessionError) as caught:
            times(log, begin, end)
        window = f"no scan for red from {begin:g} to {end:g} s"
        assert str(caught.value) == f"{log}: {window}: its scans last 5.2 s; change from and to"


@pytest.mark.slow
def test_intel_is_cut_into_three_whole_robots(data: Path) -> None:
    """The clock of this log steps back 631 times."""
    members = open_session(data / "intel-3robots.yaml").members
    counts = []
    for member in members:
        seen = [time for time, _ in windowed(open_log(member.log), member)]
        assert min(seen) >= 0.0
        assert max(seen) < member.end - member.begin
        counts.append(len(seen))
    assert sum(counts) == 13631
