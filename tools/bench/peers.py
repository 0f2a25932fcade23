"""The peers: public 2D SLAM programs that a machine can install, run with their own documented settings."""

import math
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from frontend import se2
from frontend.records import FloatArray
from mrtm.evaluation import TimedPoses
from tools.bench.logs import ROOT, BenchLog
from tools.bench.rawlog import write_rawlog
from tools.bench.recording import Recording, carried
from tools.bench.systems import OutputError, System

HERE = Path(__file__).parent
YAG_PYTHON = ROOT / ".venv/peers/yag-slam/bin/python"


@dataclass(frozen=True)
class IcpSlam:
    """MRPT's icp-slam: it tells its pose after every scan and never changes its mind."""

    name: str = "MRPT icp-slam"
    about: str = "scan to map, no loop closing; MRPT's documented example, every endpoint"
    install: str = "apt-get install mrpt-apps"

    def installed(self) -> bool:
        return shutil.which("icp-slam") is not None

    def prepare(self, log: BenchLog, recording: Recording, work: Path) -> list[str]:
        return _prepare_mrpt("icp-slam", recording, work)

    def trajectory(self, recording: Recording, work: Path) -> TimedPoses:
        rows = np.loadtxt(work / "out/log_estimated_path.txt", ndmin=2)
        if len(rows) != len(recording.times):
            raise OutputError(f"icp-slam: {len(rows)} poses for {len(recording.times)} scans")
        return TimedPoses(recording.times, rows[:, 1:4])


@dataclass(frozen=True)
class RbpfSlam:
    """MRPT's rbpf-slam: its answer is the path of the likeliest particle, one pose at each step of the filter."""

    name: str = "MRPT rbpf-slam"
    about: str = "10 particles, ICP proposal; MRPT's documented example for the Intel log"
    install: str = "apt-get install mrpt-apps"

    def installed(self) -> bool:
        return shutil.which("rbpf-slam") is not None

    def prepare(self, log: BenchLog, recording: Recording, work: Path) -> list[str]:
        return _prepare_mrpt("rbpf-slam", recording, work)

    def trajectory(self, recording: Recording, work: Path) -> TimedPoses:
        poses = np.loadtxt(work / "out/most_likely_path.txt", ndmin=2)[1:]  # the first is the start, before any scan
        keys = filter_steps(recording.odometry)
        if len(poses) != len(keys):
            raise OutputError(f"rbpf-slam: {len(poses)} poses for {len(keys)} steps of its filter")
        return carried(recording, keys, poses)


def filter_steps(odometry: FloatArray) -> npt.NDArray[np.int64]:
    """The scans at which rbpf-slam runs its filter, by the distances in ``rbpf-slam.ini``: it does not write them down.

    It runs when odometry has moved far enough since its last run, or since a scan last went into the map.
    """
    localize, insert = (0.2, math.radians(10.0)), (2.0, math.radians(30.0))
    since_run, since_map = np.zeros(3), np.zeros(3)
    keys = [0]
    for index in range(1, len(odometry)):
        moved = se2.between(odometry[index - 1], odometry[index])
        since_run, since_map = se2.compose(since_run, moved), se2.compose(since_map, moved)
        mapped = _beyond(since_map, insert)
        if mapped or _beyond(since_run, localize):
            keys.append(index)
            since_run = np.zeros(3)
        if mapped:
            since_map = np.zeros(3)
    return np.array(keys)


def _beyond(moved: FloatArray, limits: tuple[float, float]) -> bool:
    return bool(np.hypot(moved[0], moved[1]) > limits[0] or abs(moved[2]) > limits[1])


def _prepare_mrpt(program: str, recording: Recording, work: Path) -> list[str]:
    settings = (HERE / f"{program}.ini").read_text().replace("@OUT@", str(work / "out"))
    (work / "settings.ini").write_text(settings)
    write_rawlog(recording, work / "log.rawlog")
    return [program, str(work / "settings.ini"), str(work / "log.rawlog")]


@dataclass(frozen=True)
class YagSlam:
    """yag-slam, a port of Karto: key scans matched to a running window, and a pose graph."""

    name: str = "yag-slam (Karto)"
    about: str = "its own defaults, a key scan each 0.2 m or 10 degrees"
    install: str = (
        f"python3 -m venv {YAG_PYTHON.parents[1].relative_to(ROOT)} && "
        f"{(YAG_PYTHON.parent / 'pip').relative_to(ROOT)} install yag-slam opencv-python-headless"
    )

    def installed(self) -> bool:
        return YAG_PYTHON.exists()

    def prepare(self, log: BenchLog, recording: Recording, work: Path) -> list[str]:
        laser = recording.laser
        beyond = laser.max_range + 1.0  # Karto takes no notice of readings beyond the longest range
        np.savez(
            work / "in.npz",
            odometry=se2.compose(recording.odometry, laser.mount),
            ranges=np.where(np.isfinite(recording.ranges), recording.ranges, beyond).astype(np.float64),
            geometry=[laser.angles[0], laser.angles[-1], laser.angles[1] - laser.angles[0], laser.max_range],
        )
        return [str(YAG_PYTHON), str(HERE / "yag_runner.py"), str(work / "in.npz"), str(work / "out.npz")]

    def trajectory(self, recording: Recording, work: Path) -> TimedPoses:
        with np.load(work / "out.npz") as result:
            keys, lasers = result["keys"], result["poses"]
        return carried(recording, keys, se2.compose(lasers, se2.inverse(recording.laser.mount)))


PEERS: tuple[System, ...] = (IcpSlam(), RbpfSlam(), YagSlam())
