"""The topological map of one robot: vertices with their local maps, and the edges between them."""

import heapq
from dataclasses import dataclass, field

import gtsam
import numpy as np

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId, compose, inverse
from frontend import se2
from frontend.grid import Maps
from frontend.records import FloatArray
from mrtm.result import EdgeFate
from mrtm.robot.poses import pose_of

NEAR = 3.0  # metres: poses of a map nearer than this all tell about the same of its error


@dataclass(slots=True)
class Vertex:
    """A place and its local map.

    Attributes:
        id: name.
        maps: what is known of the place (a stack of one), as the last visit left it; None during the first visit.
        spread: (3, 3) covariance of the particles when the robot last left.
        places: poses (k, 3) from which the map was made, and
        covariances: (k, 3, 3) how well each is known in the frame of the vertex, each in its own tangent frame.
        scans: indices of the robot's scans taken here, in the order they came.
        poses: local_T_robot (3,) at each of them.
    """

    id: VertexId
    maps: Maps | None = None
    spread: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    places: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    covariances: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))
    scans: list[int] = field(default_factory=list)
    poses: list[FloatArray] = field(default_factory=list)

    def drawn_from(self, poses: FloatArray, covariances: FloatArray) -> None:
        """Take note of poses (k, 3) with covariances (k, 3, 3) that the map was made from, where there was none yet."""
        off = poses[:, None, :2] - self.places[None, :, :2]
        new = (np.hypot(off[..., 0], off[..., 1]) > NEAR).all(axis=1)
        self.places = np.concatenate([self.places, poses[new]])
        self.covariances = np.concatenate([self.covariances, covariances[new]])

    def uncertain(self, pose: FloatArray, covariance: FloatArray) -> UncertainPose:
        """A pose (3,) known to ``covariance`` (3, 3) in the map, with the map's own error as seen from it added.

        What is seen was drawn from all the poses the map was made from: their errors, carried here, are averaged, the
        nearer ones counting more, and taken to go together. Averaging the covariances would say more than the largest
        that this average can have.
        """
        if not len(self.places):
            return UncertainPose(pose_of(pose), covariance)
        here_T_place = se2.between(pose, self.places)
        adjoint = se2.adjoint(here_T_place)
        weights = 1.0 / (NEAR**2 + (here_T_place[:, :2] ** 2).sum(axis=1)) ** 2
        carried = adjoint @ self.covariances @ np.transpose(adjoint, (0, 2, 1))
        variances, axes = np.linalg.eigh(carried)
        roots = (axes * np.sqrt(np.maximum(variances, 0.0))[:, None, :]) @ np.transpose(axes, (0, 2, 1))
        root = np.average(roots, axis=0, weights=weights)
        return UncertainPose(pose_of(pose), covariance + root @ root)


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
