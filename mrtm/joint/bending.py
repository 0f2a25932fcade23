"""How the local maps of a joint graph bend: where, by all its edges, each scan lies most likely.

A local map is drawn along a way, and errors gather on it: the map is surest at its origin, the vertex, but edges hold
elsewhere, where the robot left it or where another map overlaps. So the covariance of an edge has two parts: the error
of what was measured, and how much the maps may bend between their origins and that place (``Bends``). The second is
common to all edges that hold about there. The joint graph estimates the origins, and takes edges as independent. Here
the bends are unknowns beside the origins: a sparse linear step from the optimum of the graph gives the most likely of
both, and with them the most likely trajectory given all edges (a Gaussian process, conditioned: C. E. Rasmussen, C. K.
I. Williams, "Gaussian Processes for Machine Learning", 2006, 2.7).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from factors import GraphEdge, VertexId, factor_of, has_kernel, weight
from frontend import se2
from frontend.local_map import Bends
from frontend.records import FloatArray
from mrtm.robot.poses import array_of

IntArray = npt.NDArray[np.int64]

LEAST = 0.3
"""Share of an edge's covariance that is not of bends, at least: these are known of squares of some metres only. On
simulated teams 0.1 to 0.5 come to nearly the same."""


class Holding(NamedTuple):
    """An edge, and where it holds: (k,) by how much that moves with each place of its tail's and of its head's map.

    Such as of ``Bends.shares`` or ``Bends.following``; None is at the origin.
    """

    edge: GraphEdge
    tail: FloatArray | None = None
    head: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class BentMap:
    """A local map as it lies in the joint frame.

    Attributes:
        origin: joint_T_local.
        bends: how sure it was of its places.
        motions: (k, 3) by how much what was drawn from each place has moved, in the tangent space at the origin.
    """

    origin: gtsam.Pose2
    bends: Bends
    motions: FloatArray

    def placed(self, poses: FloatArray) -> FloatArray:
        """(n, 3) joint_T_robot of (n, 3) local_T_robot; the map gives way smoothly."""
        return se2.compose(se2.compose(array_of(self.origin), se2.exp(self._motions(poses))), poses)

    def rigid(self, poses: FloatArray) -> gtsam.Pose2:
        """joint_T_local that brings the map, kept rigid, to where its (n > 0, 3) ``poses`` lie on average."""
        return self.origin.compose(gtsam.Pose2.Expmap(self._motions(poses).mean(axis=0)))

    def _motions(self, poses: FloatArray) -> FloatArray:
        if not len(self.motions):
            return np.zeros((len(poses), 3))
        return np.asarray(self.bends.following(poses[:, :2]) @ self.motions)


def bend(
    poses: Mapping[VertexId, gtsam.Pose2], holdings: Collection[Holding], bends: Mapping[VertexId, Bends]
) -> dict[VertexId, BentMap]:
    """The most likely origins and bends of the maps of one component.

    Args:
        poses: joint_T_local, the optimum of its graph; the first is the root, and stays.
        holdings: the edges that are believed, all between these vertices.
        bends: of the maps; a vertex without does not bend.
    """
    unknowns: dict[VertexId, _Unknowns] = {}
    count = 0
    for vertex in poses:
        unknowns[vertex] = _Unknowns(count, bends.get(vertex, Bends()))
        count += len(unknowns[vertex].prior)
    normal, right = diags_array(np.concatenate([one.prior for one in unknowns.values()])).tocsc(), np.zeros(count)
    if holdings:
        equations = [_equation(h, poses, unknowns[h.edge.tail], unknowns[h.edge.head]) for h in holdings]
        blocks, residuals, columns = zip(*equations, strict=True)
        rows = np.split(np.arange(sum(map(len, blocks))), np.cumsum([len(block) for block in blocks])[:-1])
        row = np.concatenate([np.repeat(r, len(c)) for r, c in zip(rows, columns, strict=True)])
        column = np.concatenate([np.tile(c, len(r)) for r, c in zip(rows, columns, strict=True)])
        jacobian = csc_array((np.concatenate([b.ravel() for b in blocks]), (row, column)), (row[-1] + 1, count))
        normal, right = (normal + jacobian.T @ jacobian).tocsc(), -(jacobian.T @ np.concatenate(residuals))
    # GTSAM's elimination takes a robot that is almost lost against its past for one that is not connected.
    solver = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    solution = solver.solve(right)
    return {vertex: one.solved(poses[vertex], solution) for vertex, one in unknowns.items()}


class _Unknowns:
    """Of one map: the motion of its origin, and three of unit variance for each of its places, that its bends come of.

    Attributes:
        columns: (3 + 3 k,) their numbers, from 0 for the root's on.
        prior: (3 + 3 k,) the information on them: none on the motion of origins. The root has none, and needs little to
            stay, as edges only move origins against each other.
    """

    def __init__(self, first: int, bends: Bends) -> None:
        self._bends = bends
        k = len(bends.places)
        self.columns = first + np.arange(3 + 3 * k)
        self.prior = np.ones(3 + 3 * k)
        self.prior[:3] = 0.0 if first else 1.0
        mixing = np.linalg.cholesky(bends.together() + 1e-9 * np.eye(k))
        self._mixing = np.einsum("ij,iab->iajb", mixing, bends.roots())

    def bent(self, where: FloatArray | None) -> FloatArray:
        """(3, 3 k) derivative of how an edge's place, as in ``Holding``, moves against the origin."""
        at = np.zeros(len(self._bends.places)) if where is None else where
        return np.asarray(np.einsum("i,iajb->ajb", at, self._mixing).reshape(3, -1))

    def solved(self, pose: gtsam.Pose2, solution: FloatArray) -> BentMap:
        """The map at the solution of the equations."""
        mine = solution[self.columns]
        motions = np.einsum("iajb,jb->ia", self._mixing, mine[3:].reshape(-1, 3))
        return BentMap(pose.compose(gtsam.Pose2.Expmap(mine[:3])), self._bends, motions)


