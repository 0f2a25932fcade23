"""Opening a log: compression, recognition, and what is no log."""

import bz2
import gzip
import lzma
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frontend.errors import LogError
from frontend.readers import lines, open_log
from frontend.records import LaserScan
from tests.frontend.memory import peak_memory

HEADER = "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp\n"
LOG = HEADER + "".join(f"FLASER 3 1.0 2.0 {3 + i} {i} 0 0 {i} 0 0 {100 + i}.5 host {i}.0\n" for i in range(40))
COMPRESS: dict[str, Callable[[bytes], bytes]] = {
    "plain": bytes,
    "gzip": gzip.compress,
    "bzip2": bz2.compress,
    "xz": lzma.compress,
}


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def scans(path: Path) -> list[LaserScan]:
    return list(open_log(path).scans())


def outcome(path: Path) -> list[LaserScan] | str:
    try:
        return scans(path)
    except LogError as error:
        return str(error)


@pytest.mark.parametrize("compression", COMPRESS)
def test_compression_is_found_by_content_not_by_suffix(tmp_path: Path, compression: str) -> None:
    path = written(tmp_path / "log.bz2", COMPRESS[compression](LOG.encode()))
    log = open_log(path)
    read = list(log.scans())
    assert (log.path, log.format) == (path, "CARMEN")
    assert [scan.time for scan in read] == [100.5 + i for i in range(40)]
    assert log.report.blemishes() == []
    assert [scan.ranges[2] for scan in read] == [3 + i for i in range(40)]


