"""The logs of the benchmark, where they are, and how an estimate on them is scored."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mrtm.evaluation import (
    Statistics,
    TimedPoses,
    evaluate_ate,
    evaluate_relations,
    read_relations,
    read_tum,
)

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True, slots=True)
class BenchLog:
    """A log with something to measure against: true ``relations``, or else a ``reference`` trajectory."""

    name: str
    path: Path
    relations: Path | None = None
    reference: Path | None = None

    @property
    def metric(self) -> str:
        """What its headline number is."""
        return "relations, mean" if self.relations else "ATE, RMSE"


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of one trajectory: metres, degrees; how many were ``measured`` and how many ``left_out``."""

    translation: Statistics
    rotation: Statistics
    measured: int
    left_out: int
    relative: bool

    @property
    def headline(self) -> tuple[float, float]:
        """The one number for metres and the one for degrees: the mean over relations, the RMSE of an ATE."""
        if self.relative:
            return self.translation.mean, self.rotation.mean
        return self.translation.rmse, self.rotation.rmse


def score(log: BenchLog, trajectory: TimedPoses) -> Score:
    """Measure a trajectory, whoever made it, with the project's own evaluation.

    Raises:
        EvaluationError: the file with the truth cannot be read.
    """
    if log.relations is not None:
        errors, _ = evaluate_relations(read_relations(log.relations), {"robot": trajectory})
        return Score(errors.translation, errors.rotation, errors.count, errors.no_scan, relative=True)
    assert log.reference is not None
    absolute = evaluate_ate({"robot": read_tum(log.reference)}, {"robot": trajectory})
    return Score(absolute.translation, absolute.rotation, absolute.count, absolute.no_scan, relative=False)


def places() -> list[Path]:
    """Where real logs may be: $MRTM_DATA, ../shared/data, data/cache."""
    given = os.environ.get("MRTM_DATA")
    return ([Path(given)] if given else []) + [ROOT.parent / "shared" / "data", ROOT / "data" / "cache"]


def find_logs(directories: Sequence[Path]) -> dict[str, BenchLog]:
    """The benchmark's logs that are at hand, by name; the demo log always is."""
    found = {"demo": BenchLog("demo", ROOT / "data/demo/red.clf.gz", reference=ROOT / "data/demo/truth/red.tum")}
    for name, stem in (("intel", "intel"), ("aces", "aces"), ("csail", "mit-csail")):
        for directory in directories:
            logs = sorted(directory.glob(f"{stem}.clf*"))
            relations, reference = directory / f"{stem}.relations", directory / f"{stem}.reference.tum"
            if logs and relations.exists():
                found.setdefault(name, BenchLog(name, logs[0], relations=relations))
            elif logs and reference.exists():
                found.setdefault(name, BenchLog(name, logs[0], reference=reference))
    return found
