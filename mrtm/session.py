"""What the commands do with a session: a run, or a comparison of ways to the joint map."""

import os
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from frontend.records import LaserScan
from mrtm.compare import Score, compare
from mrtm.config import Config
from mrtm.cores import limited_to
from mrtm.output.export import export
from mrtm.output.place import check_outputs, comparison_outputs, earlier_files, run_outputs
from mrtm.progress import Progress
from mrtm.result import RunResult
from mrtm.team.front_ends import map_members
from mrtm.team.member import map_member
from mrtm.team.playback import play
from mrtm.team.session_file import TeamSession, open_session

FRONT_ENDS = 0.9  # of the time that mapping takes, before the team is played
MAPPING = 0.95  # of a run's time
COMPARED = 0.8  # of a comparison's time, when the session has been mapped


def run_session(
    path: Path, out: Path, config: Config, progress: Progress, cores: int | None = None, kept: Sequence[Path] = ()
) -> RunResult:
    """Map a team's session, or a single robot's log, and write what a run leaves behind.

    Args:
        cores: to use at most, all there are if not given; the result does not depend on it.
        kept: files besides those of the session that must not be written over.

    Raises:
        SessionError: the session is not one, or a robot's window of its log holds no scan.
        LogError: a log cannot be read or holds no usable scan.
        OutputError: ``out`` cannot be written into, or a file of the session would be written over.
        OSError: a file cannot be written in the end.
    """
    session = open_session(path)
    outputs = run_outputs(out, [member.name for member in session.members])
    check_outputs(outputs, (*session.files, *kept), earlier_files(out))
    result = map_session(session, config, lambda done, doing: progress(MAPPING * done, doing), cores)
    progress(MAPPING, "writing")
    export(result, out)
    progress(1.0, f"{result.counts['scans']} scans, {result.counts['vertices']} vertices")
    return result


def compare_session(
    path: Path, out: Path, config: Config, progress: Progress, cores: int | None = None, kept: Sequence[Path] = ()
) -> tuple[Score, ...]:
    """Map a session and make its joint map three ways, measured against the truth that the session names.

    Args:
        out: for the table and the figures, see ``mrtm.compare.compare``.
        cores, kept: as of ``run_session``.

    Raises:
        SessionError, LogError, OutputError, OSError: as of ``run_session``.
        EvaluationError: a file of the truth cannot be read.
    """
    session = open_session(path)
    check_outputs(comparison_outputs(out, [member.name for member in session.members]), (*session.files, *kept))
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
