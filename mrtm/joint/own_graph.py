"""A robot's own edges solved by themselves, once for everybody in the process who knows the same ones."""

from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import NamedTuple

from factors import Edge, EdgeId, VertexId
from mrtm.joint.graph import GraphError, JointGraph

KEPT = 256  # graphs


class OwnGraph(NamedTuple):
    """What a robot's own edges come to.

    Attributes:
        graph: of those that are connected to the robot's root; others hold it as well, so it must not be changed.
        refused: edges that cannot be, and why.
    """

    graph: JointGraph
    refused: dict[EdgeId, str]


@lru_cache(KEPT)
def own_graph(robot: str, edges: tuple[Edge, ...]) -> OwnGraph:
    """Solve a robot's own edges, in the order of their ids, from scratch: a function of these and nothing else."""
    root = VertexId(robot, 0)
    refused = {e.id: refusal(e, "a robot's own edges join its own vertices") for e in edges if not _is_own(e, robot)}
    reached = list(_reached([root], [e for e in edges if e.id not in refused]))
    graph = JointGraph(root)
    try:
        graph.update(add=reached)
    except GraphError:  # one by one: which is it?
        left = reached
        while left:
            edge = left.pop(0)
            try:
                graph.update(add=[edge])
            except GraphError as error:
                refused[edge.id] = refusal(edge, error)
                left = list(_reached(graph.vertices(), left))  # perhaps by another way
    graph.optimize_fully()
    return OwnGraph(graph, refused)


def refusal(edge: object, why: object) -> str:
    """The line that names an edge that cannot be."""
    return f"{edge}: refused: {why}"


def _is_own(edge: Edge, robot: str) -> bool:
    return edge.tail.robot == edge.head.robot == robot


def _reached(vertices: Iterable[VertexId], edges: Iterable[Edge]) -> Iterator[Edge]:
    """The edges that are connected to some vertices, each after one that connects it."""
    known, left = {*vertices}, list(edges)
    while left:
        waiting = []
        for edge in left:
            if edge.tail in known or edge.head in known:
                known |= {edge.tail, edge.head}
                yield edge
            else:
                waiting.append(edge)
        if len(waiting) == len(left):
            return
        left = waiting
