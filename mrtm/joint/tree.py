"""M13's start: Dijkstra's tree over the edges, and the poses along its paths (the paper's Fig. 4a)."""

import heapq
from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import GraphEdge, VertexId, inverse


@dataclass(frozen=True, slots=True)
class Branch:
    """How the tree reaches a vertex: its ``parent`` (None: root), ``step`` parent_T_vertex, ``pose`` root_T_vertex."""

    parent: VertexId | None
    step: gtsam.Pose2
    pose: gtsam.Pose2


def shortest_paths(edges: Iterable[GraphEdge], root: VertexId) -> dict[VertexId, Branch]:
    """Dijkstra's tree from ``root`` (M13): every vertex the edges reach, nearest first.

    The paper does not say what is short; as in M6a it is the distance driven, the sum of the edges' lengths. Of equally
    long ways the one through the lesser vertices counts. An edge that alone does not fix its far end (a sighting
    without a heading) leads nowhere.
    """
    around: dict[VertexId, list[tuple[VertexId, gtsam.Pose2]]] = {}
    for edge in edges:
        if edge.estimate is not None:
            around.setdefault(edge.tail, []).append((edge.head, edge.estimate.pose))
            around.setdefault(edge.head, []).append((edge.tail, inverse(edge.estimate).pose))
    tree: dict[VertexId, Branch] = {}
    # The running number keeps the heap from comparing poses.
    queue: list[tuple[float, VertexId, int, Branch]] = [(0.0, root, 0, Branch(None, gtsam.Pose2(), gtsam.Pose2()))]
    pushed = 0
    while queue:
        length, vertex, _, branch = heapq.heappop(queue)
        if vertex in tree:
            continue
        tree[vertex] = branch
        for neighbour, step in around.get(vertex, ()):
            if neighbour not in tree:
                pushed += 1
                longer = length + float(np.hypot(step.x(), step.y()))
                heapq.heappush(queue, (longer, neighbour, pushed, Branch(vertex, step, branch.pose.compose(step))))
    return tree


def tree_poses(edges: Iterable[GraphEdge], root: VertexId) -> dict[VertexId, gtsam.Pose2]:
    """root_T_vertex of every vertex the edges reach, accumulated along the shortest paths; nothing is optimised."""
    return {vertex: branch.pose for vertex, branch in shortest_paths(edges, root).items()}
