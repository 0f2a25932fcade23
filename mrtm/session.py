"""A run: a session in, joint map out."""

import os
import time
from collections.abc import Iterable
from pathlib import Path

from frontend.records import LaserScan
from mrtm.config import Config
from mrtm.output.export import export
from mrtm.progress import Progress
from mrtm.result import RunResult
from mrtm.team.front_ends import map_members
from mrtm.team.member import map_member
from mrtm.team.playback import play
from mrtm.team.session_file import open_session

MAPPING, PLAYING = 0.85, 0.95  # of a run's time, when the front ends are done and when the team has been played


def run_session(path: Path, out: Path, config: Config, progress: Progress, cores: int | None = None) -> RunResult:
    """Map a team's session, or a single robot's log, and write what a run leaves behind.

    Args:
        cores: to use at most, all there are if not given; the result does not depend on it.

    Raises:
        SessionError: the session is not one, or a robot's window of its log holds no scan.
        LogError: a log cannot be read or holds no usable scan.
    """
    started = time.perf_counter()
    session = open_session(path)
    runs = map_members(
        session, config, cores or os.cpu_count() or 1, lambda fraction, doing: progress(MAPPING * fraction, doing)
    )
    result = play(
        runs,
        session.sightings,
        config,
        lambda fraction: progress(MAPPING + (PLAYING - MAPPING) * fraction, "meetings and joint map"),
    )
    progress(PLAYING, "writing")
    result.timings["total"] = time.perf_counter() - started
    export(result, out)
    progress(1.0, f"{result.counts['scans']} scans, {result.counts['vertices']} vertices")
    return result


def map_scans(scans: Iterable[LaserScan], config: Config, name: str = "robot") -> RunResult:
    """Map one robot's scans; nothing is written.

    Raises:
        ValueError: there is no scan.
    """
    run = map_member(name, ((scan.time, scan) for scan in scans), config)
    if not len(run.times):
        raise ValueError("there is no scan to map")
    return play([run], (), config)
