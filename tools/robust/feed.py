"""A problem told to a robot in the order in which it would have come, and what it believes at the end.

Loops come as records of edges, fusing edges as records of sightings, and all that a ``Teammate`` does with them is
done. Alignments, which it would find in maps, are put where it keeps those it has found.
"""

from collections import defaultdict
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import Edge, EdgeId, EdgeKind, UncertainPose, adjoint_transport
from factors.sighting import Sighting
from frontend import se2
from frontend.local_map import Grid, LocalMap
from mrtm.config import load_config
from mrtm.evaluation.ate import align
from mrtm.joint.alignment.aligner import Attempt
from mrtm.joint.alignment.surface import Surface
from mrtm.joint.sightings.consistency import Verdict
from mrtm.robot.poses import array_of
from mrtm.team.records import AnchorRecord, EdgeRecord, Record, SightingRecord, VertexRecord
from mrtm.team.teammate import Peers, Teammate
from mrtm.timing import Stages
from tools.robust.problem import Claim, Problem

_AHEAD = gtsam.Pose2(1.0, 0.0, 0.0)  # of the observer, where it sees the other robot
_EXACTLY = 1e-4  # metres and radians
_FIRST = 100_000  # number of a claim, beyond those of the ways


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is believed at the end.

    Attributes:
        believed: the claims.
        ate: metres, RMSE of all vertices, every component laid on the truth by itself; NaN if that is not known.
        components: how many.
    """

    believed: frozenset[Claim]
    ate: float
    components: int


def feed(problem: Problem, every: int = 1) -> Outcome:
    """Tell a teammate everything, step by step.

    Args:
        every: so many steps it thinks, and at the end.
    """
    one = Teammate(None, load_config(), Stages(), Peers())
    steps: defaultdict[int, list[Record]] = defaultdict(list)
    alignments: defaultdict[int, list[Edge]] = defaultdict(list)
    for edge in problem.way:
        step = edge.head.number
        steps[step] += [VertexRecord(v, 0, float(step), 1) for v in (edge.tail, edge.head)]
        steps[step].append(EdgeRecord(edge, float(step)))
    for number, claim in enumerate(problem.claims, _FIRST):
        if claim.kind is EdgeKind.LOOP:
            steps[claim.step].append(EdgeRecord(_edge(claim, number), float(claim.step)))
        elif claim.kind is EdgeKind.FUSING:
            steps[claim.step] += _sighting(claim, number)
        else:
            alignments[claim.step].append(_edge(claim, number))
    found: list[Edge] = []
    for step in sorted(steps):
        one.store.merge(steps[step])
        found += alignments[step]
        # All of them: it forgets those between robots that are not in one frame.
        one.aligner.attempts = {(e.tail, e.head): Attempt(_MAPS, e.estimate, None, e, "") for e in found}
        if step % every == 0 or step == max(steps):
            one.think()
    return Outcome(_believed(one, problem), _ate(one, problem), len(one.joint.components()))


def _edge(claim: Claim, number: int) -> Edge:
    robot = claim.tail.robot if claim.kind is EdgeKind.LOOP else f"{claim.tail}={claim.head}"
    return Edge(EdgeId(robot, number), 0, claim.kind, claim.tail, claim.head, claim.pose, claim.covariance)


def _sighting(claim: Claim, number: int) -> list[Record]:
    """A sighting that measures what is claimed: its own noise is next to none, all of it is in the observer's pose."""
    at = UncertainPose(claim.pose.compose(_AHEAD.inverse()), adjoint_transport(_AHEAD, claim.covariance))
    exact = UncertainPose(gtsam.Pose2(), _EXACTLY**2 * np.eye(3))
    time, ends = float(claim.step), ((claim.tail.robot, number), (claim.head.robot, number))
    sighting = Sighting(1.0, 0.0, 0.0, _EXACTLY, _EXACTLY, _EXACTLY)
    return [
        SightingRecord(claim.tail.robot, number, 0, time, claim.head.robot, sighting, *ends),
        AnchorRecord(*ends[0], 1, time, claim.tail, at),
        AnchorRecord(*ends[1], 1, time, claim.head, exact),
    ]


def _believed(one: Teammate, problem: Problem) -> frozenset[Claim]:
    graphs = [component.graph for component in one.joint.components()]
    doubted = {i for graph in graphs for i in graph.doubted()}
    edges = {edge.id.number for graph in graphs for edge in graph.edges() if edge.id not in doubted}
    refused = {frozenset((e.tail, e.head)) for graph in graphs for e in graph.edges()
               if e.id in doubted and e.kind is EdgeKind.FUSING}  # fmt: skip
    accepted = {number for (_, number), j in one.judgements.items() if j.verdict is Verdict.ACCEPTED}
    return frozenset(
        claim
        for number, claim in enumerate(problem.claims, _FIRST)
        if number in edges or (number in accepted and frozenset((claim.tail, claim.head)) not in refused)
    )


def _ate(one: Teammate, problem: Problem) -> float:
    if problem.truth is None:
        return float("nan")
    squares = []
    for component in one.joint.components():
        poses = component.graph.estimates()
        truth = np.array([array_of(problem.truth[v]) for v in poses])
        estimate = np.array([array_of(pose) for pose in poses.values()])
        laid = se2.compose(align(truth[:, :2], estimate[:, :2]), estimate)
        squares.extend(np.square(laid[:, :2] - truth[:, :2]).sum(axis=1).tolist())
    return float(np.sqrt(np.mean(squares)))


def _no_map() -> Surface:
    none = np.empty((0, 2))
    grid = Grid(np.zeros((1, 1), np.float32), 0.05, np.zeros(2))
    return Surface.of(LocalMap(grid, np.empty(0, np.int64), np.empty(0), np.empty((0, 3)), none, none))


_MAPS = (_no_map(), _no_map())
