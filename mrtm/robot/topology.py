"""The topological map of one robot: vertices with their local maps, and the edges between them."""

import heapq
from dataclasses import dataclass, field

import gtsam
import numpy as np

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId, compose, inverse
from frontend import se2
from frontend.grid import Maps
from frontend.local_map import NEAR, Bends
from frontend.records import FloatArray
from mrtm.result import EdgeFate
from mrtm.robot.poses import pose_of


@dataclass(slots=True)
class Vertex:
    """A place and its local map.

    Attributes:
        id: name.
        maps: what is known of the place (a stack of one), as the last visit left it; None during the first visit.
        spread: (3, 3) covariance of the particles when the robot last left.
        bends: how sure the parts of the map are, from the poses it was made from.
        scans: indices of the robot's scans taken here, in the order they came.
        poses: local_T_robot (3,) at each of them.
    """

    id: VertexId
    maps: Maps | None = None
    spread: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    bends: Bends = field(default_factory=Bends)
    scans: list[int] = field(default_factory=list)
    poses: list[FloatArray] = field(default_factory=list)

    def drawn_from(self, poses: FloatArray, covariances: FloatArray) -> None:
        """Take note of poses (k, 3) with covariances (k, 3, 3) that the map was made from, where there was none yet."""
        off = poses[:, None, :2] - self.bends.places
        new = (np.hypot(off[..., 0], off[..., 1]) > NEAR).all(axis=1)
        self.bends = self.bends.extended(poses[new], covariances[new])

    def covariances(self, poses: FloatArray, covariances: FloatArray) -> FloatArray:
        """(n, 3, 3) of (n, 3) ``poses`` known to ``covariances`` in the map, with the map's own error there added.

        All in the poses' own tangent frames.
        """
        if not len(self.bends.places):
            return covariances
        back = se2.adjoint(se2.inverse(poses))
        errors = self.bends.errors(self.bends.shares(poses[:, :2]))
        return np.asarray(covariances + back @ errors @ np.swapaxes(back, -1, -2))

    def uncertain(self, pose: FloatArray, covariance: FloatArray) -> UncertainPose:
        """One pose (3,), as ``covariances``."""
        return UncertainPose(pose_of(pose), self.covariances(pose[None], covariance[None])[0])


class Topology:
    """Vertices, the present version of every edge, and what became of every edge there ever was."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self.vertices: list[Vertex] = []
        self.edges: dict[EdgeId, Edge] = {}
        self.past: list[EdgeFate] = []
        self._numbers = 0

    def new_vertex(self) -> Vertex:
        """A vertex without edges (M7a)."""
        vertex = Vertex(VertexId(self._robot, len(self.vertices)))
        self.vertices.append(vertex)
        return vertex

    def new_edge(self, kind: EdgeKind, tail: VertexId, head: VertexId, estimate: UncertainPose) -> Edge:
        """An edge with a new id, not yet part of the map."""
        edge = Edge(EdgeId(self._robot, self._numbers), 0, kind, tail, head, estimate.pose, estimate.covariance)
        self._numbers += 1
        return edge

    def put(self, edge: Edge) -> None:
        """Enter an edge; an older version of it becomes history."""
        old = self.edges.get(edge.id)
        if old is not None:
            self.past.append(EdgeFate(old, "replaced", f"by version {edge.version}"))
        self.edges[edge.id] = edge

    def between(self, a: VertexId, b: VertexId) -> Edge | None:
        """The edge that joins two vertices, in either direction."""
        return next((e for e in self.edges.values() if {e.tail, e.head} == {a, b}), None)

    def along_shortest_paths(self, start: VertexId) -> dict[VertexId, UncertainPose]:
        """start_T_vertex of every vertex along Dijkstra's shortest path, covariances accumulated along it (M6a).

        The paper does not say what is short; here it is the distance driven, the sum of the edges' lengths.
        """
        around: dict[VertexId, list[tuple[VertexId, UncertainPose]]] = {}
        for e in self.edges.values():
            around.setdefault(e.tail, []).append((e.head, e.estimate))
            around.setdefault(e.head, []).append((e.tail, inverse(e.estimate)))
        found: dict[VertexId, UncertainPose] = {}
        queue: list[tuple[float, VertexId, UncertainPose]] = [
            (0.0, start, UncertainPose(gtsam.Pose2(), np.zeros((3, 3))))
        ]
        while queue:
            length, vertex, estimate = heapq.heappop(queue)
            if vertex in found:
                continue
            found[vertex] = estimate
            for neighbour, step in around.get(vertex, ()):
                if neighbour not in found:
                    distance = length + float(np.hypot(step.pose.x(), step.pose.y()))
                    heapq.heappush(queue, (distance, neighbour, compose(estimate, step)))
        return found
