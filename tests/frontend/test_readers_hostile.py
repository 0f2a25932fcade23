"""Logs that are cut, damaged or made to do harm: what a reader gives is what the log holds, at a bounded cost."""

import bz2
import gzip
import lzma
import resource
import struct
import tracemalloc
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frontend.errors import LogError
from frontend.readers import Log, open_log
from frontend.records import LaserScan
from tools.fuzzing.seeds import LOGS
from tools.fuzzing.targets import Target, holds, read_log

pytestmark = pytest.mark.slow  # thousands of damaged inputs

COMPRESS: dict[str, Callable[[bytes], bytes]] = {
    "plain": bytes,
    "gzip": gzip.compress,
    "bzip2": bz2.compress,
    "xz": lzma.compress,
}
SEEDS = [
    pytest.param(content, id=f"{name}-{number}") for name, logs in LOGS.items() for number, content in enumerate(logs)
]
ANY_LOG = st.sampled_from([content for logs in LOGS.values() for content in logs])


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def scans_of(path: Path) -> tuple[list[LaserScan], Log | None]:
    """The scans of a log and the log, or none if it is refused."""
    try:
        log = open_log(path)
        return list(log.scans()), log
    except LogError:
        return [], None


def assert_beginning(part: list[LaserScan], whole: list[LaserScan]) -> None:
    """A cut log gives the first scans of the whole log, unchanged.

    Only the last one may have other odometry: what would have followed, to interpolate with, is gone.
    """
    assert len(part) <= len(whole)
    for number, (got, true) in enumerate(zip(part, whole, strict=False)):
        assert got.time == true.time
        np.testing.assert_array_equal(got.ranges, true.ranges)
        np.testing.assert_array_equal(got.laser.angles, true.laser.angles)
        np.testing.assert_array_equal(got.laser.mount, true.laser.mount)
        if number < len(part) - 1:
            np.testing.assert_array_equal(got.odometry, true.odometry)


@pytest.mark.parametrize("content", SEEDS)
def test_a_log_cut_at_any_byte_gives_the_scans_it_holds(tmp_path: Path, content: bytes) -> None:
    whole, _ = scans_of(written(tmp_path / "whole", content))
    counts = []
    for end in range(len(content)):
        part, _ = scans_of(written(tmp_path / "part", content[:end]))
        assert_beginning(part, whole)
        counts.append(len(part))
    assert counts == sorted(counts)
    assert counts[-1] >= len(whole) - 1
    assert set(counts) >= set(range(1, len(whole)))  # each scan is there as soon as it can be


@pytest.mark.parametrize("compression", ["gzip", "bzip2", "xz"])
@pytest.mark.parametrize("content", SEEDS)
def test_a_compressed_log_cut_at_any_byte_gives_the_scans_it_holds(
    tmp_path: Path, content: bytes, compression: str
) -> None:
    whole, _ = scans_of(written(tmp_path / "whole", content))
    packed = COMPRESS[compression](content)
    for end in range(0, len(packed), 3):
        part, log = scans_of(written(tmp_path / "part", packed[:end]))
        assert_beginning(part, whole)
        assert log is None or "cut off or damaged" in log.report.damage


def edited(content: bytes, edits: list[tuple[float, int, bytes]]) -> bytes:
    """The content with bytes put in place of others: (where, how many, by what)."""
    for where, count, by in edits:
        at = int(where * len(content))
        content = content[:at] + by + content[at + count :]
    return content


NUMBERS = st.one_of(st.integers(), st.floats()).map(lambda value: f" {value} ".encode())
INTEGERS = st.integers(0, 2**32 - 1).map(lambda value: struct.pack("<I", value))
EDITS = st.lists(
    st.tuples(st.floats(0, 1), st.integers(0, 40), st.one_of(st.binary(max_size=12), NUMBERS, INTEGERS)),
    min_size=1,
    max_size=6,
)


@settings(max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    content=ANY_LOG,
    edits=EDITS,
    compression=st.sampled_from(sorted(COMPRESS)),
    packed_edits=st.one_of(st.just([]), EDITS),
)
def test_edited_anywhere_a_log_ends_in_sound_scans_or_one_line(
    tmp_path: Path,
    content: bytes,
    edits: list[tuple[float, int, bytes]],
    compression: str,
    packed_edits: list[tuple[float, int, bytes]],
) -> None:
    packed = edited(COMPRESS[compression](edited(content, edits)), packed_edits)
    holds(Target("log", [], read_log), written(tmp_path / "log", packed))


