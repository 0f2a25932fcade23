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

TRIES = 4
"""To merge a robot in: with all edges that sightings made, then by one at a time."""

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

    """

    def __init__(self) -> None:
        self._refused: dict[str, dict[EdgeId, str]] = {}  # of each robot's own edges,
        self._unfit: dict[EdgeId, tuple[GraphEdge, str]] = {}  # and of those added
        self._edges: dict[str, dict[EdgeId, Edge]] = {}  # the highest version of each robot's own
        self._own: dict[str, JointGraph] = {}
        self._component: dict[str, Component] = {}

    @property
    def refused(self) -> dict[EdgeId, str]:
        """Edges that cannot be, and why; each is left out until it, or what it joins, comes in another version."""
        own = {i: why for refused in self._refused.values() for i, why in refused.items()}
        return own | {i: why for i, (_, why) in self._unfit.items()}

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

        Components that anything was added to have them from the next ``join`` on. Any order will do: an edge that
        nothing connects yet waits for those that do, and a version that comes after a higher one does nothing. An edge
        that cannot be is ``refused``, and nothing else suffers.

        Args:
            robots: names of robots heard of; one with a single vertex has no edge.
        """
        changed = {robot for robot in robots if robot not in self._own}
        for edge in edges:
            known = self._edges.setdefault(edge.id.robot, {})
            before = known.get(edge.id)
            if before is not None and (edge.version < before.version or edge is before):
                continue
            known[edge.id] = edge
            changed.add(edge.id.robot)
        self._unfit = {i: found for i, found in self._unfit.items() if not _ends(found[0]) & changed}
        for robot in sorted(changed):
            alone = robot not in self._own or self._component[robot].graph is self._own[robot]
            own = tuple(edge for _, edge in sorted(self._edges.get(robot, {}).items()))
            self._own[robot], self._refused[robot] = own_graph(robot, own)
            if alone:
                self._component[robot] = self._made((robot,), {})

    def join(self, added: Iterable[GraphEdge]) -> None:
        """Let ``added`` be all the edges beside the robots' own (M11, M13): robots come into one frame, or fall apart.

        What was learned since comes in with them. Edges that fix a pose join; a range and bearing between robots that
        nothing else joins is left out. An edge with which the equations cannot be solved is ``refused``; so is a robot
        with which they cannot be by the edges tried: it stays apart, and the others come together.
        """
        edges = {edge.id: edge for edge in sorted(added, key=lambda e: e.id)}
        self._unfit = {i: found for i, found in self._unfit.items() if edges.get(i) is found[0]}
        edges = {i: edge for i, edge in edges.items() if i not in self._unfit}
        groups = self.connected(edges.values())
        while groups:
            robots = groups.pop(0)
            mine = {i: e for i, e in edges.items() if _ends(e) <= set(robots)}
            component = self._component[robots[0]]
            if component.robots == robots and component.added.keys() and mine:
                try:
                    self._exchange(component, mine)
                    if _in_place(component) or self._placed_anew(component):
                        continue
                except GraphError:
                    pass  # perhaps on the way there only
            component = self._grown(component, robots, mine) or self._made(robots, mine)
            component.misplaced = len(_misplaced(component))
            self._component.update(dict.fromkeys(component.robots, component))
            if left := {*robots} - {*component.robots}:
                groups += self.connected((e for e in mine.values() if _ends(e) <= left), left)

    def connected(self, edges: Iterable[GraphEdge], robots: Iterable[str] | None = None) -> list[tuple[str, ...]]:
        """The robots, all or some, that edges between them would bring together, names ascending."""
        group = {robot: {robot} for robot in (self._own if robots is None else robots)}
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
        if self._merge(graph, {*robots} - out, robots, component.added) < {*robots}:
            raise GraphError(f"{', '.join(sorted(out))} cannot be merged in anew")
        return _in_place(component)

    def _grown(self, component: Component, robots: tuple[str, ...], added: dict[EdgeId, GraphEdge]) -> Component | None:
        """The component with the robots that come to those it has; None if it has to be made anew."""
        inside = set(component.robots)
        within = {i: e for i, e in added.items() if _ends(e) <= inside}
        if len(inside) < 2 or not inside < set(robots) or component.robots not in self.connected(within.values()):
            return None
        try:
            self._exchange(component, within)
        except GraphError:
            return None
        return self._of(component.graph, self._merge(component.graph, inside, robots, added), added)

    def _made(self, robots: tuple[str, ...], added: dict[EdgeId, GraphEdge]) -> Component:
        """The robots' own graphs made one: the first one's, then the others in the order in which they are reached."""
        root, graph, reached = robots[0], self._own[robots[0]], {robots[0]}
        if added:
            graph = JointGraph(VertexId(root, 0))
            graph.update(add=self._own[root].edges())
            reached = self._merge(graph, reached, robots, added)
        return self._of(graph, reached, added)

    def _of(self, graph: JointGraph, reached: set[str], added: dict[EdgeId, GraphEdge]) -> Component:
        """The component of the robots reached."""
        robots = sorted(reached)
        within = {i: e for i, e in added.items() if _ends(e) <= reached and i not in self._unfit}
        return Component(tuple(robots), graph, within, {robot: self._own[robot] for robot in robots})

    def _exchange(self, component: Component, added: dict[EdgeId, GraphEdge]) -> None:
        """Bring a component whose robots stay the same up to date: its robots' own edges, and other added ones."""
        changed = [robot for robot in component.robots if component.own[robot] is not self._own[robot]]
        graphs = [component.own[robot] for robot in changed], [self._own[robot] for robot in changed]
        was, now = ({edge.id: edge for graph in some for edge in graph.edges()} for some in graphs)
        vertices, left = ({vertex for graph in some for vertex in graph.vertices()} for some in graphs)
        was, now = was | component.added, now | added
        # Two records may tell the same version, or versions of other ends: the later is another edge.
        other = {i for i, edge in now.items() if i in was and edge is not was[i] and not _follows(edge, was[i])}
        add = [edge for i, edge in now.items() if i not in was or i in other]
        replace = [edge for i, edge in now.items() if i in was and edge is not was[i] and i not in other]
        gone = [i for i in was if i not in now or i in other]
        if add or replace or gone:
            component.graph.update(add=add, replace=replace, remove=gone, remove_vertices=vertices - left)
        component.added = added
        component.own.update(zip(changed, graphs[1], strict=True))

    def _merge(
        self, graph: JointGraph, reached: set[str], robots: tuple[str, ...], added: dict[EdgeId, GraphEdge]
    ) -> set[str]:
        """Take the other robots' own graphs into that of those ``reached``, as far as it can be; who then is.

        What sightings made comes first; alignments refine where it has put the robots.
        """
        fused = {i: e for i, e in added.items() if e.kind in FUSED}
        failed = Counter[str]()
        while len(reached) < len(robots):
            without = {robot for robot, times in failed.items() if times >= TRIES}
            edges = (e for e in (*fused.values(), *added.values()) if e.id not in self._unfit)
            bridges = (e for e in edges if e.estimate and _ends(e) & reached and _ends(e) - reached - without)
            if (bridge := next(bridges, None)) is None:
                break
            both = reached | _ends(bridge)
            (newcomer,) = both - reached
            rest = [e for e in fused.values() if e is not bridge and _ends(e) <= both and not _ends(e) <= reached]
            try:
                graph.merge(self._own[newcomer], bridge, rest if newcomer not in failed else (), more=True)
                reached = both
            except GraphError as error:
                if newcomer in failed:
                    self._unfit[bridge.id] = bridge, refusal(bridge, error)
                failed[newcomer] += 1
        known = {edge.id for edge in graph.edges()} | self._unfit.keys()
        self._add(graph, [e for i, e in added.items() if i not in known and _ends(e) <= reached])
        return reached

    def _add(self, graph: JointGraph, edges: list[GraphEdge]) -> None:
        """Let a graph have edges, all but those that cannot be."""
        try:
            graph.update(add=edges)
        except GraphError:  # one by one: which is it?
            for edge in edges:
                try:
                    graph.update(add=[edge])
                except GraphError as error:
                    self._unfit[edge.id] = edge, refusal(edge, error)


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


def _follows(edge: GraphEdge, old: GraphEdge) -> bool:
    """Whether an edge is a newer version of another."""
    return edge.version > old.version and (edge.tail, edge.head) == (old.tail, old.head)


def _ends(edge: GraphEdge) -> set[str]:
    return {edge.tail.robot, edge.head.robot}
