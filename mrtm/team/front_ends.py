"""The front ends of a team at work: a process a robot, up to twice as many at once as there are cores."""

import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext
from multiprocessing.sharedctypes import SynchronizedArray

from frontend.rbpf import first_run
from mrtm.config import Config
from mrtm.progress import Progress
from mrtm.team.mapping_job import MappingJob, map_in_process, map_robot, start_process
from mrtm.team.member import MemberRun
from mrtm.team.session_file import TeamSession
from mrtm.team.sightings_file import sighting_times

LOOK = 0.2  # seconds between two looks at how far the processes are


def map_members(session: TeamSession, config: Config, cores: int, progress: Progress) -> list[MemberRun]:
    """M1 to M8 for every robot of a session, each from its own log alone.

    Args:
        cores: to use at most; the outcome does not depend on it.

    Raises:
        LogError: a log cannot be read or holds no usable scan.
        SessionError: a robot's window of its log holds no scan.
        MemoryError: the system killed a process.
    """
    jobs = [
        MappingJob(n, m, config, tuple(sighting_times(session.sightings, m.name)))
        for n, m in enumerate(session.members)
    ]
    compiling = first_run()
    if compiling:
        progress(0.0, "compiling the kernels, which only the first run does")
    if len(jobs) == 1:
        return [map_robot(jobs[0], lambda done, scans, vertices: progress(done, f"{scans} scans, {vertices} vertices"))]
    # The first run of all compiles: one process does it for all.
    return _map_side_by_side(jobs, 1 if compiling else _at_once(len(jobs), cores), cores, progress)


def _at_once(jobs: int, cores: int) -> int:
    """How many processes: more than cores, so that three robots on two cores leave neither idle while one waits."""
    return min(jobs, 2 * cores if hasattr(os, "sched_setaffinity") and cores > 1 else cores)


def _map_side_by_side(jobs: Sequence[MappingJob], at_once: int, cores: int, progress: Progress) -> list[MemberRun]:
    # Forked from a process that has imported all and started nothing: numba's threads do not survive a fork.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([map_in_process.__module__, "mrtm.team.half_begun"])
    _start_server(context)
    done: SynchronizedArray[float] = context.Array("d", len(jobs))
    lifeline, held = context.Pipe(duplex=False)
    with ProcessPoolExecutor(at_once, context, start_process, (done, lifeline, cores, at_once)) as pool, held:
        results = [pool.submit(map_in_process, job) for job in jobs]
        busy = set(results)
        while busy:
            ready, busy = wait(results, LOOK, FIRST_EXCEPTION)
            progress(sum(done[:]) / len(jobs), f"{len(ready)} of {len(jobs)} robots mapped")
            if any(result.exception() for result in ready):
                break
        pool.shutdown(wait=not busy, cancel_futures=True)
        try:
            return [result.result() for result in results if result.done()]
        except BrokenProcessPool as error:
            raise MemoryError("the system killed a process that maps a robot") from error


def _start_server(context: ForkServerContext) -> None:
    """Start the process that the others are forked from, and wait until it has imported all.

    It and the others stay deaf: what is to end all is for this process, on whose lifeline they are. Interrupted while
    they import, they would each print where they were.
    """
    resource_tracker.ensure_running()  # else the server starts it, and hears again
    with _deaf():
        forkserver.ensure_running()
    first = context.Process()  # which does nothing
    first.start()
    first.join()


@contextmanager
def _deaf() -> Iterator[None]:
    """Let the interrupt key and the request to end wait until after the block; who is started in it hears neither."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
