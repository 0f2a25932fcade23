"""What a graph believes, as equations: its edges that are not doubted, their factors, and the poses that fit them."""

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence

import gtsam

from factors import EdgeId, EdgeKind, GraphEdge, UncertainPose, VertexId, factor_of, squared_mahalanobis, without_kernel
from mrtm.joint.expectation import Expectation
from mrtm.joint.smoother import Smoother

CERTAIN = {EdgeKind.INTER_VERTEX, EdgeKind.COVARIANCE_INTERSECTION}
"""Kinds of edges that cannot be false: where the robot went from one vertex to the next it was there all the time."""

FUSED = {EdgeKind.FUSING, EdgeKind.SIGHTING}
"""Kinds that sightings make, of which those that may be false were left out with care (``mrtm.joint.sightings``)."""


class Equations:
    """A graph while it is changed; everything given is the graph's own and changes with it.

    Args:
        smoother: the solver.
        keys: its variable of every vertex.
        edges: all.
        doubted: those of them that are not in the solver, and chi2 of each when it was last judged.
    """

    def __init__(
        self,
        smoother: Smoother,
        keys: Mapping[VertexId, int],
        edges: Mapping[EdgeId, GraphEdge],
        doubted: dict[EdgeId, float],
    ) -> None:
        self._smoother, self._keys = smoother, keys
        self.edges, self.doubted = edges, doubted

    def pose(self, vertex: VertexId) -> gtsam.Pose2:
        """joint_T_vertex."""
        return self._smoother.pose(self._keys[vertex])

    def relatives(self, pairs: Sequence[tuple[VertexId, VertexId]]) -> list[UncertainPose]:
        """a_T_b of every pair, covariance in the frame of b."""
        covariances = self._smoother.relative_covariances([(self._keys[a], self._keys[b]) for a, b in pairs])
        poses = (self.pose(a).between(self.pose(b)) for a, b in pairs)
        return [UncertainPose(pose, covariance) for pose, covariance in zip(poses, covariances, strict=True)]

    def misfit(self, edge: GraphEdge) -> float:
        """chi2 of an edge at the estimate over its own covariance."""
        return misfit(edge, self.pose(edge.tail), self.pose(edge.head))

    def expectation(self, edges: Sequence[GraphEdge]) -> Expectation:
        """Of edges that are not believed, TOGETHER or fewer."""
        known = self._smoother.joint_covariance([(self._keys[e.tail], self._keys[e.head]) for e in edges])
        return Expectation(edges, [self.pose(e.tail).between(self.pose(e.head)) for e in edges], known)

    def cost(self) -> float:
        """The sum of chi2 of all that is believed, without kernels."""
        return sum(self.misfit(edge) for i, edge in self.edges.items() if i not in self.doubted)

    def may_go(self, leaving: Collection[EdgeId]) -> bool:
        """Whether all vertices are held without some of the edges that are believed."""
        rest = [e for i, e in self.edges.items() if i not in self.doubted and i not in leaving]
        return not cut_off(self._keys.keys() - {next(iter(self._keys))}, rest)

    def believe(self, ids: Collection[EdgeId], kernel: bool = True) -> None:
        """Let doubted edges in, at their full weight if not under their kernel."""
        self._smoother.update({i: self._factor(i, kernel) for i in ids}, gtsam.Values(), ())
        if not kernel:
            # A kernel that follows is to weigh the optimum, not the first step towards it.
            self._smoother.settle(roughly=True)
        for i in ids:
            del self.doubted[i]

    def put_under_kernel(self, ids: Collection[EdgeId]) -> None:
        """Of edges that were let in at their full weight."""
        self._smoother.update({i: self._factor(i, True) for i in ids}, gtsam.Values(), ids)

    def doubt(self, ids: Collection[EdgeId]) -> None:
        """Take edges out of the equations."""
        self._smoother.update({}, gtsam.Values(), ids)
        self._smoother.come_to_rest()
        self.doubted.update({i: self.misfit(self.edges[i]) for i in ids})

    def _factor(self, edge_id: EdgeId, kernel: bool) -> gtsam.NoiseModelFactor:
        edge = self.edges[edge_id]
        factor = factor_of(edge, self._keys[edge.tail], self._keys[edge.head])
        return factor if kernel else without_kernel(factor)


def misfit(edge: GraphEdge, tail: gtsam.Pose2, head: gtsam.Pose2) -> float:
    """Squared residual over the edge's covariance, its ends at joint_T_tail and joint_T_head."""
    residual, _ = edge.residual(tail.between(head))
    return float(squared_mahalanobis(residual, edge.covariance))


def cut_off(vertices: Collection[VertexId], edges: Iterable[GraphEdge]) -> set[VertexId]:
    """Those of ``vertices`` that no path of edges which fix a pose joins to a vertex that is none of them."""
    neighbours: defaultdict[VertexId, list[VertexId]] = defaultdict(list)
    for edge in edges:
        if edge.estimate is not None:
            neighbours[edge.tail].append(edge.head)
            neighbours[edge.head].append(edge.tail)
    lost = set(vertices)
    frontier = [vertex for vertex in neighbours if vertex not in lost]
    while frontier:
        for vertex in neighbours[frontier.pop()]:
            if vertex in lost:
                lost.remove(vertex)
                frontier.append(vertex)
    return lost
