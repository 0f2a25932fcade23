"""What somebody makes of all the edges they have heard of: a joint graph for every connected component."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import gtsam

from factors import Edge, EdgeId, GraphEdge, VertexId
from mrtm.joint.doubts import GROWN
from mrtm.joint.equations import FUSED
from mrtm.joint.graph import GraphError, JointGraph
from mrtm.joint.own_graph import own_graph, refusal

MISPLACED = 4  # edges that sightings made between two robots, half of them doubted, for a component to be made anew

SLIPPED = 0.05
"""Of the pairs of robots: so few of them are misplaced because a robot's own map is wrong, and will be so anew."""


@dataclass(slots=True)
class Component:
    """Robots in one frame.

    Attributes:
        robots: ascending.
        graph: all their edges, and those added; without added ones the robot's own graph.
        added: what came to them: edges between robots, and alignments of maps, by their ids.
        own: each robot's own graph, whose edges these are.
        misplaced: pairs of them of which the graph doubted most that sightings made, when it was made.
    """

    robots: tuple[str, ...]
    graph: JointGraph
    added: dict[EdgeId, GraphEdge] = field(default_factory=dict)
    own: dict[str, JointGraph] = field(default_factory=dict)
    misplaced: int = 0


class JointMap:
    """The joint maps of a team, as far as known.

    Every robot's own edges are first solved by themselves, each robot in its own frame ("kept aside"). Fusing edges
    join them into components. A component's frame is that of the first of its robots' names, whoever makes the map:
    the same edges make the same map.

    Attributes:
        refused: edges that cannot be, and why. One is left out until it comes in a higher version.
    """

    def __init__(self) -> None:
        self.refused: dict[EdgeId, str] = {}
        self._edges: dict[str, dict[EdgeId, Edge]] = {}  # the highest version of each robot's own
        self._own: dict[str, JointGraph] = {}
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

    def seen_from(self, robot: str) -> dict[VertexId, gtsam.Pose2]:
        """The poses of all vertices of a robot's component in that robot's frame, the one of its first vertex."""
        poses = self._component[robot].graph.estimates()
        root = poses[VertexId(robot, 0)]
        return {vertex: root.between(pose) for vertex, pose in poses.items()}

    def learn(self, edges: Iterable[Edge], robots: Iterable[str] = ()) -> None:
        """Take new edges, and new versions of known ones, that robots made within their own maps (M5, M7, M8).

        Components of several robots have them from the next ``join`` on. Any order will do: an edge that nothing
        connects yet waits for those that do, and a version that comes after a higher one does nothing. An edge that
        cannot be is ``refused``, and nothing else suffers.

        Args:
            robots: names of robots heard of; one with a single vertex has no edge.
        """
        changed = {robot for robot in robots if robot not in self._own}
        for edge in edges:
            known = self._edges.setdefault(edge.id.robot, {})
            before = known.get(edge.id)
            if before is not None and edge.version <= before.version:
                continue
            if before is not None and (edge.tail, edge.head) != (before.tail, before.head):
                self.refused[edge.id] = refusal(edge, f"its ends were {before.tail} and {before.head}")
                continue
            known[edge.id] = edge
            changed.add(edge.id.robot)
        for robot in sorted(changed):
            alone = robot not in self._own or self._component[robot].graph is self._own[robot]
            own = tuple(edge for _, edge in sorted(self._edges.get(robot, {}).items()))
            self._own[robot], refused = own_graph(robot, own)
            self.refused |= refused
            if alone:
                self._apart([robot])

    def join(self, added: Iterable[GraphEdge]) -> None:
        """Let ``added`` be all the edges beside the robots' own (M11, M13): robots come into one frame, or fall apart.

        What was learned since comes in with them. Edges that fix a pose join; a range and bearing between robots that
        nothing else joins is left out. Where the equations cannot be solved with them, the robots stay apart and one of
        the edges is ``refused``.
        """
        edges = {edge.id: edge for edge in sorted(added, key=lambda e: e.id)}
        for robots in self.connected(edges.values()):
            mine = {i: e for i, e in edges.items() if _ends(e) <= set(robots)}
            component = self._component[robots[0]]
            if component.robots == robots and component.added.keys() and mine:
                try:
                    self._exchange(component, mine)
                    if _in_place(component) or self._placed_anew(component):
                        continue
                except GraphError:
                    pass  # perhaps on the way there only
            try:
                component = self._grown(component, robots, mine) or self._made(robots, mine)
            except GraphError as error:
                self._refuse(next(iter(mine.values())), error)
                self._apart(robots)
            else:
                component.misplaced = len(_misplaced(component))
                self._component.update(dict.fromkeys(robots, component))

    def _refuse(self, edge: GraphEdge, error: GraphError) -> None:
        self.refused[edge.id] = refusal(edge, error)

    def _apart(self, robots: Iterable[str]) -> None:
        """Let every robot have its own map."""
        for robot in robots:
            self._component[robot] = Component((robot,), self._own[robot], {}, {robot: self._own[robot]})

    def connected(self, edges: Iterable[GraphEdge]) -> list[tuple[str, ...]]:
        """The robots that edges would bring together, names ascending."""
        group = {robot: {robot} for robot in self._own}
        for edge in edges:
            a, b = group[edge.tail.robot], group[edge.head.robot]
            if edge.estimate is not None and a is not b:
                a |= b
                group.update(dict.fromkeys(b, a))
        return sorted({tuple(sorted(members)) for members in group.values()})

    def _placed_anew(self, component: Component) -> bool:
        """Merge misplaced robots in once more, where sightings have them; whether that helped."""
        graph, robots = component.graph, component.robots
        pairs, out = _misplaced(component), set[str]()
        while pairs:  # the one they have in common
            count = Counter(robot for pair in pairs for robot in sorted(pair - {graph.root.robot}))
            worst = max(sorted(count), key=count.__getitem__)
            out.add(worst)
            pairs = [pair for pair in pairs if worst not in pair]
        graph.update(remove_vertices=[vertex for vertex in graph.vertices() if vertex.robot in out])
        self._merge(graph, {*robots} - out, robots, component.added)
        return _in_place(component)

    def _grown(self, component: Component, robots: tuple[str, ...], added: dict[EdgeId, GraphEdge]) -> Component | None:
        """The component with the robots that come to those it has; None if it has to be made anew."""
        inside = set(component.robots)
        within = {i: e for i, e in added.items() if _ends(e) <= inside}
        if len(inside) < 2 or not inside < set(robots) or component.robots not in self.connected(within.values()):
            return None
        try:
            self._exchange(component, within)
            self._merge(component.graph, inside, robots, added)
        except GraphError:
            return None
        return Component(robots, component.graph, added, {robot: self._own[robot] for robot in robots})

    def _made(self, robots: tuple[str, ...], added: dict[EdgeId, GraphEdge]) -> Component:
        """The robots' own graphs made one: the first one's, then the others in the order in which they are reached."""
        root, graph = robots[0], self._own[robots[0]]
        if added:
            graph = JointGraph(VertexId(root, 0))
            graph.update(add=self._own[root].edges())
            self._merge(graph, {root}, robots, added)
        return Component(robots, graph, added, {robot: self._own[robot] for robot in robots})

    def _exchange(self, component: Component, added: dict[EdgeId, GraphEdge]) -> None:
        """Bring a component whose robots stay the same up to date: its robots' own edges, and other added ones."""
        changed = [robot for robot in component.robots if component.own[robot] is not self._own[robot]]
        graphs = [component.own[robot] for robot in changed], [self._own[robot] for robot in changed]
        was, now = ({edge.id: edge for graph in some for edge in graph.edges()} for some in graphs)
        vertices, left = ({vertex for graph in some for vertex in graph.vertices()} for some in graphs)
        was, now = was | component.added, now | added
        add = [edge for i, edge in now.items() if i not in was]
        replace = [edge for i, edge in now.items() if i in was and edge.version > was[i].version]
        gone = [i for i in was if i not in now]
        if add or replace or gone:
            component.graph.update(add=add, replace=replace, remove=gone, remove_vertices=vertices - left)
        component.added = added
        component.own.update(zip(changed, graphs[1], strict=True))

    def _merge(
        self, graph: JointGraph, reached: set[str], robots: tuple[str, ...], added: dict[EdgeId, GraphEdge]
    ) -> None:
        """Take the other robots' own graphs into that of those ``reached``.

        What sightings made comes first; alignments refine where it has put the robots.
        """
        fused = {i: e for i, e in added.items() if e.kind in FUSED}
        while len(reached) < len(robots):
            edges = (*fused.values(), *added.values())
            bridge = next(e for e in edges if e.estimate and _ends(e) & reached and _ends(e) - reached)
            both = reached | _ends(bridge)
            rest = [e for e in fused.values() if e is not bridge and _ends(e) <= both and not _ends(e) <= reached]
            graph.merge(self._own[(both - reached).pop()], bridge, rest, more=True)
            reached = both
        known = {edge.id for edge in graph.edges()}
        graph.update(add=[e for i, e in added.items() if i not in known])


def _misplaced(component: Component) -> list[frozenset[str]]:
    """Pairs of robots of which the graph doubts at least half of what sightings made, and more than a stray edge.

    These may have been judged otherwise since, and alignments from where the robots seemed to be may hold them there.
    """
    fused = [e for e in component.added.values() if e.kind in FUSED]
    without_effect = component.graph.doubted()
    known = Counter(frozenset(_ends(e)) for e in fused)
    doubted = Counter(frozenset(_ends(e)) for e in fused if e.id in without_effect)
    pairs = [robots for robots, count in doubted.items() if 2 * count >= max(known[robots], MISPLACED)]
    return pairs if len(pairs) > SLIPPED * len(known) else []


def _in_place(component: Component) -> bool:
    """Whether hardly more robots are misplaced than when the component was made."""
    return len(_misplaced(component)) <= GROWN * component.misplaced


def _ends(edge: GraphEdge) -> set[str]:
    return {edge.tail.robot, edge.head.robot}
