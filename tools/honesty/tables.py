"""The tables: built once, printed in the terminal and written as Markdown."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from rich.table import Table as RichTable

from factors import EdgeKind
from tools.honesty.runs import ENTERING, JUST, VERTEX, Honesty, Innovation, Sample
from tools.honesty.statistics import components, honest_mean, verdict

KINDS = (
    str(EdgeKind.INTER_VERTEX),
    str(EdgeKind.COVARIANCE_INTERSECTION),
    str(EdgeKind.LOOP),
    ENTERING,
    str(EdgeKind.ALIGNMENT),
    VERTEX,
)
ALL = "all"
BROKEN = 0.5
"""Metres of ATE from which a map is broken."""


@dataclass(slots=True)
class Table:
    """Rows of text under a title and a header; the first ``labels`` columns are words, the others numbers."""

    title: str
    header: list[str]
    labels: int
    rows: list[list[str]] = field(default_factory=list)

    def rich(self) -> RichTable:
        """For the terminal."""
        table = RichTable(title=self.title, title_justify="left")
        for i, name in enumerate(self.header):
            table.add_column(name, justify="left" if i < self.labels else "right", no_wrap=True)
        for row in self.rows:
            table.add_row(*row)
        return table

    def markdown(self) -> str:
        """For a file."""
        rule = [":--" if i < self.labels else "--:" for i in range(len(self.header))]
        lines = [" | ".join(row) for row in (self.header, rule, *self.rows)]
        return f"## {self.title}\n\n" + "".join(f"| {line} |\n" for line in lines)


def tables(runs: Sequence[Honesty]) -> list[Table]:
    """Everything there is to say; a table without rows is left out."""
    samples = [sample for run in runs for sample in run.samples]
    innovations = [innovation for run in runs for innovation in run.innovations]
    found = [
        _verdicts("NEES / 3 by plan", samples, lambda s: s.plan),
        _verdicts(f"NEES / 3 by resampling (just: at one of the last {JUST} key scans)", samples, _resampling),
        _components(samples),
        _false_loops(samples),
        _maps(runs),
        _innovations(innovations),
    ]
    return [table for table in found if table.rows]


def groups(samples: Iterable[Sample], key: Callable[[Sample], str]) -> dict[tuple[str, str], list[Sample]]:
    """Samples by kind (in the order of KINDS) and key, and of each kind all together."""
    found: dict[tuple[str, str], list[Sample]] = {}
    for sample in samples:
        for name in (key(sample), ALL):
            found.setdefault((sample.kind, name), []).append(sample)
    order = list(found)
    return {k: found[k] for k in sorted(found, key=lambda k: (KINDS.index(k[0]), k[1] == ALL, order.index(k)))}


def _resampling(sample: Sample) -> str:
    if sample.since_resampling is None:
        return "-"
    return "just" if sample.since_resampling < JUST else "not"


def _verdicts(title: str, samples: Sequence[Sample], key: Callable[[Sample], str]) -> Table:
    header = ["kind", "group", "n", "runs", "mean", "bootstrap 95 %", "honest 95 %", "median", "beyond 95 %", ""]
    table = Table(title, header, 2)
    for (kind, name), chosen in groups(samples, key).items():
        v = verdict(chosen)
        if v is None or name == "-" or (kind == VERTEX and key is _resampling):
            continue
        word = "" if v.is_honest else ("over-confident" if v.mean > 1.0 else "too modest")
        low, high = v.bootstrap
        row = [kind, name, str(v.count), str(v.runs), f"{v.mean:.2f}", f"{low:.2f}-{high:.2f}"]
        row += [f"{v.chi2[0]:.2f}-{v.chi2[1]:.2f}", f"{v.median:.2f}", f"{100 * v.beyond:.0f} %", word]
        table.rows.append(row)
    return table


def _components(samples: Sequence[Sample]) -> Table:
    header = ["kind", "group", "component", "rms error", "rms sigma", "rms error/sigma", "bias"]
    table = Table("Components of the error (mm, mrad; x, y, theta in the frame of the child)", header, 3)
    for (kind, name), chosen in groups(samples, lambda s: s.plan).items():
        for c in components(chosen, axis_aligned=name.startswith("corridor")):
            numbers = [f"{1000 * c.error:.1f}", f"{1000 * c.sigma:.1f}", f"{c.ratio:.2f}", f"{1000 * c.bias:+.1f}"]
            table.rows.append([kind, name, c.name, *numbers])
    return table


def _false_loops(samples: Sequence[Sample]) -> Table:
    table = Table("False loops", ["plan", "seed", "edge", "metres", "rad", "NEES / 3"], 3)
    for s in samples:
        if s.kind == EdgeKind.LOOP and s.is_false:
            numbers = [f"{s.distance:.2f}", f"{abs(s.error[2]):.3f}", f"{s.nees:.0f}"]
            table.rows.append([s.plan, str(s.seed), s.name, *numbers])
    return table


def _maps(runs: Sequence[Honesty]) -> Table:
    table = Table("Maps", ["plan", "n", f"broken (ATE > {BROKEN} m)", "median ATE (m)", "worst", "broken seeds"], 1)
    for plan in dict.fromkeys(run.source for run in runs if run.samples):
        ates = {run.seed: run.ate for run in runs if run.source == plan}
        broken = [seed for seed, ate in ates.items() if not ate <= BROKEN]
        numbers = [f"{np.median(list(ates.values())):.3f}", f"{max(ates.values()):.3f}"]
        table.rows.append([plan, str(len(ates)), str(len(broken)), *numbers, " ".join(map(str, broken)) or "-"])
    return table


def _innovations(innovations: Sequence[Innovation]) -> Table:
    header = ["event", "source", "n", "mean", "honest 95 %", "median", "rms x, y (mm)", "rms theta (mrad)"]
    table = Table("Normalised innovations (squared Mahalanobis distance / 3)", header, 2)
    found: dict[tuple[str, str], list[Innovation]] = {}
    for innovation in innovations:
        found.setdefault((innovation.kind, innovation.source), []).append(innovation)
    for (kind, source), chosen in sorted(found.items(), key=lambda item: item[0][0]):
        values = np.array([i.normalised for i in chosen])
        rms = 1000 * np.sqrt(np.mean([i.offset**2 for i in chosen], axis=0))
        low, high = honest_mean(len(values))
        row = [kind, source, str(len(values)), f"{values.mean():.2f}", f"{low:.2f}-{high:.2f}"]
        table.rows.append([*row, f"{np.median(values):.2f}", f"{rms[0]:.0f}, {rms[1]:.0f}", f"{rms[2]:.1f}"])
    return table
