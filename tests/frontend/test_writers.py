"""What is written is read back the same."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from frontend import se2
from frontend.errors import LogError
from frontend.readers import open_log
from frontend.records import FloatArray, Laser, LaserScan
from frontend.writers import write_carmen

SICK: FloatArray = np.radians(np.arange(-90.0, 90.0))


def drive(
    angles: FloatArray = SICK,
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
    max_range: float = 50.0,
    count: int = 40,
    decimals: int = 2,
    turn: float = 0.1,
) -> list[LaserScan]:
    """A robot on a curve, with no-returns and unusable ranges."""
    rng = np.random.default_rng(1)
    laser = Laser(angles, np.array(mount), max_range)
    scans = []
    for i in range(count):
        ranges = np.round(rng.uniform(0.1, 0.9 * max_range, len(angles)), decimals).astype(np.float32)
        ranges[rng.random(len(angles)) < 0.1] = np.inf
        ranges[rng.random(len(angles)) < 0.1] = np.nan
        theta = np.remainder(turn * i + np.pi, 2 * np.pi) - np.pi
        odometry = np.round([0.1 * i, -0.01 * i * i, theta], 6)
        scans.append(LaserScan(1e9 + 0.2 * i, ranges, odometry, laser))
    return scans


def read_back(scans: list[LaserScan], path: Path, message: str) -> list[LaserScan]:
    assert write_carmen(scans, path) == len(scans)
    log = open_log(path)
    read = list(log.scans())
    assert log.report.lines[message] == log.report.lines["ODOM"] == len(scans)
    assert log.report.skipped == 0
    return read


@pytest.mark.parametrize("decimals", [2, 7])
@pytest.mark.parametrize("max_range", [50.0, 20.0, 8.18, 5.6])
@pytest.mark.parametrize(
    ("angles", "mount", "message"),
    [
        (SICK, (0.0, 0.0, 0.0), "FLASER"),
        (SICK, (0.25, 0.0, 0.0), "FLASER"),
        (np.radians(np.arange(-90.0, 90.25, 0.5)), (0.0, 0.0, 0.0), "FLASER"),
        (SICK, (0.25, -0.1, 0.0), "ROBOTLASER1"),
        (SICK, (-0.2, 0.0, np.pi), "ROBOTLASER1"),
        (SICK + 0.01, (0.0, 0.0, 0.0), "ROBOTLASER1"),
        (np.linspace(-2.0, 2.3, 500), (0.1, 0.2, -0.7), "ROBOTLASER1"),
    ],
    ids=["sick", "sick ahead", "half degree", "aside", "rear", "skewed", "wide"],
)
def test_the_reader_gives_back_what_was_written(
    tmp_path: Path, angles: FloatArray, mount: tuple[float, float, float], message: str, max_range: float, decimals: int
) -> None:
    scans = drive(angles, mount, max_range, decimals=decimals)
    read = read_back(scans, tmp_path / "log.clf", message)
    for got, true in zip(read, scans, strict=True):
        assert got.time == true.time
        np.testing.assert_array_equal(got.ranges, true.ranges)
        np.testing.assert_allclose(got.odometry, true.odometry, rtol=0, atol=1e-12)
    np.testing.assert_allclose(read[0].laser.angles, angles, rtol=0, atol=5e-6)
    np.testing.assert_allclose(read[0].laser.mount[:2], mount[:2], rtol=0, atol=1e-5)
    assert np.cos(read[0].laser.mount[2] - mount[2]) == pytest.approx(1.0)
    assert read[0].laser.max_range == pytest.approx(max_range, rel=1e-5)


def test_the_mount_of_a_robot_that_never_turns_is_kept(tmp_path: Path) -> None:
    read = read_back(drive(mount=(0.25, -0.1, 0.4), turn=0.0), tmp_path / "log.clf", "ROBOTLASER1")
    np.testing.assert_allclose(read[0].laser.mount, [0.25, -0.1, 0.4], atol=1e-5)


@pytest.mark.parametrize(("mount", "tail"), [((0.25, 0.0, 0.0), 9), ((0.25, -0.1, 0.4), 14)])
def test_lines_hold_the_poses_of_laser_and_robot(tmp_path: Path, mount: tuple[float, float, float], tail: int) -> None:
    scans = drive(mount=mount)
    write_carmen(scans, tmp_path / "log.clf")
    lines = [line.split() for line in (tmp_path / "log.clf").read_text().splitlines()]
    lasers = [line for line in lines if line[0].endswith(("FLASER", "ROBOTLASER1"))]
    for words, scan in zip(lasers, scans, strict=True):
        poses = [float(word) for word in words[-tail : 6 - tail]]
        np.testing.assert_allclose(poses[:3], se2.compose(scan.odometry, scan.laser.mount), atol=1e-6)
        np.testing.assert_allclose(poses[3:], scan.odometry, atol=1e-6)


def test_times_finer_than_a_microsecond_are_kept(tmp_path: Path) -> None:
    (scan,) = drive(count=1)
    fine = LaserScan(1234567890.1234567, scan.ranges, scan.odometry, scan.laser)
    (read,) = read_back([fine], tmp_path / "log.clf", "FLASER")
    assert read.time == 1234567890.1234567


@pytest.mark.parametrize("suffix", ["", ".gz", ".bz2", ".xz"])
def test_the_same_scans_give_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    paths = [tmp_path / name / f"log.clf{suffix}" for name in "ab"]
    for path in paths:
        path.parent.mkdir()
        write_carmen(drive(), path)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert (paths[0].read_bytes()[:1] == b"#") == (suffix == "")


def test_scans_that_end_in_an_error_leave_an_older_file_as_it_was(tmp_path: Path) -> None:
    def broken() -> Iterator[LaserScan]:
        yield from drive()
        raise LogError("no more")

    path = tmp_path / "log.clf"
    path.write_text("older")
    with pytest.raises(LogError, match="no more"):
        write_carmen(broken(), path)
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("log.clf", "older")]


def test_scans_are_written_as_they_come(tmp_path: Path) -> None:
    """Writing takes the scans one by one: a day of them need not fit in memory."""
    alive = set()

    def counted() -> Iterator[LaserScan]:
        for i, scan in enumerate(drive(count=30)):
            alive.add(i)
            yield scan
            if i % 10 == 9:
                assert (tmp_path / "log.clf.part").exists()

    assert write_carmen(itertools.islice(counted(), 25), tmp_path / "log.clf") == 25
    assert len(alive) == 25


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "log.clf"
    with pytest.raises(OSError, match="No such file") as caught:
        write_carmen(drive(), path)
    assert caught.value.filename == str(path)