def _equation(
    holding: Holding, poses: Mapping[VertexId, gtsam.Pose2], tail: _Unknowns, head: _Unknowns
) -> tuple[FloatArray, FloatArray, IntArray]:
    """What an edge says of the unknowns of its two maps: (n, m) coefficients and (n,) residuals of unit noise, and the
    (m,) numbers of the unknowns."""
    edge = holding.edge
    relative = poses[edge.tail].between(poses[edge.head])
    residual, by_head = edge.residual(relative)
    by_tail = -by_head @ relative.inverse().AdjointMap()
    by_bends = by_tail @ tail.bent(holding.tail), by_head @ head.bent(holding.head)
    # The covariance without the bends' part of it, in the metric in which it is the unit matrix.
    whiten = np.linalg.inv(np.linalg.cholesky(edge.covariance))
    share, axes = np.linalg.eigh(whiten @ sum(by @ by.T for by in by_bends) @ whiten.T)
    own = np.maximum(1.0 - share, LEAST) / _kernel_weight(edge, poses)
    whiten = (axes / np.sqrt(own)).T @ whiten
    of_tail, of_head = (
        whiten @ np.concatenate(both, axis=1) for both in zip((by_tail, by_head), by_bends, strict=True)
    )
    return np.concatenate([of_tail, of_head], axis=1), whiten @ residual, np.concatenate([tail.columns, head.columns])


def _kernel_weight(edge: GraphEdge, poses: Mapping[VertexId, gtsam.Pose2]) -> float:
    """What the graph leaves of the edge's information."""
    factor, values = factor_of(edge, 0, 1), gtsam.Values()
    if not has_kernel(factor):
        return 1.0
    values.insert(0, poses[edge.tail])
    values.insert(1, poses[edge.head])
    return weight(factor, values)
