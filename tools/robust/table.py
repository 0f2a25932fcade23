"""Problems with false edges, told to a robot, and the table of what came of them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.table import Table

from tools.robust.csail import csail
from tools.robust.feed import Outcome, feed
from tools.robust.problem import KINDS, Building, Problem

SHARES = (0.0, 0.1, 0.3, 0.5, 0.7)

STRIDE = 20  # steps of the public set, which are of half a metre, between thoughts


@dataclass(slots=True)
class Row:
    """What came of problems of one sort.

    Attributes:
        false: of what kind and how.
        share: of false ones, of that kind.
        wrong, mixed: false claims believed, and all there were.
        found, true: true claims believed, and all there were.
        ate: metres, of each problem.
        apart: problems after which robots that met were not in one frame.
    """

    false: str
    share: str
    wrong: int = 0
    mixed: int = 0
    found: int = 0
    true: int = 0
    ate: list[float] = field(default_factory=list)
    apart: int = 0

    def count(self, problem: Problem, outcome: Outcome) -> None:
        """Add a problem."""
        self.wrong += sum(not claim.true for claim in outcome.believed)
        self.found += sum(claim.true for claim in outcome.believed)
        self.true += sum(claim.true for claim in problem.claims)
        self.mixed += sum(not claim.true for claim in problem.claims)
        self.ate.append(outcome.ate)
        self.apart += outcome.components > 1


def random_edges(seeds: range) -> Iterator[Row]:
    """0 to 70 % false edges of each kind, then of all kinds at once."""
    for kinds in [*((kind,) for kind in KINDS), KINDS]:
        for share in SHARES:
            row = Row("all kinds" if len(kinds) > 1 else str(kinds[0]), f"{share:.0%}")
            for seed in seeds:
                building = Building(seed)
                _run(row, building.problem.with_claims(building.false(dict.fromkeys(kinds, share))))
            yield row


def clusters(seeds: range) -> Iterator[Row]:
    """Three false edges of a kind that agree with each other."""
    for kind in KINDS:
        row = Row(f"cluster of three: {kind}", "")
        for seed in seeds:
            building = Building(seed)
            _run(row, building.problem.with_claims(building.cluster(kind, 3)))
        yield row


def rooms(seeds: range) -> Iterator[Row]:
    """A building of identical rooms: loops and alignments that take one for another."""
    for share in SHARES[1:]:
        row = Row("identical rooms", f"{share:.0%}")
        for seed in seeds:
            building = Building(seed)
            _run(row, building.problem.with_claims(building.look_alike(share)))
        yield row


def public(data: Path) -> Row:
    """The public two-robot set."""
    problem, row = csail(data), Row("CSAIL, two robots", "66%")
    row.count(problem, feed(problem, STRIDE))
    return row


def table(rows: Iterable[Row]) -> Table:
    """One line a row."""
    shown = Table("false edges", "share", "false", "wrong accepted", "true", "recall", "ATE m, mean", "worst", "apart")
    for row in rows:
        shown.add_row(
            row.false, row.share, str(row.mixed), str(row.wrong), str(row.true), f"{row.found / row.true:.4f}",
            f"{np.mean(row.ate):.3f}", f"{np.max(row.ate):.3f}", str(row.apart),
        )  # fmt: skip
    return shown


def _run(row: Row, problem: Problem) -> None:
    row.count(problem, feed(problem))
