"""What the commands do with a session: a run, or a comparison of ways to the joint map."""

import os
import time
from collections.abc import Iterable
from pathlib import Path

from frontend.records import LaserScan
from mrtm.compare import Score, compare
from mrtm.config import Config
from mrtm.cores import limited_to
from mrtm.output.export import export
from mrtm.progress import Progress
from mrtm.result import RunResult
from mrtm.team.front_ends import map_members
from mrtm.team.member import map_member
from mrtm.team.playback import play
from mrtm.team.session_file import TeamSession, open_session

FRONT_ENDS = 0.9  # of the time that mapping takes, before the team is played
MAPPING = 0.95  # of a run's time
COMPARED = 0.8  # of a comparison's time, when the session has been mapped


def run_session(path: Path, out: Path, config: Config, progress: Progress, cores: int | None = None) -> RunResult:
    """Map a team's session, or a single robot's log, and write what a run leaves behind.

    Args:
        cores: to use at most, all there are if not given; the result does not depend on it.

    Raises:
        SessionError: the session is not one, or a robot's window of its log holds no scan.
        LogError: a log cannot be read or holds no usable scan.
    """
    result = map_session(open_session(path), config, lambda done, doing: progress(MAPPING * done, doing), cores)
    progress(MAPPING, "writing")
    export(result, out)
    progress(1.0, f"{result.counts['scans']} scans, {result.counts['vertices']} vertices")
    return result


def compare_session(
    path: Path, out: Path, config: Config, progress: Progress, cores: int | None = None
) -> tuple[Score, ...]:
    """Map a session and make its joint map three ways, measured against the truth that the session names.

    Args:
        out: for the table and the figures, see ``mrtm.compare.compare``.
        cores: as of ``run_session``.

    Raises:
        SessionError, LogError: as of ``run_session``.
        EvaluationError: a file of the truth cannot be read.
    """
    session = open_session(path)
    result = map_session(session, config, lambda done, doing: progress(COMPARED * done, doing), cores)
    return compare(
        result,
        out,
        session.relations,
        session.truth,
        lambda done, doing: progress(COMPARED + (1.0 - COMPARED) * done, doing),
    )


def map_session(session: TeamSession, config: Config, progress: Progress, cores: int | None = None) -> RunResult:
    """Map a session; nothing is written. Arguments and errors as of ``run_session``."""
    started = time.perf_counter()
    cores = cores or os.cpu_count() or 1
    with limited_to(cores):
        runs = map_members(session, config, cores, lambda done, doing: progress(FRONT_ENDS * done, doing))
        result = play(
            runs,
            session.sightings,
            config,
            lambda done: progress(FRONT_ENDS + (1.0 - FRONT_ENDS) * done, "meetings and joint map"),
        )
    result.timings["total"] = time.perf_counter() - started
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
