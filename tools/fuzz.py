"""Feeds bad input to everything that reads a file: ``python -m tools.fuzz --count 100000``.

Input ``n`` of a target and a seed is always the same bytes. A finding is an exception that is not of the project's own
trees, a broken promise, more time than ``--seconds``, or more memory than ``--megabytes`` above what the process had;
its input is written to ``--out``. With ``--atheris`` one target is fuzzed guided by coverage (extra ``fuzz``).
"""

import os
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from types import FrameType
from typing import Annotated

import typer

from tools.fuzzing.mutate import mutate
from tools.fuzzing.targets import Target, holds, targets

app = typer.Typer(add_completion=False)
SHOWN_AT_MOST = 20
IN_MEMORY = Path("/dev/shm")
"""Where files are, on Linux, that never see a disk: writing an input takes longer than reading it."""


class TookTooLongError(BaseException):
    """An input took more than its time; no reader catches it by accident."""


@app.command()
def main(
    count: Annotated[int, typer.Option(min=1, help="Inputs for each target.")] = 10_000,
    only: Annotated[
        list[str] | None, typer.Option("--target", help="One target; repeatable. All if not given.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the mutations.")] = 0,
    first: Annotated[int, typer.Option(min=0, help="Number of the first input: --first N --count 1 repeats one.")] = 0,
    seconds: Annotated[float, typer.Option(min=0.1, help="For one input.")] = 2.0,
    megabytes: Annotated[int, typer.Option(min=16, help="For one input.")] = 256,
    out: Annotated[Path, typer.Option(help="Directory for inputs that found something.")] = Path("out/fuzz"),
    atheris: Annotated[bool, typer.Option("--atheris", help="Guided by coverage; one --target.")] = False,
) -> None:
    """Mutate valid files and see that every reader ends in a result or in one line."""
    chosen = [target for target in targets() if not only or target.name in only]
    if not chosen:
        raise typer.BadParameter(f"targets are {', '.join(target.name for target in targets())}", param_hint="--target")
    if atheris:
        if len(chosen) != 1:
            raise typer.BadParameter("give one", param_hint="--target")
        guided = [sys.executable, "-m", "tools.fuzzing.guided", chosen[0].name, str(count), str(seed), str(out)]
        os.execv(sys.executable, guided)
    found = 0
    for target in chosen:
        started = time.perf_counter()
        findings, slowest = fuzz(target, range(first, first + count), seed, seconds, megabytes, out)
        spent = time.perf_counter() - started
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        typer.echo(
            f"{target.name}: {count} inputs in {spent:.0f} s, slowest {slowest * 1e3:.0f} ms, "
            f"peak memory {peak:.0f} MB, {len(findings)} findings"
        )
        for what, times in findings.most_common(SHOWN_AT_MOST):
            typer.echo(f"  {times} x {what}")
        found += len(findings)
    sys.exit(found > 0)


def fuzz(
    target: Target, numbers: range, seed: int, seconds: float, megabytes: int, out: Path
) -> tuple[Counter[str], float]:
    """Feed the inputs of these numbers to a target.

    Returns:
        How often what was found, and the seconds the slowest input took.
    """
    findings: Counter[str] = Counter()
    slowest = 0.0
    place = IN_MEMORY if IN_MEMORY.is_dir() else None
    with (
        tempfile.TemporaryDirectory(dir=place) as directory,
        _memory(megabytes),
        _alarms(),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("error")  # numpy's of an overflow would land in the user's terminal
        file = Path(directory) / "input"
        for number in numbers:
            data = mutate(Random(f"{target.name}/{seed}/{number}"), target.seeds)
            file.write_bytes(data)
            started = time.perf_counter()
            what = _outcome(target, file, seconds)
            slowest = max(slowest, time.perf_counter() - started)
            if what:
                findings[what] += 1
                if findings[what] == 1:
                    _keep(out / f"{target.name}-{seed}-{number}".replace(":", "-").replace(" ", "-"), data, what)
    return findings, slowest


def _outcome(target: Target, file: Path, seconds: float) -> str:
    """What is wrong with what a target makes of a file, and where; empty if nothing is."""
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds)
        try:
            holds(target, file)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    except TookTooLongError as error:
        return f"more than {seconds:g} s in {_place(error)}"
    except Exception as error:
        return f"{type(error).__name__} in {_place(error)}: {str(error)[:150]}"
    return ""


def _place(error: BaseException) -> str:
    """The innermost line of this project's own readers."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if any(f"/{part}/" in frame.filename for part in ("frontend", "mrtm"))]
    frame = (own or frames)[-1]
    return f"{Path(frame.filename).name}:{frame.lineno}"


def _keep(file: Path, data: bytes, what: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(data)
    file.with_name(file.name + ".txt").write_text(what + "\n")


@contextmanager
def _memory(megabytes: int) -> Iterator[None]:
    """Bound the address space: an allocation beyond is a MemoryError, and so a finding."""
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (now + (megabytes << 20), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextmanager
def _alarms() -> Iterator[None]:
    def ring(number: int, frame: FrameType | None) -> None:
        raise TookTooLongError

    before = signal.signal(signal.SIGALRM, ring)
    try:
        yield
    finally:
        signal.signal(signal.SIGALRM, before)


if __name__ == "__main__":
    app()
