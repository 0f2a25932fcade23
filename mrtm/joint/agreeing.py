"""Edges that agree with each other, whatever the estimate between their places says.

Two measured transforms between the same two places agree if the way from one to the other and back, through the graph
near either place, closes: pairwise consistency (Mangelson, Dominic, Eustice and Vasudevan 2018, "Pairwise consistent
measurement set maximization for robust multi-robot map merging").
"""

from collections.abc import Callable, Container, Mapping, Sequence

import gtsam
import numpy as np

from factors import EdgeId, GraphEdge, UncertainPose, VertexId, adjoint_transport, compose, inverse, squared_mahalanobis
from factors.noise import FloatArray
from mrtm.joint.equations import Equations

PARTNERS = 12  # those that may agree best, for which the covariance is worked out

_TURN = 5.0  # metres that count as much as a radian
_FAR = 5.0  # metres off: not worth the work

_Step = tuple[VertexId, VertexId, UncertainPose]


def agreeing(
    equations: Equations, edge_id: EdgeId, others: Sequence[EdgeId], explains: Callable[[float, FloatArray], bool]
) -> list[EdgeId]:
    """Those of the others that agree with an edge; none if it does not fix a pose.

    Args:
        explains: whether chi2 under a (3, 3) covariance is that of edges that agree.
    """
    mine = _forward(equations.edges[edge_id])
    if mine is None:
        return []
    found: list[tuple[float, EdgeId, _Step]] = []
    for i in others:
        theirs = _forward(equations.edges[i])
        if theirs is not None:
            both = [(_off(equations, mine, step), i, step) for step in (theirs, _back(theirs))]
            found.append(min(both, key=lambda one: one[0]))
    near = sorted((one for one in found if one[0] < _FAR), key=lambda one: one[:2])[:PARTNERS]
    closures = _closures(equations, mine, [step for *_, step in near])
    return [i for (_, i, _), closure in zip(near, closures, strict=True) if explains(*closure)]


def clique(start: EdgeId, agreeing: Mapping[EdgeId, set[EdgeId]], among: Container[EdgeId]) -> list[EdgeId]:
    """Edges that all agree with each other, ``start`` first: greedily, those that agree with most first."""
    partners = {i for i in agreeing[start] if i in among}
    members = [start]
    for i in sorted(partners, key=lambda i: (-len(agreeing[i] & partners), i)):
        if all(i in agreeing[j] for j in members):
            members.append(i)
    return members


def _forward(edge: GraphEdge) -> _Step | None:
    return None if edge.estimate is None else (edge.tail, edge.head, edge.estimate)


def _back(step: _Step) -> _Step:
    return step[1], step[0], inverse(step[2])


def _off(equations: Equations, one: _Step, other: _Step) -> float:
    """How far the way round is from closing, metres."""
    there = equations.pose(one[0]).between(equations.pose(other[0]))
    beyond = equations.pose(one[1]).between(equations.pose(other[1]))
    x, y, theta = gtsam.Pose2.Logmap(one[2].pose.compose(beyond).between(there.compose(other[2].pose)))
    return float(np.hypot(x, y) + _TURN * abs(theta))


def _closures(equations: Equations, one: _Step, others: Sequence[_Step]) -> list[tuple[float, FloatArray]]:
    """chi2 of the way round by each of the others, and the covariance it has."""
    near = equations.relatives([pair for other in others for pair in ((one[0], other[0]), (one[1], other[1]))])
    found = []
    for other, there, beyond in zip(others, near[::2], near[1::2], strict=True):
        through, direct = compose(there, other[2]), compose(one[2], beyond)
        offset = direct.pose.between(through.pose)
        covariance = through.covariance + adjoint_transport(offset.inverse(), direct.covariance)
        residual = gtsam.Pose2.Logmap(offset)
        found.append((float(squared_mahalanobis(residual, covariance)), covariance))
    return found
