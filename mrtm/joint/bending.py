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
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from factors import GraphEdge, VertexId, factor_of, has_kernel, weight
from frontend import se2
from frontend.local_map import Bends
from frontend.records import FloatArray
from mrtm.robot.poses import array_of

LEAST = 0.3
"""Share of an edge's covariance that is not of bends, at least: these are known of squares of some metres only. On
simulated teams 0.1 to 0.5 come to nearly the same."""


class Holding(NamedTuple):
    """An edge, and where it holds: (k,) shares, as of ``Bends.shares``, in the places of its tail's and its head's map.

    None is at the origin.
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
        return np.asarray(self.bends.shares(poses[:, :2]) @ self.motions)


def bend(
    poses: Mapping[VertexId, gtsam.Pose2], holdings: Collection[Holding], bends: Mapping[VertexId, Bends]
) -> dict[VertexId, BentMap]:
    """The most likely origins and bends of the maps of one component.

    Args:
        poses: joint_T_local, the optimum of its graph; the first is the root, and stays.
        holdings: the edges that are believed, all between these vertices.
        bends: of the maps; a vertex without does not bend.
    """
    unknowns, count = {}, 0
    for vertex in poses:
        unknowns[vertex] = _Unknowns(bends.get(vertex, Bends()), count, root=not count)
        count += len(unknowns[vertex].prior)
    equations = [_equations(h, poses, unknowns[h.edge.tail], unknowns[h.edge.head]) for h in holdings]
    prior = np.concatenate([u.prior for u in unknowns.values()])
    solution = np.zeros(count)
    if equations:
        blocks, right, columns = zip(*equations, strict=True)
        ends = np.cumsum([0, *map(len, blocks)])
        rows = [np.repeat(np.arange(end - len(b), end), b.shape[1]) for end, b in zip(ends[1:], blocks, strict=True)]
        indices = [np.tile(c, len(b)) for c, b in zip(columns, blocks, strict=True)]
        entries = np.concatenate([b.ravel() for b in blocks])
        jacobian = csc_array((entries, (np.concatenate(rows), np.concatenate(indices))), shape=(ends[-1], count))
        normal = jacobian.T @ jacobian + diags_array(prior)
        solution = splu(normal.tocsc()).solve(jacobian.T @ np.concatenate(right))
    return {vertex: u.solved(poses[vertex], solution) for vertex, u in unknowns.items()}


class _Unknowns:
    """Of one map: the motion of its origin, and three for each of its places, of unit variance, that its bends come of.

    Attributes:
        columns: (3 + 3 k,) their numbers.
        prior: (3 + 3 k,) their information.
    """

    def __init__(self, bends: Bends, first: int, root: bool) -> None:
        self.bends = bends
        k = len(bends.places)
        self.columns = first + np.arange(3 + 3 * k)
        self.prior = np.ones(3 + 3 * k)
        self.prior[:3] = float(root)  # nothing moves the root
        self._root = root
        mixing = np.linalg.cholesky(bends.together() + 1e-9 * np.eye(k))
        self._mixing = np.einsum("ij,iab->iajb", mixing, bends.roots())

    def motion(self, shares: FloatArray | None) -> FloatArray:
        """(3, 3 + 3 k) derivative of the motion of what was drawn from the places in ``shares``."""
        origin = np.zeros((3, 3)) if self._root else np.eye(3)
        at = np.zeros(len(self.bends.places)) if shares is None else shares
        return np.concatenate([origin, np.einsum("i,iajb->ajb", at, self._mixing).reshape(3, -1)], axis=1)

    def solved(self, pose: gtsam.Pose2, solution: FloatArray) -> BentMap:
        mine = solution[self.columns]
        origin = pose.compose(gtsam.Pose2.Expmap(mine[:3]))
        return BentMap(origin, self.bends, np.einsum("iajb,jb->ia", self._mixing, mine[3:].reshape(-1, 3)))


def _equations(
    holding: Holding, poses: Mapping[VertexId, gtsam.Pose2], tail: _Unknowns, head: _Unknowns
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What an edge says of the unknowns of its two maps: (n, m) coefficients and (n,) right side, of unit noise, and
    the (m,) numbers of the unknowns."""
    edge = holding.edge
    relative = poses[edge.tail].between(poses[edge.head])
    residual, by_head = edge.residual(relative)
    by_tail = -by_head @ relative.inverse().AdjointMap()
    coefficients = np.concatenate([by_tail @ tail.motion(holding.tail), by_head @ head.motion(holding.head)], axis=1)
    columns = np.concatenate([tail.columns, head.columns])
    bending = np.concatenate([np.arange(len(u.columns)) >= 3 for u in (tail, head)])
    # The covariance without the bends' part of it, in the metric in which it is the unit matrix.
    whiten = np.linalg.inv(np.linalg.cholesky(edge.covariance))
    bent = whiten @ coefficients[:, bending]
    share, axes = np.linalg.eigh(bent @ bent.T)
    own = np.maximum(1.0 - share, LEAST) / _kernel_weight(edge, poses)
    whiten = (axes / np.sqrt(own)).T @ whiten
    return whiten @ coefficients, -whiten @ residual, columns


def _kernel_weight(edge: GraphEdge, poses: Mapping[VertexId, gtsam.Pose2]) -> float:
    """What the graph leaves of the edge's information."""
    factor, values = factor_of(edge, 0, 1), gtsam.Values()
    if not has_kernel(factor):
        return 1.0
    values.insert(0, poses[edge.tail])
    values.insert(1, poses[edge.head])
    return weight(factor, values)
