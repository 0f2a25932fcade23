"""Runs every system over every log, side by side, and collects what came of it."""

import statistics
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mrtm.evaluation import TimedPoses
from tools.bench.logs import BenchLog, Score, score
from tools.bench.process import Cost, ProcessError, measure
from tools.bench.recording import Recording, read_recording
from tools.bench.systems import Mrtm, OutputError, System, run_record


@dataclass(frozen=True, slots=True)
class Spread:
    """Median, least and greatest of the same number over several runs."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, sample: Sequence[float]) -> "Spread":
        """The spread of a sample of one or more."""
        return cls(statistics.median(sample), min(sample), max(sample))


@dataclass(slots=True)
class Outcome:
    """What a system did on a log, run by run.

    Attributes:
        system: its name.
        costs, scores: one a run that ended well.
        stages: seconds by stage, one a run; only mrtm tells.
        failure: why there is no result, or no further one.
        config: the parameters of mrtm's run.
    """

    system: str
    costs: list[Cost] = field(default_factory=list)
    scores: list[Score] = field(default_factory=list)
    stages: list[dict[str, float]] = field(default_factory=list)
    failure: str = ""
    config: dict[str, Any] = field(default_factory=dict)

    def cost(self, name: str) -> Spread:
        """The spread of ``wall``, ``cpu`` or ``memory``."""
        return Spread.of([getattr(cost, name) for cost in self.costs])


@dataclass(slots=True)
class LogReport:
    """All outcomes on one log, and the log's own figures: scans, seconds, and the score of its odometry alone."""

    log: BenchLog
    scans: int
    duration: float
    odometry: Score
    outcomes: list[Outcome]


def warm_up(system: System, log: BenchLog, limit: float) -> str:
    """Run a system once over a small log, so that its kernels are compiled; what went wrong, or nothing."""
    outcome = Outcome(system.name)
    _run(system, log, read_recording(log.path), outcome, limit)
    return outcome.failure


def run_log(
    log: BenchLog, systems: Sequence[System], runs: int, peer_runs: int, limit: float, tell: Callable[[str], None]
) -> LogReport:
    """Run the systems in turn, ``runs`` times (peers at most ``peer_runs``), so that all see the same machine.

    Args:
        limit: seconds after which a run is stopped.
        tell: told of each run.
    """
    recording = read_recording(log.path)
    outcomes = [Outcome(system.name, failure="" if system.installed() else "not installed") for system in systems]
    for turn in range(runs):
        for system, outcome in zip(systems, outcomes, strict=True):
            if outcome.failure or (turn >= peer_runs and not isinstance(system, Mrtm)):
                continue
            _run(system, log, recording, outcome, limit)
            said = outcome.failure or f"{outcome.costs[-1].wall:.2f} s, {outcome.scores[-1].headline[0]:.4f} m"
            tell(f"{log.name}: {system.name}: run {turn + 1}: {said}")
    odometry = score(log, TimedPoses(recording.times, recording.odometry))
    return LogReport(log, len(recording.times), float(np.ptp(recording.times)), odometry, outcomes)


def _run(system: System, log: BenchLog, recording: Recording, outcome: Outcome, limit: float) -> None:
    with tempfile.TemporaryDirectory(prefix="bench-") as directory:
        work = Path(directory) / "work"
        work.mkdir()
        try:
            command = system.prepare(log, recording, work)
            cost = measure(command, Path(directory) / "printed.txt", limit)
            measured = score(log, system.trajectory(recording, work))
        except (ProcessError, OutputError) as error:
            outcome.failure = str(error)
            return
        outcome.costs.append(cost)
        outcome.scores.append(measured)
        if isinstance(system, Mrtm):
            record = run_record(work)
            outcome.config = record["config"]
            outcome.stages.append(stages(record["timings"], cost.wall))


def stages(timings: dict[str, float], wall: float) -> dict[str, float]:
    """The seconds of a run by stage, and as one stage more what the process took outside of them: mostly imports."""
    named = {stage: seconds for stage, seconds in timings.items() if stage != "total"}
    return {**named, "start-up": wall - sum(named.values())}
