"""The front ends of a team at work: a process a robot, as many at once as there are cores."""

import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing.sharedctypes import SynchronizedArray

from frontend.ahead import ahead
from frontend.rbpf import first_run
from frontend.readers import open_log
from mrtm.config import Config
from mrtm.cores import use_cores
from mrtm.progress import Progress
from mrtm.team.member import MemberRun, map_member
from mrtm.team.playback import sighting_times
from mrtm.team.session_file import Member, TeamSession
from mrtm.team.window import windowed

LOOK = 0.2  # seconds between two looks at how far the processes are


@dataclass(frozen=True, slots=True)
class _Job:
    """One robot to map: ``number`` is its place in the shared list of how far each is."""

    number: int
    member: Member
    config: Config
    moments: tuple[float, ...]


def map_members(session: TeamSession, config: Config, cores: int, progress: Progress) -> list[MemberRun]:
    """M1 to M8 for every robot of a session, each from its own log alone.

    Args:
        cores: to use at most; the outcome does not depend on it.

    Raises:
        LogError: a log cannot be read or holds no usable scan.
        SessionError: a robot's window of its log holds no scan.
    """
    jobs = [_Job(n, m, config, tuple(sighting_times(session.sightings, m.name))) for n, m in enumerate(session.members)]
    compiling = first_run()
    if compiling:
        progress(0.0, "compiling the kernels, which only the first run does")
    if len(jobs) == 1:
        return [_map_alone(jobs[0], progress)]
    # The first run of all compiles: one process does it for all.
    at_once = 1 if compiling else min(len(jobs), cores)
    return _map_side_by_side(jobs, at_once, max(cores // at_once, 1), progress)


def _map_alone(job: _Job, progress: Progress) -> MemberRun:
    def report(fraction: float, scans: int, vertices: int) -> None:
        progress(fraction, f"{scans} scans, {vertices} vertices")

    return _map(job, report)


def _map_side_by_side(jobs: Sequence[_Job], at_once: int, threads: int, progress: Progress) -> list[MemberRun]:
    context = multiprocessing.get_context("spawn")  # numba's threads do not survive a fork
    done: SynchronizedArray[float] = context.Array("d", len(jobs))
    with ProcessPoolExecutor(at_once, context, _start, (done, threads)) as pool:
        results = [pool.submit(_map_in_process, job) for job in jobs]
        while not all(result.done() for result in results):
            ready = sum(result.done() for result in results)
            progress(sum(done[:]) / len(jobs), f"{ready} of {len(jobs)} robots mapped")
            failed = next((r for r in results if r.done() and r.exception() is not None), None)
            if failed is not None:
                pool.shutdown(wait=False, cancel_futures=True)
                break
            time.sleep(LOOK)
        return [result.result() for result in results if not result.cancelled()]


_done: "SynchronizedArray[float]"


def _start(done: "SynchronizedArray[float]", threads: int) -> None:
    global _done
    _done = done
    use_cores(threads)


def _map_in_process(job: _Job) -> MemberRun:
    def report(fraction: float, scans: int, vertices: int) -> None:
        _done[job.number] = fraction

    run = _map(job, report)
    _done[job.number] = 1.0
    return run


def _map(job: _Job, report: Callable[[float, int, int], None]) -> MemberRun:
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
