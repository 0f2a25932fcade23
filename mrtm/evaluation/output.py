"""Evaluate what a run left behind in its output directory."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from frontend import se2
from frontend.records import FloatArray
from mrtm.evaluation.ate import AbsoluteErrors, evaluate_ate
from mrtm.evaluation.errors import EvaluationError
from mrtm.evaluation.meetings import Meetings, evaluate_meetings
from mrtm.evaluation.nees import nees
from mrtm.evaluation.relations import RelationErrors, evaluate_relations, read_relations
from mrtm.evaluation.run_file import RunFile, read_run
from mrtm.evaluation.statistics import Statistics
from mrtm.evaluation.trajectory import TimedPoses, interpolate, no_common_time, read_tum
from mrtm.output.files import replacing, to_json
from mrtm.output.place import check_outputs

_Name = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Honesty:
    """Normalised estimation error squared of ``count`` poses against the truth; a mean near 1 is honest."""

    nees: Statistics
    count: int


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What could be measured with what was given; None or empty where it was not.

    Attributes:
        relations: the relations metric over all relations.
        relations_across: the same over relations between different robots' logs.
        ate: the absolute trajectory error, one entry a connected component.
        vertices: honesty of the joint vertex poses, seen from their component's root.
        edges: honesty of the accepted edges, by kind.
        meetings: what a team's meetings cost and brought; this needs no truth.
    """

    relations: RelationErrors | None = None
    relations_across: RelationErrors | None = None
    ate: tuple[AbsoluteErrors, ...] = ()
    vertices: Honesty | None = None
    edges: dict[str, Honesty] | None = None
    meetings: Meetings | None = None


def evaluate_output(
    out: Path, relations: Path | None = None, truth: Mapping[str, Path] | Path | None = None
) -> Evaluation:
    """Measure the run in ``out`` and write ``out/evaluation.json``.

    Args:
        out: a directory that a run wrote: ``run.json`` and ``trajectory/*.tum`` are read.
        relations: a file of true relative poses.
        truth: TUM files by robot; a single file will do for a run of one robot.

    Raises:
        EvaluationError: a file is missing or malformed, or ``truth`` names no robot of the run, or one file has
            no time in common with it.
        OutputError: ``out`` cannot be written into, or what is measured against would be written over.
        OSError: the file cannot be written in the end.
    """
    run = read_run(out)
    given = [*((relations,) if relations else ()), *((truth,) if isinstance(truth, Path) else (truth or {}).values())]
    check_outputs([(out, re.compile(r"evaluation\.json"))], given)
    components = {robot: entry["component"] for robot, entry in run["robots"].items()}
    trajectories = {robot: read_tum(out / "trajectory" / f"{robot}.tum") for robot in components}
    everywhere, across = (None, None)
    if relations is not None:
        true = read_relations(relations)
        everywhere, across = evaluate_relations(true, trajectories, components)
        if everywhere.no_scan == len(true.times):
            raise no_common_time(relations, true.times, trajectories.values())
    references = {}
    for robot, path in _by_robot(truth, list(components)).items():
        references[robot] = read_tum(path)
        if not interpolate(trajectories[robot], references[robot].times)[1].any():
            raise no_common_time(path, references[robot].times, [trajectories[robot]])
    measured = sorted({components[robot] for robot in references})
    frames = _true_frames(run, references)
    evaluation = Evaluation(
        relations=everywhere,
        relations_across=across,
        ate=tuple(
            evaluate_ate(references, {r: t for r, t in trajectories.items() if components[r] == component})
            for component in measured
        ),
        vertices=_vertex_honesty(run, frames) if references else None,
        edges=_edge_honesty(run, frames) if references else None,
        meetings=evaluate_meetings(run["team"]) if "team" in run else None,
    )
    with replacing(out / "evaluation.json") as temporary:
        temporary.write_text(to_json(asdict(evaluation)), encoding="utf-8")
    return evaluation


def _by_robot(truth: Mapping[str, Path] | Path | None, robots: list[str]) -> Mapping[str, Path]:
    if truth is None:
        return {}
    if isinstance(truth, Path):
        if len(robots) != 1:
            names = ", ".join(robots)
            raise EvaluationError(f"{truth}: one truth for {len(robots)} robots ({names}); name one each in --session")
        return {robots[0]: truth}
    for robot, path in truth.items():
        if robot not in robots:
            raise EvaluationError(f"{path}: truth of {robot!r}, but the run has only {', '.join(robots)}")
    return truth


def _true_frames(run: RunFile, references: Mapping[str, TimedPoses]) -> dict[_Name, FloatArray]:
    """world_T_local of every vertex whose first scan the references know."""
    frames = {}
    for vertex in run["vertices"]:
        robot, first = vertex["id"][0], vertex["first_scan"]
        if robot not in references or first is None:
            continue
        pose, found = interpolate(references[robot], np.array([first["time"]]))
        if found[0]:
            frames[vertex["id"]] = se2.compose(pose[0], se2.inverse(np.array(first["pose"])))
    return frames


def _vertex_honesty(run: RunFile, frames: dict[_Name, FloatArray]) -> Honesty:
    vertices = {vertex["id"]: vertex for vertex in run["vertices"]}
    true, estimated, covariances = [], [], []
    for component in run["components"]:
        root, *others = component
        for name in others:
            if root in frames and name in frames and vertices[name]["covariance"] is not None:
                true.append(se2.between(frames[root], frames[name]))
                estimated.append(se2.between(np.array(vertices[root]["pose"]), np.array(vertices[name]["pose"])))
                covariances.append(vertices[name]["covariance"])
    return _honesty(true, estimated, covariances)


def _edge_honesty(run: RunFile, frames: dict[_Name, FloatArray]) -> dict[str, Honesty]:
    kinds: dict[str, list[tuple[Any, Any, Any]]] = {}
    for edge in run["edges"]:
        tail, head = edge["tail"], edge["head"]
        if edge["fate"] == "accepted" and "measurement" in edge and tail in frames and head in frames:
            true = se2.between(frames[tail], frames[head])
            kinds.setdefault(edge["kind"], []).append((true, edge["measurement"], edge["covariance"]))
    return {kind: _honesty(*map(list, zip(*rows, strict=True))) for kind, rows in kinds.items()}


def _honesty(true: list[Any], estimated: list[Any], covariances: list[Any]) -> Honesty:
    count = len(true)
    sample = nees(
        np.reshape(true, (count, 3)), np.reshape(estimated, (count, 3)), np.reshape(covariances, (count, 3, 3))
    )
    return Honesty(Statistics.of(sample), count)
