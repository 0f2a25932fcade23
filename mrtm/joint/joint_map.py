"""What somebody makes of all the edges they have heard of: a joint graph for every connected component."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from factors import Edge, EdgeId, GraphEdge, VertexId
from mrtm.joint.graph import JointGraph


@dataclass(slots=True)
class Component:
    """Robots in one frame.

    Attributes:
        robots: ascending.
        graph: all their edges, and those added; without added ones the robot's own graph.
        added: what came to them: edges between robots, and alignments of maps, by their ids.
    """

    robots: tuple[str, ...]
    graph: JointGraph
    added: dict[EdgeId, GraphEdge] = field(default_factory=dict)


class JointMap:
    """The joint maps of a team, as far as known.

    Every robot's own edges are first solved by themselves, each robot in its own frame ("kept aside"). Fusing edges
    join them into components. A component's frame is that of ``owner``, where it is one of its robots, else that of
    the first of its robots' names.

    Args:
        owner: the robot whose map this is; None for somebody who only listens.
    """

    def __init__(self, owner: str | None = None) -> None:
        self._owner = owner
        self._own: dict[str, JointGraph] = {}
        self._unconnected: dict[EdgeId, Edge] = {}
        self._component: dict[str, Component] = {}

    @property
    def robots(self) -> Mapping[str, JointGraph]:
        """Every robot heard of, and the graph of its own edges."""
        return self._own

    def components(self) -> list[Component]:
        """All of them, in the order of their first robots' names."""
        return list({c.robots: c for _, c in sorted(self._component.items())}.values())

    def component(self, robot: str) -> Component:
        """The one a robot is in."""
        return self._component[robot]

    def learn(self, edges: Iterable[Edge], robots: Iterable[str] = ()) -> None:
        """Take new edges, and new versions of known ones, that robots made within their own maps (M5, M7, M8).

        Any order will do: an edge that nothing connects yet waits for those that do.

        Args:
            robots: names of robots heard of; one with a single vertex has no edge.
        """
        for robot in robots:
            if robot not in self._own:
                self._own[robot] = JointGraph(VertexId(robot, 0))
                self._component[robot] = Component((robot,), self._own[robot])
        waiting = self._unconnected | {edge.id: edge for edge in sorted(edges, key=lambda e: (e.id, e.version))}
        for robot in sorted({edge_id.robot for edge_id in waiting}):
            self.learn((), [robot])
            waiting = self._enter(robot, waiting)
        self._unconnected = waiting

    def _enter(self, robot: str, waiting: dict[EdgeId, Edge]) -> dict[EdgeId, Edge]:
        """Enter those edges of a robot that are connected to its root; the others."""
        own, component = self._own[robot], self._component[robot]
        known = set(own.vertices())
        present = {edge.id: edge.version for edge in own.edges()}
        mine = [edge for edge_id, edge in waiting.items() if edge_id.robot == robot]
        add: list[Edge] = []
        found = True
        while found:
            found = False
            for edge in mine:
                if edge.id not in present and (edge.tail in known or edge.head in known):
                    known |= {edge.tail, edge.head}
                    present[edge.id] = edge.version
                    add.append(edge)
                    found = True
        replace = [e for e in mine if e.version > present.get(e.id, e.version)]
        for graph in (own,) if component.graph is own else (own, component.graph):
            graph.update(add=add, replace=replace)
        return {edge_id: edge for edge_id, edge in waiting.items() if edge_id not in present}

    def join(self, added: Iterable[GraphEdge]) -> None:
        """Let ``added`` be all the edges beside the robots' own (M11, M13): robots come into one frame, or fall apart.

        Edges that fix a pose join; a range and bearing between robots that nothing else joins is left out.
        """
        edges = {edge.id: edge for edge in sorted(added, key=lambda e: e.id)}
        for robots in self.connected(edges.values()):
            mine = {i: e for i, e in edges.items() if _ends(e) <= set(robots)}
            component = self._component[robots[0]]
            if component.robots == robots and bool(component.added) == bool(mine):
                _exchange(component, mine)
            else:
                component = Component(robots, self._graph_of(robots, mine), mine)
                self._component.update(dict.fromkeys(robots, component))

    def connected(self, edges: Iterable[GraphEdge]) -> list[tuple[str, ...]]:
        """The robots that edges would bring together, names ascending."""
        group = {robot: {robot} for robot in self._own}
        for edge in edges:
            a, b = group[edge.tail.robot], group[edge.head.robot]
            if edge.estimate is not None and a is not b:
                a |= b
                group.update(dict.fromkeys(b, a))
        return sorted({tuple(sorted(members)) for members in group.values()})

    def _graph_of(self, robots: tuple[str, ...], added: dict[EdgeId, GraphEdge]) -> JointGraph:
        """The robots' own graphs made one: the root's first, the others in the order in which they are reached."""
        if not added:
            return self._own[robots[0]]
        root = self._owner if self._owner in robots and self._owner is not None else robots[0]
        graph = JointGraph(VertexId(root, 0))
        graph.update(add=self._own[root].edges())
        reached = {root}
        graph.update(add=[e for e in added.values() if _ends(e) == reached])
        while len(reached) < len(robots):
            bridge = next(e for e in added.values() if e.estimate and _ends(e) & reached and _ends(e) - reached)
            both = reached | _ends(bridge)
            more = [e for e in added.values() if e is not bridge and _ends(e) <= both and not _ends(e) <= reached]
            graph.merge(self._own[(both - reached).pop()], bridge, more)
            reached = both
        return graph


def _exchange(component: Component, added: dict[EdgeId, GraphEdge]) -> None:
    """Bring a component whose robots stay the same to other added edges."""
    before = component.added
    add = [e for i, e in added.items() if i not in before]
    replace = [e for i, e in added.items() if i in before and e.version > before[i].version]
    gone = [i for i in before if i not in added]
    if add:
        component.graph.update(add=add)  # first, so that no robot is cut off in between
    if replace or gone:
        component.graph.update(replace=replace, remove=gone)
    component.added = added


def _ends(edge: GraphEdge) -> set[str]:
    return {edge.tail.robot, edge.head.robot}