@pytest.mark.parametrize("compression", ["gzip", "bzip2", "xz"])
def test_several_compressed_pieces_in_one_file_are_one_log(tmp_path: Path, compression: str) -> None:
    half = LOG.index("FLASER", len(LOG) // 2)
    pieces = [COMPRESS[compression](part.encode()) for part in (LOG[:half], LOG[half:])]
    assert len(scans(written(tmp_path / "log", b"".join(pieces)))) == 40


def test_each_pass_reads_anew_and_counts_anew(tmp_path: Path) -> None:
    log = open_log(written(tmp_path / "log", LOG.encode()))
    assert [len(list(log.scans())) for _ in range(2)] == [40, 40]
    assert log.report.scans == 40
    assert log.report.duration == 39.0


@pytest.mark.parametrize("compression", ["gzip", "bzip2", "xz"])
def test_a_file_cut_off_gives_what_it_holds(tmp_path: Path, compression: str) -> None:
    noise = np.random.default_rng(1)
    text = "".join(
        f"FLASER 50 {' '.join(f'{r:.6f}' for r in noise.uniform(1, 9, 50))} 0 0 0 {i} 0 0 {i}.5 host 0\n"
        for i in range(3000)
    )
    whole = COMPRESS[compression](text.encode())
    log = open_log(written(tmp_path / "log", whole[: len(whole) * 2 // 3]))
    got = list(log.scans())
    assert 0 < len(got) < 3000
    assert [scan.time for scan in got] == [i + 0.5 for i in range(len(got))]
    assert "cut off or damaged" in log.report.damage
    assert any("cut off" in line for line in log.report.blemishes())


@pytest.mark.parametrize("compression", COMPRESS)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.floats(0, 1), flip=st.booleans())
def test_truncation_and_damage_anywhere_end_in_scans_or_one_error(
    tmp_path: Path, compression: str, where: float, flip: bool
) -> None:
    whole = COMPRESS[compression](LOG.encode())
    at = int(where * (len(whole) - 1))
    content = whole[:at] + (bytes([whole[at] ^ 0x55]) + whole[at + 1 :] if flip else b"")
    got = outcome(written(tmp_path / "log", content))
    if isinstance(got, str):
        assert "\n" not in got
        assert got.startswith(str(tmp_path / "log"))
    else:
        assert 0 < len(got) <= 40
        assert all(np.isfinite(scan.time) and np.isfinite(scan.odometry).all() for scan in got)


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    body=st.lists(
        st.one_of(
            st.binary(max_size=80),
            st.text("0123456789 .-+einfa", max_size=60).map(lambda t: b"FLASER " + t.encode()),
            st.text("0123456789 .-+einfa", max_size=60).map(lambda t: b"ROBOTLASER1 0 " + t.encode()),
            st.text("0123456789 .-+einfa", max_size=60).map(lambda t: b"ODOM " + t.encode()),
        ),
        max_size=12,
    )
)
def test_any_lines_end_in_scans_or_one_error(tmp_path: Path, body: list[bytes]) -> None:
    path = written(tmp_path / "log", b"# CARMEN Logfile\n" + b"\n".join(body))
    got = outcome(path)
    assert got
    assert not isinstance(got, str) or "\n" not in got


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (gzip.compress(b"", mtime=0), "is empty"),
        (gzip.compress(LOG.encode(), mtime=0)[:8], "cut off or damaged after 0 bytes"),
        (bytes(range(256)) * 40, "not a log of a known format (CARMEN"),
        (b"time,x,y\n1,2,3\n", "not a log of a known format (CARMEN"),
        (HEADER.encode(), "no usable scan among its lines (1 #)"),
        (b"ODOM 0 0 0 0 0 0 1 host 1\n", "no usable scan among its lines (1 ODOM)"),
        (b"FLASER 3 1 2\n", "no usable scan; line 1: FLASER: "),
    ],
)
def test_what_is_no_log_is_one_line(tmp_path: Path, content: bytes, said: str) -> None:
    path = written(tmp_path / "odd.clf", content)
    with pytest.raises(LogError) as caught:
        scans(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert said in str(caught.value)


def test_missing_file_and_directory(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file"):
        open_log(tmp_path / "missing.clf")
    with pytest.raises(LogError, match="is a directory"):
        open_log(tmp_path)


@pytest.mark.parametrize("where", ["first", "middle", "last"])
def test_an_absurdly_long_line_is_skipped(tmp_path: Path, where: str) -> None:
    rows = LOG.encode().splitlines()
    at = {"first": 1, "middle": 20, "last": len(rows)}[where]
    rows.insert(at, b"FLASER 9 " + b"1.0 " * (lines.LONGEST_LINE // 2))
    log = open_log(written(tmp_path / "log", b"\n".join(rows) + b"\n"))
    assert len(list(log.scans())) == 40
    assert log.report.skipped_examples == [(at + 1, f"longer than {lines.LONGEST_LINE} bytes")]


def test_lines_are_numbered_across_blocks(tmp_path: Path) -> None:
    filler = b"# " + b"x" * 1000 + b"\n"
    many = 3 * lines.BLOCK // len(filler)
    log = open_log(written(tmp_path / "log", LOG.encode() + filler * many + b"FLASER 1\n"))
    assert len(list(log.scans())) == 40
    assert [number for number, _ in log.report.skipped_examples] == [LOG.count("\n") + many + 1]


@pytest.mark.slow
def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    def peak(count: int) -> int:
        rows = (f"FLASER 50 {'1.25 ' * 50}0 0 0 {i} 0 0 {i} host 0\n" for i in range(count))
        log = open_log(written(tmp_path / "log", gzip.compress("".join(rows).encode())))
        return peak_memory(log)

    assert peak(12000) < 1.2 * peak(3000)


@pytest.mark.parametrize(
    ("name", "count", "beams", "backward", "duration"),
    [("intel", 13631, 180, 631, 2691.3), ("aces", 7374, 180, 0, 1365.5), ("mit-csail", 1988, 361, 0, 424.0)],
)
def test_real_logs(data: Path, name: str, count: int, beams: int, backward: int, duration: float) -> None:
    path = data / f"{name}.clf.bz2"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    log = open_log(path)
    lasers = set()
    for scan in log.scans():
        lasers.add(id(scan.laser))
        assert len(scan.ranges) == len(scan.laser.angles) == beams
        assert -np.pi < scan.odometry[2] <= np.pi
    assert (log.report.scans, log.report.backward_steps, log.report.skipped) == (count, backward, 0)
    assert len(lasers) == 1
    assert log.report.duration == pytest.approx(duration, abs=0.1)
    assert log.report.no_returns > 0
    assert scan.laser.max_range == 50.0
    np.testing.assert_array_equal(scan.laser.mount, 0.0)
    assert scan.laser.angles[0] == pytest.approx(-np.pi / 2)


def test_odometry_that_jumps_farther_than_a_robot_drives_goes_on_from_where_it_was(tmp_path: Path) -> None:
    """Once there and back, and once for good; a jump that a clock at rest may explain is left as it is."""
    way = [0.1 * i for i in range(40)]
    told = [x + 2e4 * (i == 10) + 500.0 * (i >= 20) + 15.0 * (i >= 30) for i, x in enumerate(way)]
    lines = [f"FLASER 3 1.0 2.0 3.0 {x} 0 0 {x} 0 0 {100 + i}.5 host {i}.0\n" for i, x in enumerate(told)]
    log = open_log(written(tmp_path / "log", (HEADER + "".join(lines)).encode()))
    steps = np.diff([scan.odometry[0] for scan in log.scans()])
    expected = np.full(39, 0.1)
    expected[[9, 10, 19]] = 0.0
    expected[29] = 15.1
    np.testing.assert_allclose(steps, expected, atol=1e-9)
    (blemish,) = log.report.blemishes()
    assert blemish == (
        f"{log.path}:12: odometry jumps by 20000 m, farther than a robot drives between two scans: taken as no motion, "
        "3 times"
    )


def test_odometry_in_millimetres_is_asked_about(tmp_path: Path) -> None:
    lines = [f"FLASER 3 1.0 2.0 3.0 {90 * i} 0 0 {90 * i} 0 0 {100 + i}.5 host {i}.0\n" for i in range(40)]
    log = open_log(written(tmp_path / "log", (HEADER + "".join(lines)).encode()))
    assert {scan.odometry[0] for scan in log.scans()} == {0.0}
    (blemish,) = log.report.blemishes()
    assert blemish.endswith("39 times; is it in metres?")


def test_times_that_are_none_are_left_out(tmp_path: Path) -> None:
    nanoseconds = LOG.replace(" host", "000000000000 host", 1)
    log = open_log(written(tmp_path / "log", nanoseconds.replace("100.5", "100000000000000", 1).encode()))
    assert len(list(log.scans())) == 39
    assert "is not a time in seconds" in log.report.blemishes()[1]


def test_a_mark_of_the_byte_order_costs_no_line(tmp_path: Path) -> None:
    content = LOG.removeprefix(HEADER).encode()
    assert len(scans(written(tmp_path / "log", b"\xef\xbb\xbf" + content))) == 40


def test_a_pipe_is_no_log(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(LogError, match="is a pipe or a device, not a file; save it first"):
        open_log(tmp_path / "pipe")


def test_what_damage_makes_of_a_compressed_log_is_called_damage(tmp_path: Path) -> None:
    content = bytearray(bz2.compress(b"".join(b"%d nonsense %d\n" % (i, i * i) for i in range(40_000))))
    content[len(content) // 20] ^= 4
    with pytest.raises(LogError, match="compressed data is cut off or damaged"):
        open_log(written(tmp_path / "log", bytes(content)))
