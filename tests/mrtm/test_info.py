"""`mrtm info` and `mrtm convert` on every format."""

from pathlib import Path

import numpy as np
import pytest

from frontend.readers import open_log
from mrtm.info import describe, log_info
from tests.frontend.rawlog_bytes import Writer
from tests.mrtm.test_cli import call

SQUARE = [(0.0, 0.0, 0.0), (3.0, 0.0, np.pi / 2), (3.0, 4.0, 3.1), (0.0, 4.0, -3.1), (0.0, 0.0, -0.5)]


def carmen() -> bytes:
    ranges = " ".join(["2.00"] * 170 + ["81.91"] * 9 + ["nan"])
    poses = (" ".join(f"{value:.6f}" for value in pose) for pose in SQUARE)
    lines = [f"FLASER 180 {ranges} {p} {p} {976052857.5 + 2 * i} host 0" for i, p in enumerate(poses)]
    return ("# CARMEN Logfile\nPARAM robot_length 1 host 0\n" + "\n".join([*lines, "FLASER 3 1\n"])).encode()


def player() -> bytes:
    beams = " ".join(f"2.{i % 3} {np.radians(i - 90):.3f} {int(i in (89, 90, 91))}" for i in range(181))
    lines = []
    for i, (x, y, theta) in enumerate(SQUARE):
        lines.append(f"{i}.1 intel0 7000 position 01 {i}.0 {x} {y} {theta:.4f} 0 0 0")
        lines.append(f"{i}.1 intel0 7000 laser 00 {i}.0 {beams}")
    return ("\n".join(lines) + "\n").encode()


def rawlog() -> bytes:
    writer = Writer()
    return b"".join(
        writer.odometry(pose, 1e9 + i) + writer.scan([2.0 + i, 3.0, 30.0], 1e9 + i, aperture=1.0)
        for i, pose in enumerate(SQUARE)
    )


LOGS = {"carmen": carmen, "player": player, "rawlog": rawlog}


@pytest.fixture(params=LOGS)
def log(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / f"{request.param}.log"
    path.write_bytes(LOGS[request.param]())
    return path


def facts(text: str) -> dict[str, str]:
    return {line[:14].strip(): line[14:] for line in text.splitlines() if not line.startswith(" ")}


def test_path_and_turns_are_the_odometrys(log: Path) -> None:
    info = log_info(log)
    assert info.path_length == pytest.approx(14.0)
    turns = [np.pi / 2, 3.1 - np.pi / 2, 2 * np.pi - 6.2, 2.6]
    assert info.turned == pytest.approx(sum(turns), abs=1e-3)
    assert info.report.scans == 5


def test_info_of_a_carmen_log(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(carmen())
    done = call("info", path)
    assert (done.returncode, done.stderr) == (0, "")
    assert facts(done.stdout) == {
        "format": "CARMEN",
        "time": "8.0 s, from 976052857.500 to 976052865.500 (2000-12-05 21:47:37 UTC)",
        "scans": "5, 0.5 a second",
        "laser": "FLASER",
        "beams": "180, 1 deg apart",
        "field of view": "179 deg, from -90 to 89",
        "max range": "50 m; 5 % of the readings hit nothing",
        "mount": "(0 m, 0 m, 0 deg) on the robot",
        "path": "14.0 m driven, 331 deg turned, by odometry",
        "sightings": "none",
        "lines": "6 FLASER, 1 #, 1 PARAM",
        "blemishes": "",
    }
    assert f"  {path}:8: FLASER: only 0 fields" in done.stdout.splitlines()
    assert f"  {path}: masked 5 unusable ranges (0.56 %)" in done.stdout.splitlines()


def test_info_of_the_other_formats(tmp_path: Path) -> None:
    described = {}
    for name in ("player", "rawlog"):
        (tmp_path / name).write_bytes(LOGS[name]())
        described[name] = facts("\n".join(describe(log_info(tmp_path / name))))
    assert described["player"]["format"] == "Player"
    assert described["player"]["time"] == "4.0 s, from 0.000 to 4.000"
    assert described["player"]["sightings"] == "5 of other robots, by reflective tags"
    assert described["player"]["lines"] == "5 position, 5 laser"
    assert described["player"]["blemishes"] == "none"
    assert described["rawlog"]["format"] == "MRPT rawlog"
    assert described["rawlog"]["objects"] == "5 CObservationOdometry, 5 CObservation2DRangeScan"
    assert described["rawlog"]["max range"] == "30 m; 33 % of the readings hit nothing"


@pytest.mark.parametrize("suffix", ["", ".gz"])
def test_convert_keeps_the_scans(log: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"out.clf{suffix}"
    done = call("convert", log, out)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[0] == f"{out}: 5 scans"
    assert ("left out: 5 sightings" in done.stdout) == (log.name == "player.log")
    converted = open_log(out)
    assert converted.format == "CARMEN"
    for read, true in zip(converted.scans(), open_log(log).scans(), strict=True):
        assert read.time == true.time
        np.testing.assert_array_equal(read.ranges, true.ranges)
        np.testing.assert_allclose(read.odometry, true.odometry, atol=1e-6)
        np.testing.assert_allclose(read.laser.angles, true.laser.angles, atol=1e-5)
        assert read.laser.max_range == true.laser.max_range


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("info", "missing.log"), "missing.log: no such file"),
        (("convert", "missing.log", "OUT"), "missing.log: no such file"),
        (("convert", "LOG", "NOWHERE"), "cannot be written into (not a directory)"),
    ],
)
def test_a_user_error_is_one_line_and_exit_code_2(tmp_path: Path, arguments: tuple[str, ...], said: str) -> None:
    places = {"OUT": tmp_path / "out.clf", "LOG": tmp_path / "log", "NOWHERE": tmp_path / "log" / "out.clf"}
    places["LOG"].write_bytes(carmen())
    done = call(*(places.get(argument, argument) for argument in arguments))
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("error: ")
    assert said in done.stderr
    assert not places["OUT"].exists()