def peak_of_reading(path: Path) -> int:
    tracemalloc.start()
    try:
        scans_of(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@contextmanager
def memory_bounded(size: int) -> Iterator[None]:
    """Inside, the process can have this many bytes more than it has now."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


ONES = b"1 " * 60_000
TRIPLES = b"".join(b"1 %.4f 0 " % (beam / 8000) for beam in range(10_000))
BOMBS: dict[str, tuple[bytes, Callable[[int], bytes]]] = {
    "half a scan": (b"# CARMEN Logfile\n", lambda number: b"FLASER " + ONES + b"\n"),
    "scans": (b"# CARMEN Logfile\n", lambda number: b"FLASER 60000 %s0 0 0 0 0 %d 1 host 1\n" % (ONES, number)),
    "words": (b"# CARMEN Logfile\n", lambda number: b"x" * 120_000 + b"\n"),
    "no line end": (b"# CARMEN Logfile\n", lambda number: b"y" * 120_000),
    "triples": (
        LOGS["Player"][0],
        lambda number: b"1.0 robot0 7000 laser 00 %d.5 " % number + TRIPLES + b"\n",
    ),
    "zeros": (LOGS["MRPT rawlog"][0], lambda number: bytes(120_000)),
    "names": (LOGS["MRPT rawlog"][0], lambda number: b"\x97CObservation" * 2_000),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_that_unpacks_to_much_costs_little_memory(tmp_path: Path, name: str) -> None:
    start, filler = BOMBS[name]
    path = tmp_path / "bomb"
    with gzip.open(path, "wb", compresslevel=1) as file:
        file.write(start)
        for number in range(700):
            file.write(filler(number))
    with memory_bounded(150_000_000):
        _, log = scans_of(path)
    assert log is None or not log.report.damage.startswith("the compressed")  # as it would be, had memory run out


@pytest.mark.parametrize("told", [0x7FFFFFFF, 0xFFFFFFFF, 1 << 20, 8193])
def test_a_hostile_count_costs_no_memory(tmp_path: Path, told: int) -> None:
    content = LOGS["MRPT rawlog"][0]
    right = struct.pack("<I", 6)
    hostile = content.replace(right, struct.pack("<I", told))
    assert hostile != content
    assert peak_of_reading(written(tmp_path / "log", hostile)) < 5_000_000
    text = LOGS["CARMEN"][0].replace(b"FLASER 6 ", b"FLASER %d " % told)
    assert peak_of_reading(written(tmp_path / "log", text)) < 5_000_000


def test_a_hostile_dictionary_size_is_damage(tmp_path: Path) -> None:
    """The header of an xz file says how much memory unpacking takes; here 4 GiB."""
    packed = bytearray(lzma.compress(LOGS["CARMEN"][0], check=lzma.CHECK_NONE))
    header = packed[12 : 12 + 4 * (packed[12] + 1)]
    assert header[2:4] == b"\x21\x01"  # LZMA2 with one byte of properties
    header[4] = 40
    header[-4:] = struct.pack("<I", zlib.crc32(header[:-4]))
    packed[12 : 12 + len(header)] = header
    path = written(tmp_path / "log", bytes(packed))
    with memory_bounded(1 << 30), pytest.raises(LogError, match="cut off or damaged after 0 bytes"):
        open_log(path)


@pytest.mark.parametrize("number", [b"1e300", b"-1e300", b"1e400", b"inf", b"nan"])
@pytest.mark.parametrize("content", SEEDS)
def test_a_monstrous_number_anywhere_warns_nobody(tmp_path: Path, content: bytes, number: bytes) -> None:
    fields = content.split(b" ")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for at in range(0, len(fields), 7):
            hostile = b" ".join([*fields[:at], number, *fields[at + 1 :]])
            holds(Target("log", [], read_log), written(tmp_path / "log", hostile))


@pytest.mark.parametrize("number", [float("nan"), float("inf"), 1e300])
@pytest.mark.parametrize("content", LOGS["MRPT rawlog"])
def test_a_monstrous_number_in_binary_warns_nobody(tmp_path: Path, content: bytes, number: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for at in range(len(content)):
            for value in (struct.pack("<d", number), struct.pack("<f", min(number, 3e38))):
                hostile = content[:at] + value + content[at + len(value) :]
                holds(Target("log", [], read_log), written(tmp_path / "log", hostile))
