"""The joint graph: the vertices and edges of one connected component, and the poses that fit them best."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from factors import (
    FULL_WEIGHT,
    EdgeId,
    GraphEdge,
    UncertainPose,
    VertexId,
    check_pose,
    edge_from_dict,
    factor_of,
    prior_factor,
)
from mrtm.joint.doubts import Doubts
from mrtm.joint.equations import CERTAIN, Equations, cut_off, misfit
from mrtm.joint.smoother import Smoother

FloatArray = npt.NDArray[np.float64]


UNSOLVABLE = RuntimeError, IndexError, np.linalg.LinAlgError
"""What GTSAM and NumPy raise where numbers are beyond what double precision can solve."""


class GraphError(ValueError):
    """A change or a question that the joint graph cannot accept; it is as it was before."""


class JointGraph:
    """One connected component, solved: after every ``update`` the estimate is the optimum.

    To 2e-5 m and rad, that is. Of more than a thousand vertices those that have turned by less than 2 mrad are not
    linearised anew, and of those that have turned further each update takes a portion, so that none makes others wait.
    The estimate stays 1 to 2 cm from the optimum; where a loop turns thousands of vertices it may be more,
    for a few dozen updates (M3500: 6 cm after the worst loop). ``optimize_fully`` gets the last digit.

    The root's pose is fixed by a prior (M1); the frame in which it has that pose is the joint frame. Every other
    vertex is connected to the root by edges that fix a pose, always: a range and bearing adds to what is known of
    its ends, and holds nothing.

    An edge that may be false is believed or doubted (``mrtm.joint.doubts``); a doubted one has no effect on the
    estimate. One that alone holds a vertex is believed.

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
        self._edges: dict[EdgeId, GraphEdge] = {}
        self._doubted: dict[EdgeId, float] = {}  # and chi2 when last judged
        self._doubts = Doubts()
        values = gtsam.Values()
        values.insert(0, self._root_pose)
        self._smoother = Smoother(prior_factor(0, self._root_pose), {}, values)
        self._before: gtsam.Values | None = None  # the estimate before a change of several steps

    @property
    def root(self) -> VertexId:
        """The vertex that fixes the joint frame."""
        return self._root

    def vertices(self) -> list[VertexId]:
        """All vertices in the order they came, the root first."""
        return list(self._keys)

    def edges(self) -> list[GraphEdge]:
        """The present version of every edge, believed or doubted, in the order they first came."""
        return list(self._edges.values())

    def doubted(self) -> frozenset[EdgeId]:
        """The edges that are without effect on the estimate."""
        return frozenset(self._doubted)

    def update(
        self,
        *,
        add: Iterable[GraphEdge] = (),
        replace: Iterable[GraphEdge] = (),
        remove: Iterable[EdgeId] = (),
        remove_vertices: Iterable[VertexId] = (),
    ) -> None:
        """Change the graph and bring the estimate to the new optimum: all of it or, on an error, nothing.

        Removals come first. An added edge with one unknown end makes that vertex, placed by the edge; a chain of
        them may come in any order.

        Of the edges that may be false those that are told true pull at once, the others are doubted until they are; a
        change may let in edges that were doubted, and put out believed ones (``mrtm.joint.doubts``).

        Args:
            add: edges with new ids.
            replace: higher versions of edges in the graph, between the same vertices.
            remove: edges to take out.
            remove_vertices: vertices to take out, with all their edges.

        Raises:
            GraphError: an id is there that should be new or missing that should be there, a version is not
                higher, a vertex would be cut off from the root, or the equations cannot be solved.
        """
        with self._all_or_nothing():
            self._apply(list(add), list(replace), set(remove), set(remove_vertices))

    def merge(
        self, other: "JointGraph", bridge: GraphEdge, edges: Iterable[GraphEdge] = (), *, more: bool = False
    ) -> None:
        """Take in another component, which stays as it is: all of it or, on an error, nothing.

        The vertices of ``other`` keep their estimates relative to each other; ``bridge`` places them. Its edges come
        as they are, believed or doubted: they were judged where they come from.

        Args:
            other: a component without a vertex or an edge id of this one; its prior is left behind.
            bridge: an edge that fixes a pose, from one component to the other, either way.
            edges: other new ones, between any of the vertices, judged as in ``update`` when the bridge is in.
            more: the estimate need not be at the optimum yet: more changes follow, an ``update`` in the end.

        Raises:
            GraphError: the components share a vertex or an edge id, ``bridge`` does not join them, one of ``edges``
                cannot be added, or the equations cannot be solved.
        """
        with self._all_or_nothing():
            self._absorb(other, bridge, list(edges), more)

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
        """a_T_b and its (3, 3) covariance in the frame of b, from the joint covariance of both."""
        return self.relatives([(a, b)])[0]

    def relatives(self, pairs: Sequence[tuple[VertexId, VertexId]]) -> list[UncertainPose]:
        """``relative`` of many pairs (M6): about one elimination of the graph for all of them."""
        for pair in pairs:
            for end in pair:
                self._key(end)
        return self._equations().relatives(pairs)

    def innovation(self, edge: GraphEdge) -> float:
        """How far an edge that is not in the graph is from what the graph expects: chi2, a degree of freedom a number.

        Squared Mahalanobis distance under the covariance of the edge and of the joint estimate together; both
        ends must be in the graph.
        """
        for end in (edge.tail, edge.head):
            self._key(end)
        return self._equations().expectation([edge]).innovation(0)[0]

    def chi2(self, edge_id: EdgeId) -> float:
        """Squared residual of an edge at the present estimate over its own covariance, without its kernel.

        For an honest edge at most chi2 with a degree of freedom a measured number. GraphError if the edge is not in
        the graph.
        """
        if edge_id not in self._edges:
            raise GraphError(f"edge {edge_id} is not in the joint graph")
        return self._equations().misfit(self._edges[edge_id])

    def checkpoint(self) -> dict[str, Any]:
        """All that ``restore`` needs, as plain numbers and strings fit for JSON."""
        poses = self.estimates()
        return {
            "root": _coordinates(self._root_pose),
            "vertices": [[v.robot, v.number, *_coordinates(poses[v])] for v in self._keys],
            "edges": [edge.to_dict() for edge in self._edges.values()],
            "doubted": [[i.robot, i.number, chi2] for i, chi2 in self._doubted.items()],
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
            rows, doubted = data["edges"], {EdgeId(*row[:2]): float(row[2]) for row in data["doubted"]}
        except (KeyError, IndexError, TypeError, ValueError, StopIteration) as error:
            raise GraphError(f"not a checkpoint of a joint graph: {error!r}") from error
        graph._edges = {edge.id: edge for edge in map(edge_from_dict, rows)}
        graph._keys = {vertex: key for key, vertex in enumerate(vertices)}
        graph._next_key = len(vertices)
        graph._doubted = {i: chi2 for i, chi2 in doubted.items() if i in graph._edges}
        graph._refuse_cut_off()
        values = gtsam.Values()
        for vertex, key in graph._keys.items():
            values.insert(key, check_pose(vertices[vertex], f"vertex {vertex}"))
        factors = {edge.id: graph._factor(edge) for edge in graph._believed()}
        graph._smoother = Smoother(prior_factor(0, graph._root_pose), factors, values)
        return graph

    @contextmanager
    def _all_or_nothing(self) -> Iterator[None]:
        """A change within: if it fails the graph is as it was before.

        What is added comes to the end of the tables, and is taken off again there: a change that only adds costs
        nothing for the rest of the graph. One that takes away works on copies of them.
        """
        keys, next_key, edges, doubted = self._keys, self._next_key, self._edges, dict(self._doubted)
        vertices_before, edges_before = len(keys), len(edges)
        self._before = None
        try:
            yield
        except Exception as error:
            self._keys, self._next_key, self._edges, self._doubted = keys, next_key, edges, doubted
            while len(keys) > vertices_before:
                keys.popitem()
            while len(edges) > edges_before:
                edges.popitem()
            if isinstance(error, GraphError):  # found before the solver was touched
                raise
            self._begin_anew()
            if not isinstance(error, UNSOLVABLE):
                raise
            raise GraphError(f"the joint graph cannot be solved with this change: {error}") from error

    def _begin_anew(self) -> None:
        """A solver in place of one that has failed."""
        start, values = self._before or self._smoother.start(), gtsam.Values()
        for key in self._keys.values():
            values.insert(key, start.atPose2(key))
        factors = {edge.id: self._factor(edge) for edge in self._believed()}
        self._smoother = Smoother(prior_factor(0, self._root_pose), factors, values)

    def _apply(
        self, added: list[GraphEdge], replaced: list[GraphEdge], removed: set[EdgeId], gone: set[VertexId]
    ) -> None:
        """Stage the change, check it, and solve it."""
        for vertex in gone:
            if self._key(vertex) == 0:
                raise GraphError(f"vertex {vertex} is the root and cannot be removed")
        for edge_id in removed:  # a difference of sets would look at every edge of the graph
            if edge_id not in self._edges:
                raise GraphError(f"edge {edge_id} cannot be removed: it is not in the joint graph")
        if gone:
            removed |= {e.id for e in self._edges.values() if e.tail in gone or e.head in gone}
            self._keys = {v: k for v, k in self._keys.items() if v not in gone}
        if removed or replaced:
            self._edges = {i: e for i, e in self._edges.items() if i not in removed}
        for edge in replaced:
            self._check_replacement(edge)
            self._edges[edge.id] = edge
        made: dict[VertexId, gtsam.Pose2] = {}
        self._place(added, made)
        out = removed | {edge.id for edge in replaced}
        self._doubts.forget(out)
        believed = {i for i in out if i not in self._doubted}
        self._doubted = {i: chi2 for i, chi2 in self._doubted.items() if i not in out}
        judged = [*replaced, *added]
        if out:
            self._refuse_cut_off()
            judged += self._needed()
        self._solve({}, judged, made, believed)

    def _absorb(self, other: "JointGraph", bridge: GraphEdge, edges: list[GraphEdge], more: bool) -> None:
        """Stage the union of two components, check it, and solve it."""
        for name in sorted(map(str, (*(other._keys.keys() & self._keys), *(other._edges.keys() & self._edges)))):
            raise GraphError(f"{name} is in both components: they cannot be merged")
        if bridge.estimate is None or not _joins(bridge, self._keys, other._keys):
            raise GraphError(f"{bridge} cannot join the component of {other.root} to that of {self.root}")
        made: dict[VertexId, gtsam.Pose2] = {}
        self._place([bridge], made)
        placed, pose = next(iter(made.items()))
        joint_T_other = pose.compose(other.estimate(placed).inverse())
        for vertex, pose in other.estimates().items():
            if vertex != placed:
                made[self._enter(vertex)] = joint_T_other.compose(pose)
        self._edges |= other._edges
        self._doubted |= other._doubted
        self._place(edges, made)
        settled = {edge.id: self._factor(edge) for edge in (bridge, *other._believed())}
        self._solve(settled, edges, made, set(), more)

    def _solve(
        self,
        settled: dict[EdgeId, gtsam.NoiseModelFactor],
        judged: list[GraphEdge],
        made: dict[VertexId, gtsam.Pose2],
        out: set[EdgeId],
        more: bool = False,
    ) -> None:
        """Bring a staged change to the optimum, or near it if more follow.

        Args:
            settled: factors that come as they are.
            judged: edges that come; those that may be false are believed at once if nothing is strained by them or if
                they hold a vertex, the others when they are told true.
            made: joint_T_vertex of the vertices that are new.
            out: the edges whose factors go.
        """
        first = {edge.id: self._factor(edge) for edge in judged}
        late = self._strained(settled, judged, made, bool(out))
        for edge_id in late:
            del first[edge_id]
        values = gtsam.Values()
        for vertex, pose in made.items():
            values.insert(self._keys[vertex], pose)
        if late or out:  # the solver may leave the estimate before it fails
            self._before = self._smoother.values()
        if settled or first or out:
            self._smoother.update(settled | first, values, out)
        self._doubted |= late
        if out or any(edge.kind not in CERTAIN for edge in judged):
            self._doubts.settle(self._equations(), late)
        if not more:
            self._smoother.come_to_rest()

    def _strained(
        self, settled: Iterable[EdgeId], judged: list[GraphEdge], made: dict[VertexId, gtsam.Pose2], taken: bool
    ) -> dict[EdgeId, float]:
        """Those of the edges that come which the estimate does not agree with, and which may wait: they hold nothing.

        Args:
            taken: edges go as well.
        """
        late: dict[EdgeId, float] = {}
        for edge in judged:
            if edge.kind not in CERTAIN:
                tail, head = (made.get(v) or self.estimate(v) for v in (edge.tail, edge.head))
                if misfit(edge, tail, head) > FULL_WEIGHT[len(edge.covariance)]:
                    late[edge.id] = np.inf
        # New edges alone can hold no other vertices than new ones.
        held = self._vertices_but_root() if taken else made.keys()
        holding = list(self._believed()) if taken else [self._edges[i] for i in {*settled, *(e.id for e in judged)}]
        while late:  # of several that hold a vertex the first stays, which placed it
            lost = cut_off(held, [e for e in holding if e.id not in late])
            needed = [e for e in map(self._edges.__getitem__, late) if (e.tail in lost) != (e.head in lost)]
            needed = [e for e in needed if e.estimate is not None]
            if not needed:
                break
            del late[needed[0].id]
        return late

    def _needed(self) -> list[GraphEdge]:
        """Doubted edges, which are so no longer, without which vertices would be cut off."""
        needed: list[GraphEdge] = []
        while lost := cut_off(self._vertices_but_root(), self._believed()):
            doubted = (self._edges[i] for i in self._doubted)
            edge = next(e for e in doubted if e.estimate is not None and (e.tail in lost) != (e.head in lost))
            del self._doubted[edge.id]
            needed.append(edge)
        return needed

    def _believed(self) -> Iterator[GraphEdge]:
        return (edge for i, edge in self._edges.items() if i not in self._doubted)

    def _equations(self) -> Equations:
        return Equations(self._smoother, self._keys, self._edges, self._doubted)

    def _check_replacement(self, edge: GraphEdge) -> None:
        old = self._edges.get(edge.id)
        if old is None:
            raise GraphError(f"{edge} cannot replace anything: edge {edge.id} is not in the joint graph")
        if edge.version <= old.version:
            raise GraphError(f"{edge} cannot replace version {old.version}: a version must be higher")
        if (edge.tail, edge.head) != (old.tail, old.head):
            raise GraphError(f"{edge} cannot replace {old}: it joins other vertices")

    def _place(self, added: list[GraphEdge], made: dict[VertexId, gtsam.Pose2]) -> None:
        """Enter the added edges and the vertices they make, whose poses go to ``made``."""
        pending = added
        while pending:
            waiting: list[GraphEdge] = []
            for edge in pending:
                if edge.id in self._edges:
                    version = self._edges[edge.id].version
                    raise GraphError(f"{edge} is already in the joint graph, at version {version}: replace it")
                known = [v for v in (edge.tail, edge.head) if v in self._keys]
                if len(known) == 1 and edge.estimate is not None:
                    forward = known[0] == edge.tail
                    step = edge.estimate.pose if forward else edge.estimate.pose.inverse()
                    anchor = made.get(known[0]) or self.estimate(known[0])
                    made[self._enter(edge.head if forward else edge.tail)] = anchor.compose(step)
                elif len(known) < 2:
                    waiting.append(edge)
                    continue
                self._edges[edge.id] = edge
            if len(waiting) == len(pending):
                why = "neither end is" if waiting[0].estimate is not None else "its ends are not both"
                raise GraphError(f"{waiting[0]} cannot be added: {why} connected to root {self._root}")
            pending = waiting

    def _enter(self, vertex: VertexId) -> VertexId:
        self._keys[vertex] = self._next_key
        self._next_key += 1
        return vertex

    def _refuse_cut_off(self) -> None:
        lost = cut_off(self._vertices_but_root(), self._edges.values())
        if lost:
            names = ", ".join(str(v) for v in sorted(lost))
            raise GraphError(f"vertices {names} would be cut off from root {self._root}: remove them as well")

    def _vertices_but_root(self) -> Collection[VertexId]:
        return self._keys.keys() - {self._root}

    def _key(self, vertex: VertexId) -> int:
        if vertex not in self._keys:
            raise GraphError(f"vertex {vertex} is not in the joint graph")
        return self._keys[vertex]

    def _factor(self, edge: GraphEdge) -> gtsam.NoiseModelFactor:
        return factor_of(edge, self._key(edge.tail), self._key(edge.head))


def _joins(edge: GraphEdge, some: Collection[VertexId], others: Collection[VertexId]) -> bool:
    """Whether one end is among ``some`` and the other among ``others``."""
    return (edge.tail in some and edge.head in others) or (edge.head in some and edge.tail in others)


def _coordinates(pose: gtsam.Pose2) -> list[float]:
    return [pose.x(), pose.y(), pose.theta()]
