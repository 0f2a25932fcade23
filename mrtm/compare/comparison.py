"""The comparison the project is about: the paper's off-line EM (M13) against the on-line optimisation."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from factors import VertexId
from mrtm.compare.table import Row, markdown
from mrtm.compare.ways import Way, three_ways
from mrtm.evaluation import (
    RelationErrors,
    Relations,
    TimedPoses,
    evaluate_ate,
    evaluate_relations,
    read_relations,
    read_tum,
)
from mrtm.joint.crispness import Crispness, crispness
from mrtm.output.files import replacing, to_json
from mrtm.output.paper_figures import draw_paper_figures
from mrtm.progress import Progress
from mrtm.result import RunResult


@dataclass(frozen=True, slots=True)
class Score:
    """How good one way is; None where nothing was given to measure it with.

    Attributes:
        name: of the way.
        relations: the relations metric over all relations; relations_across: over those between different robots.
        ate: metres, RMSE of the positions after one alignment, of the component with most reference poses.
        crispness: of all components together.
        seconds, updates, over_run, longest, available: see :class:`mrtm.compare.ways.Way`.
    """

    name: str
    relations: RelationErrors | None
    relations_across: RelationErrors | None
    ate: float | None
    crispness: Crispness
    seconds: float
    updates: int
    over_run: float
    longest: float
    available: str


def compare(
    result: RunResult,
    out: Path,
    relations: Path | None = None,
    truth: Mapping[str, Path] | None = None,
    progress: Progress = lambda fraction, doing: None,
) -> tuple[Score, ...]:
    """Make the joint map of a finished run three ways, score each, and draw the paper's figures for it.

    Writes ``comparison.md``, ``comparison.json`` and ``fig3-ROBOT.png`` to ``fig6.png`` into ``out``.

    Args:
        result: the run, with its on-line optimum.
        relations: a file of true relative poses.
        truth: TUM files by robot.

    Returns:
        The scores of tree only, off-line EM and on line, for :func:`mrtm.compare.table.rows`.

    Raises:
        EvaluationError: a file of the truth cannot be read.
    """
    true = None if relations is None else read_relations(relations)
    references = {robot: read_tum(path) for robot, path in (truth or {}).items()}
    out.mkdir(parents=True, exist_ok=True)
    ways = three_ways(result, lambda fraction, doing: progress(0.5 * fraction, doing))
    progress(0.5, "measuring")
    scores = tuple(_score(way, true, references) for way in ways)
    progress(0.6, "drawing")
    draw_paper_figures(result, [(way.name, way.result) for way in ways], out)
    with replacing(out / "comparison.json") as path:
        path.write_text(to_json({"ways": [asdict(score) for score in scores]}), encoding="utf-8")
    with replacing(out / "comparison.md") as path:
        path.write_text(markdown(rows(scores)), encoding="utf-8")
    progress(1.0, "compared")
    return scores


def rows(scores: tuple[Score, ...]) -> list[Row]:
    """The table of a comparison; what was not measured has no row."""
    table = [Row("", tuple(score.name for score in scores))]
    for name, errors in (
        ("relations", [score.relations for score in scores]),
        ("across robots", [score.relations_across for score in scores]),
    ):
        measured = [e for e in errors if e is not None and e.count]
        if len(measured) == len(scores):
            counted = f"{name} ({measured[0].count})"
            cells = [f"{e.translation.mean:.4f} ± {e.translation.std:.4f}" for e in measured]
            table.append(Row(f"{counted}, m", tuple(cells)))
            table.append(Row(f"{name}, deg", tuple(f"{e.rotation.mean:.3f}" for e in measured)))
    if all(score.ate is not None for score in scores):
        table.append(Row("ATE RMSE, m", tuple(f"{score.ate:.4f}" for score in scores)))
    table += [
        Row("entropy of overlap, bits", tuple(f"{s.crispness.entropy:.4f}" for s in scores)),
        Row("of it disagreement", tuple(f"{s.crispness.disagreement:.4f}" for s in scores)),
        Row("optimised once, at the end, s", tuple(f"{s.seconds:.3f}" for s in scores)),
        Row(f"at each of {scores[0].updates} updates, s", tuple(f"{s.over_run:.2f}" for s in scores)),
        Row("longest wait, s", tuple(f"{s.longest:.4f}" for s in scores)),
        Row("joint map available", tuple(s.available for s in scores)),
    ]
    return table


def _score(way: Way, relations: Relations | None, references: Mapping[str, TimedPoses]) -> Score:
    result = way.result
    component_of = {vertex: number for number, component in enumerate(result.components) for vertex in component}
    trajectories = {robot: TimedPoses(t.times, t.poses) for robot, t in result.trajectories.items()}
    robots = {robot: component_of[VertexId(robot, int(t.vertices[0]))] for robot, t in result.trajectories.items()}
    everywhere, across = (None, None) if relations is None else evaluate_relations(relations, trajectories, robots)
    errors = [
        evaluate_ate(references, {r: t for r, t in trajectories.items() if robots[r] == number})
        for number in sorted({robots[r] for r in references if r in robots})
    ]
    best = max(errors, key=lambda e: e.count, default=None)
    return Score(
        name=way.name,
        relations=everywhere,
        relations_across=across,
        ate=None if best is None else best.translation.rmse,
        crispness=_crispness(result),
        seconds=way.seconds,
        updates=way.updates,
        over_run=way.over_run,
        longest=way.longest,
        available=way.available,
    )


def _crispness(result: RunResult) -> Crispness:
    """Of all components, each in its own frame, weighted by the area that overlaps."""
    found = [crispness(result.placed_maps(component)) for component in result.components]
    found = [c for c in found if c.area]
    area = sum(c.area for c in found)
    if not found:
        return Crispness(math.nan, math.nan, 0.0)
    return Crispness(
        sum(c.entropy * c.area for c in found) / area, sum(c.disagreement * c.area for c in found) / area, area
    )
