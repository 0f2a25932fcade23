"""The joint graph: the vertices and edges of one connected component, and the poses that fit them best."""

from collections import defaultdict
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from factors import (
    Edge,
    EdgeId,
    UncertainPose,
    VertexId,
    check_pose,
    factor_of,
    has_kernel,
    prior_factor,
    without_kernel,
)
from mrtm.joint.smoother import Smoother

FloatArray = npt.NDArray[np.float64]

# chi2 of 3 degrees of freedom, 99.9 %: an edge that the present uncertainty explains this well pulls at once.
_INNOVATION_GATE = 30.0


class GraphError(ValueError):
    """A change or a question that the joint graph cannot accept; it is as it was before."""


class JointGraph:
    """One connected component, solved: after every ``update`` the estimate is the optimum.

    The root's pose is fixed by a prior (M1); the frame in which it has that pose is the joint frame. Every other
    vertex is connected to the root by edges, always.

    Args:
        root: the first vertex.
        pose: joint_T_root, the identity unless given.

    Raises:
        FactorError: if the pose is not finite.
    """

    def __init__(self, root: VertexId, pose: gtsam.Pose2 | None = None) -> None:
        self._root = root
        self._root_pose = check_pose(pose or gtsam.Pose2(), f"root {root}")
        self._keys: dict[VertexId, int] = {root: 0}
        self._next_key = 1
        self._edges: dict[EdgeId, Edge] = {}
        values = gtsam.Values()
        values.insert(0, self._root_pose)
        self._smoother = Smoother(prior_factor(0, self._root_pose), {}, values)

    @property
    def root(self) -> VertexId:
        """The vertex that fixes the joint frame."""
        return self._root

    def vertices(self) -> list[VertexId]:
        """All vertices in the order they came, the root first."""
        return list(self._keys)

    def edges(self) -> list[Edge]:
        """The present version of every edge, in the order they first came."""
        return list(self._edges.values())

    def update(
        self,
        *,
        add: Iterable[Edge] = (),
        replace: Iterable[Edge] = (),
        remove: Iterable[EdgeId] = (),
        remove_vertices: Iterable[VertexId] = (),
    ) -> None:
        """Change the graph and bring the estimate to the new optimum: all of it or, on an error, nothing.

        Removals come first. An added edge with one unknown end makes that vertex, placed by the edge; a chain of
        them may come in any order.

        A robust edge between vertices that are held without it gets its full weight first if the present
        uncertainty explains it (``innovation``, 99.9 %), and comes under its kernel at that optimum: else the
        kernel, which does not know of the drift, would take most true loops for false ones. Any other comes
        under its kernel at once, and is without effect until the estimate comes near it.

        Args:
            add: edges with new ids.
            replace: higher versions of edges in the graph, between the same vertices.
            remove: edges to take out.
            remove_vertices: vertices to take out, with all their edges.

        Raises:
            GraphError: an id is there that should be new or missing that should be there, a version is not
                higher, a vertex would be cut off from the root, or the equations cannot be solved.
        """
        before = self._keys, self._next_key, self._edges
        factors, values = dict(self._smoother.factors), self._smoother.values()
        try:
            self._apply(list(add), list(replace), set(remove), set(remove_vertices))
        except (GraphError, RuntimeError) as error:
            self._keys, self._next_key, self._edges = before
            if isinstance(error, GraphError):
                raise
            self._smoother = Smoother(prior_factor(0, self._root_pose), factors, values)
            raise GraphError(f"the joint graph cannot be solved with this change: {error}") from error

    def optimize_fully(self) -> None:
        """Bring the estimate to the optimum to the last digit, for the end of a run."""
        self._smoother.refine()

    def estimate(self, vertex: VertexId) -> gtsam.Pose2:
        """joint_T_vertex; GraphError if the vertex is not in the graph."""
        return self._smoother.pose(self._key(vertex))

    def estimates(self) -> dict[VertexId, gtsam.Pose2]:
        """joint_T_vertex of every vertex."""
        values = self._smoother.values()
        return {vertex: values.atPose2(key) for vertex, key in self._keys.items()}

    def marginal(self, vertex: VertexId) -> FloatArray:
        """(3, 3) covariance of joint_T_vertex, in the frame of the vertex."""
        return self._smoother.marginal(self._key(vertex))

    def relative(self, a: VertexId, b: VertexId) -> UncertainPose:
        """a_T_b and its (3, 3) covariance in the frame of b, from the joint covariance of both (M6).

        The first call for an ``a`` after an update costs one elimination of the graph; any ``b`` after it, little.
        """
        start, end = self._key(a), self._key(b)
        pose = self._smoother.pose(start).between(self._smoother.pose(end))
        return UncertainPose(pose, self._smoother.covariance_seen_from(start, end))

    def innovation(self, edge: Edge) -> float:
        """How far an edge that is not in the graph is from what the graph expects: chi2, 3 degrees of freedom.

        Squared Mahalanobis distance under the covariance of the edge and of the joint estimate together; both
        ends must be in the graph.
        """
        expected = self.relative(edge.tail, edge.head)
        offset = edge.measurement.between(expected.pose)
        jacobian = gtsam.Pose2.LogmapDerivative(offset)
        residual = gtsam.Pose2.Logmap(offset)
        covariance = edge.covariance + jacobian @ expected.covariance @ jacobian.T
        return float(residual @ np.linalg.solve(covariance, residual))

    def chi2(self, edge_id: EdgeId) -> float:
        """Squared residual of an edge at the present estimate over its own covariance, without its kernel.

        For an honest edge at most chi2 with 3 degrees of freedom. GraphError if the edge is not in the graph.
        """
        if edge_id not in self._edges:
            raise GraphError(f"edge {edge_id} is not in the joint graph")
        return 2.0 * without_kernel(self._smoother.factors[edge_id]).error(self._smoother.values())

    def checkpoint(self) -> dict[str, Any]:
        """All that ``restore`` needs, as plain numbers and strings fit for JSON."""
        poses = self.estimates()
        return {
            "root": _coordinates(self._root_pose),
            "vertices": [[v.robot, v.index, *_coordinates(poses[v])] for v in self._keys],
            "edges": [edge.to_dict() for edge in self._edges.values()],
        }

    @classmethod
    def restore(cls, data: dict[str, Any]) -> "JointGraph":
        """The graph that ``checkpoint`` wrote, at the same estimate.

        Raises:
            GraphError: if the data do not describe a connected graph.
            FactorError: if an edge in it is not valid.
        """
        try:
            vertices = {VertexId(row[0], row[1]): gtsam.Pose2(*row[2:]) for row in data["vertices"]}
            graph = cls(next(iter(vertices)), gtsam.Pose2(*data["root"]))
            rows = data["edges"]
        except (KeyError, IndexError, TypeError, StopIteration) as error:
            raise GraphError(f"not a checkpoint of a joint graph: {error!r}") from error
        graph._edges = {edge.id: edge for edge in map(Edge.from_dict, rows)}
        graph._keys = {vertex: key for key, vertex in enumerate(vertices)}
        graph._next_key = len(vertices)
        graph._refuse_cut_off()
        values = gtsam.Values()
        for vertex, key in graph._keys.items():
            values.insert(key, check_pose(vertices[vertex], f"vertex {vertex}"))
        factors = {edge.id: graph._factor(edge) for edge in graph._edges.values()}
        graph._smoother = Smoother(prior_factor(0, graph._root_pose), factors, values)
        return graph

    def write_g2o(self, path: Path) -> None:
        """The graph and its estimate for g2o and GTSAM: vertices numbered in the order they came, no kernels.

        Written here, not by ``gtsam.writeG2o``, which keeps six digits and refuses robust factors.
        """
        numbers = {vertex: number for number, vertex in enumerate(self._keys)}
        lines = [("VERTEX_SE2", numbers[v], *_coordinates(pose)) for v, pose in self.estimates().items()]
        upper = np.triu_indices(3)
        for e in self._edges.values():
            information = np.linalg.inv(e.covariance)[upper].tolist()
            lines.append(("EDGE_SE2", numbers[e.tail], numbers[e.head], *_coordinates(e.measurement), *information))
        path.write_text("".join(" ".join(map(str, line)) + "\n" for line in lines), encoding="ascii")

    def _apply(self, added: list[Edge], replaced: list[Edge], removed: set[EdgeId], gone: set[VertexId]) -> None:
        """Stage the change, check it, and solve it in at most three iSAM2 updates, mostly one."""
        for vertex in gone:
            if self._key(vertex) == 0:
                raise GraphError(f"vertex {vertex} is the root and cannot be removed")
        for edge_id in removed - self._edges.keys():
            raise GraphError(f"edge {edge_id} cannot be removed: it is not in the joint graph")
        removed |= {e.id for e in self._edges.values() if e.tail in gone or e.head in gone}
        self._edges = {i: e for i, e in self._edges.items() if i not in removed}
        self._keys = {v: k for v, k in self._keys.items() if v not in gone}
        for edge in replaced:
            self._check_replacement(edge)
            self._edges[edge.id] = edge
        values = self._place(added)
        if removed:
            self._refuse_cut_off()

        first = {edge.id: self._factor(edge) for edge in (*replaced, *added)}
        late: dict[EdgeId, gtsam.BetweenFactorPose2] = {}
        for edge_id, factor in list(first.items()):
            if has_kernel(factor) and not self._cut_off({*late, edge_id}):
                late[edge_id] = first.pop(edge_id)
        out = removed | {edge.id for edge in replaced}
        if first or out:
            self._smoother.update(first, values, out)
        if late:
            eager = {i for i in late if self.innovation(self._edges[i]) <= _INNOVATION_GATE}
            start = {i: without_kernel(f) if i in eager else f for i, f in late.items()}
            self._smoother.update(start, gtsam.Values(), ())
            if eager:
                self._smoother.update({i: late[i] for i in eager}, gtsam.Values(), eager)

    def _check_replacement(self, edge: Edge) -> None:
        old = self._edges.get(edge.id)
        if old is None:
            raise GraphError(f"{edge} cannot replace anything: edge {edge.id} is not in the joint graph")
        if edge.version <= old.version:
            raise GraphError(f"{edge} cannot replace version {old.version}: a version must be higher")
        if (edge.tail, edge.head) != (old.tail, old.head):
            raise GraphError(f"{edge} cannot replace {old}: it joins other vertices")

    def _place(self, added: list[Edge]) -> gtsam.Values:
        """Enter the added edges and the vertices they make; the poses of these."""
        made: dict[VertexId, gtsam.Pose2] = {}
        values = gtsam.Values()
        pending = added
        while pending:
            waiting: list[Edge] = []
            for edge in pending:
                if edge.id in self._edges:
                    version = self._edges[edge.id].version
                    raise GraphError(f"{edge} is already in the joint graph, at version {version}: replace it")
                known = [v for v in (edge.tail, edge.head) if v in self._keys]
                if not known:
                    waiting.append(edge)
                    continue
                if len(known) == 1:
                    anchor = made.get(known[0]) or self.estimate(known[0])
                    forward = known[0] == edge.tail
                    new = edge.head if forward else edge.tail
                    step = edge.measurement if forward else edge.measurement.inverse()
                    made[new] = anchor.compose(step)
                    self._keys[new] = self._next_key
                    values.insert(self._next_key, made[new])
                    self._next_key += 1
                self._edges[edge.id] = edge
            if len(waiting) == len(pending):
                raise GraphError(f"{waiting[0]} cannot be added: neither end is connected to root {self._root}")
            pending = waiting
        return values

    def _refuse_cut_off(self) -> None:
        lost = self._cut_off()
        if lost:
            names = ", ".join(str(v) for v in sorted(lost))
            raise GraphError(f"vertices {names} would be cut off from root {self._root}: remove them as well")

    def _cut_off(self, without: Collection[EdgeId] = ()) -> set[VertexId]:
        """The vertices that no path of edges joins to the root, if those ``without`` do not count."""
        neighbours: defaultdict[VertexId, list[VertexId]] = defaultdict(list)
        for edge in self._edges.values():
            if edge.id not in without:
                neighbours[edge.tail].append(edge.head)
                neighbours[edge.head].append(edge.tail)
        reached, frontier = {self._root}, [self._root]
        while frontier:
            for vertex in neighbours[frontier.pop()]:
                if vertex not in reached:
                    reached.add(vertex)
                    frontier.append(vertex)
        return self._keys.keys() - reached

    def _key(self, vertex: VertexId) -> int:
        if vertex not in self._keys:
            raise GraphError(f"vertex {vertex} is not in the joint graph")
        return self._keys[vertex]

    def _factor(self, edge: Edge) -> gtsam.BetweenFactorPose2:
        return factor_of(edge, self._key(edge.tail), self._key(edge.head))


def _coordinates(pose: gtsam.Pose2) -> list[float]:
    return [pose.x(), pose.y(), pose.theta()]
