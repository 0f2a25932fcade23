"""Where the time of one run goes: stages of the whole process, functions and kernels, and what bounds it."""

import cProfile
import pstats
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mrtm.cli import app
from tools.bench.kernels import Counter, nanoseconds_per_evaluation, nanoseconds_per_lookup, observed
from tools.bench.logs import ROOT
from tools.bench.machine import Setting
from tools.bench.process import Cost, measure
from tools.bench.suite import stages
from tools.bench.systems import run_record
from tools.bench.table import markdown

TOP = 20


@dataclass(frozen=True, slots=True)
class Function:
    """A function's own time in the profiled run, seconds of wall clock; a kernel's includes the kernels it calls."""

    name: str
    calls: int
    seconds: float
    kernel: bool
    matching: bool = False


@dataclass(frozen=True, slots=True)
class Profile:
    """What was measured.

    Attributes:
        log: its file name.
        cost: of a whole process, not profiled; the quickest of some.
        stages: its seconds by stage.
        profiled: seconds of the profiled run, kernels already loaded, without the start of a process.
        functions: by their own time, longest first.
        evaluations: beam evaluations by kernel, estimated.
        nanoseconds: one beam evaluation in a tight loop on one core.
        lookup: nanoseconds to look an endpoint's cell up, likewise.
    """

    log: str
    cost: Cost
    stages: dict[str, float]
    profiled: float
    functions: list[Function]
    evaluations: dict[str, float]
    nanoseconds: float
    lookup: float

    def bound(self, cores: int) -> list[str]:
        """What bounds the run, in words."""
        total = sum(self.evaluations.values())
        least = total * self.nanoseconds * 1e-9 / cores
        kernels = sum(f.seconds for f in self.functions if f.kernel)
        matching = sum(f.seconds for f in self.functions if f.matching)
        return [
            f"The run makes about {total / 1e6:.1f} million beam evaluations (an endpoint in a pass of a match), "
            f"{total / 1e6 / self.cost.wall:.1f} million a second of the whole process.",
            f"One costs {self.nanoseconds:.1f} ns in a tight loop on one core (the mere look-up of its cell "
            f"{self.lookup:.1f} ns): {cores * 1e3 / self.nanoseconds:.0f} million a second on {cores} cores.",
            f"At that rate all of them take {least:.2f} s, {100 * least / self.cost.wall:.0f} % of the process's "
            f"{self.cost.wall:.2f} s; the kernels that match took {matching:.2f} s.",
            f"Of the profiled run's {self.profiled:.2f} s all kernels together took {kernels:.2f} s "
            f"({100 * kernels / self.profiled:.0f} %); the rest is Python, which the profiler slows down.",
        ]


def profile(log: Path, options: Sequence[str], work: Path, runs: int = 3, limit: float = 3600.0) -> Profile:
    """Run a log as whole processes, then in this process under a profiler, then once more to count.

    Args:
        options: for ``mrtm run``.
        work: directory for what the runs leave.
        runs: whole processes, after one that warms up.
        limit: seconds for each.

    Raises:
        ProcessError: a process failed.
    """
    command = ["run", str(log), "--out", str(work / "out"), "--quiet", *options]
    measured: list[tuple[Cost, dict[str, float]]] = []
    for _ in range(runs + 1):
        cost = measure([sys.executable, "-m", "mrtm", *command], work / "printed.txt", limit)
        measured.append((cost, stages(run_record(work / "out")["timings"], cost.wall)))
    cost, by_stage = min(measured[1:], key=lambda one: one[0].wall)

    app(command, standalone_mode=False)  # loads the kernels
    profiler = cProfile.Profile()
    started = time.perf_counter()
    profiler.runcall(app, command, standalone_mode=False)
    profiled = time.perf_counter() - started
    counter = Counter()
    with observed(counter):
        app(command, standalone_mode=False)
    return Profile(
        log.name,
        cost,
        by_stage,
        profiled,
        _functions(profiler, counter),
        counter.evaluations,
        nanoseconds_per_evaluation(counter.problems),
        nanoseconds_per_lookup(counter.problems[0][0]),
    )


def _functions(profiler: cProfile.Profile, counter: Counter) -> list[Function]:
    functions = []
    for place, (_, calls, own, _, _) in pstats.Stats(profiler).stats.items():  # type: ignore[attr-defined]
        functions.append(Function(_label(*place), calls, own, place in counter.kernels, place in counter.matching))
    return sorted(functions, key=lambda function: -function.seconds)


def _label(file: str, line: int, function: str) -> str:
    if file == "~":  # built in
        return function.strip("<>")
    path = Path(file)
    if "site-packages" in path.parts:
        path = Path(*path.parts[path.parts.index("site-packages") + 1 :])
    elif path.is_relative_to(ROOT):
        path = path.relative_to(ROOT)
    else:
        path = Path(path.name)
    return f"{path.with_suffix('')}: {function}"


def stages_report(measured: Profile, setting: Setting, parameters: Sequence[str], note: str, picture: str) -> str:
    """The profile as Markdown."""
    wall = measured.cost.wall
    lines = [f"# Where the time goes: {measured.log}", "", *([f"**{note}**", ""] if note else []), *setting.lines()]
    lines += [f"- options of mrtm: {' '.join(parameters) or 'none'}", "", *measured.bound(setting.cores), ""]
    lines += [f"![stages, functions and kernels]({picture})", ""]
    lines += [f"## The whole process, {wall:.2f} s wall, {measured.cost.cpu:.2f} s CPU", ""]
    rows = [[name, f"{seconds:.2f}", f"{100 * seconds / wall:.0f}"] for name, seconds in measured.stages.items()]
    lines += [*markdown(("stage", "s", "%"), rows), ""]
    lines += ["## Own time of functions and kernels, profiled", ""]
    top = [
        [f.name + (" (kernel)" if f.kernel else ""), str(f.calls), f"{f.seconds:.3f}"] for f in measured.functions[:TOP]
    ]
    lines += [*markdown(("function", "calls", "s"), top), "", "## Beam evaluations", ""]
    counts = [[name, f"{count / 1e6:.2f}"] for name, count in measured.evaluations.items()]
    lines += markdown(("kernel", "millions"), counts)
    return "\n".join(lines) + "\n"
