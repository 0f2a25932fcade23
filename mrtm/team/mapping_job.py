"""One robot of a session to map, on its own or as what a process of several is given to do.

Imports next to nothing: every process waits for it.
"""

import os
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import util
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import SynchronizedArray
from threading import Thread

from frontend.ahead import ahead
from frontend.readers import open_log
from mrtm.config import Config
from mrtm.cores import use_cores
from mrtm.team.member import MemberRun, map_member
from mrtm.team.session_file import Member
from mrtm.team.window import windowed


@dataclass(frozen=True, slots=True)
class MappingJob:
    """One robot to map.

    Attributes:
        number: its place in the list, shared between processes, of how far each is.
        moments: team times at which it must know where it was.
    """

    number: int
    member: Member
    config: Config
    moments: tuple[float, ...]


def map_robot(job: MappingJob, report: Callable[[float, int, int], None]) -> MemberRun:
    """M1 to M8 for one robot.

    Args:
        report: told now and then the fraction done, how many scans have been taken, and how many vertices there are.
    """
    log = open_log(job.member.log)
    run = map_member(
        job.member.name,
        ahead(windowed(log, job.member)),
        job.config,
        job.moments,
        lambda scans, vertices: report(log.report.fraction, scans, vertices),
    )
    run.blemishes.extend(log.report.blemishes())
    return run


_done: "SynchronizedArray[float]"


def start_process(done: "SynchronizedArray[float]", lifeline: Connection, cores: int, processes: int) -> None:
    """Make a process ready for ``map_in_process``.

    Args:
        done: for every job which fraction of it is done.
        lifeline: the process ends when the other end of it is closed, however that came to be: by the process that
            waits for the map, or by the system if that one is no more.
        cores: that all processes together may use.
        processes: how many there are.
    """
    global _done
    _done = done
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # as of the command
    use_cores(max(cores // processes, 1))
    if hasattr(os, "sched_setaffinity"):  # for where there are more processes than cores
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    Thread(target=_live_by, args=(lifeline,), name="lifeline", daemon=True).start()


def _live_by(lifeline: Connection) -> None:
    lifeline.poll(None)
    # numba has made itself a semaphore with the first word of cores, and what stays behind is complained of.
    util._exit_function()  # type: ignore[attr-defined]
    os._exit(1)


def map_in_process(job: MappingJob) -> MemberRun:
    """``map_robot`` in a process of its own."""

    def report(fraction: float, scans: int, vertices: int) -> None:
        _done[job.number] = fraction

    run = map_robot(job, report)
    _done[job.number] = 1.0
    return run
