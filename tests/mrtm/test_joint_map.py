"""What a joint map makes of edges: in any order, late, twice, and of edges that cannot be."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from factors import Edge, EdgeId, EdgeKind, GraphEdge, VertexId
from mrtm.joint.graph import GraphError, JointGraph
from mrtm.joint.joint_map import JointMap
from tests.mrtm.sighting_world import STEP, TeamWorld
from tests.mrtm.team_world import second_version

WORLD = TeamWorld(3, 3)
FIRST = [edge for graph in WORLD.graphs.values() for edge in graph.edges() if isinstance(edge, Edge)]
EDGES = FIRST + [second_version(edge) for edge in FIRST if edge.id.number % 2]


def between(a: VertexId, b: VertexId, number: int = 0, version: int = 0, off: float = 0.0) -> Edge:
    """A fusing edge, true but for ``off`` metres."""
    pose = WORLD.truth[a].between(WORLD.truth[b]).compose(gtsam.Pose2(off, 0.0, 0.0))
    return Edge(EdgeId(f"{a}-{b}", number), version, EdgeKind.FUSING, a, b, pose, STEP)


JOINS = [
    between(VertexId("r0", 1), VertexId("r1", 4)),
    between(VertexId("r1", 2), VertexId("r2", 0)),
    between(VertexId("r0", 3), VertexId("r1", 0)),
]


def own_edge(robot: str, number: int, tail: int, head: int, version: int = 0) -> Edge:
    """A metre ahead."""
    ends = VertexId(robot, tail), VertexId(robot, head)
    return Edge(EdgeId(robot, number), version, EdgeKind.LOOP, *ends, gtsam.Pose2(1.0, 0.0, 0.0), STEP)


def told(edges: Sequence[Edge], added: Sequence[GraphEdge] = ()) -> JointMap:
    """Everything at once."""
    joint = JointMap()
    joint.learn(edges, WORLD.names)
    joint.join(added)
    return joint


def difference(a: JointMap, b: JointMap) -> float:
    """The largest, metres or radians, of the vertices of two maps with the same components; edges must be the same."""
    assert [c.robots for c in a.components()] == [c.robots for c in b.components()]
    largest = 0.0
    for one, other in zip(a.components(), b.components(), strict=True):
        ids = [{(e.id, e.version, e.tail, e.head) for e in c.graph.edges()} for c in (one, other)]
        assert ids[0] == ids[1]
        poses, others = one.graph.estimates(), other.graph.estimates()
        assert poses.keys() == others.keys()
        offsets = [poses[v].between(others[v]) for v in poses]
        largest = max(largest, *(max(abs(o.x()), abs(o.y()), abs(o.theta())) for o in offsets))
    return largest


@pytest.fixture(scope="module")
def whole() -> JointMap:
    return told(EDGES, JOINS)


@settings(max_examples=25, phases=[Phase.generate])
@given(st.data())
def test_any_order_repetitions_and_old_versions_come_to_the_same(whole: JointMap, data: st.DataObject) -> None:
    """In any portions, joined in between or not, old versions after new ones."""
    order = data.draw(st.permutations([*range(len(EDGES)), *data.draw(st.lists(st.sampled_from(range(len(EDGES)))))]))
    cuts = sorted(data.draw(st.sets(st.integers(0, len(order)), max_size=5)))
    joint = JointMap()
    for start, end in zip([0, *cuts], [*cuts, len(order)], strict=True):
        joint.learn([EDGES[i] for i in order[start:end]])
        heard = {v for graph in joint.robots.values() for v in graph.vertices()}
        if data.draw(st.booleans()):
            joint.join([e for e in JOINS if {e.tail, e.head} <= heard])
    joint.join(JOINS)
    assert difference(joint, whole) < 2e-4  # iSAM2 rests within 1e-4; to the last digit is ``Teammate.settle``
    for component in joint.components():
        component.graph.optimize_fully()
    for component in whole.components():
        component.graph.optimize_fully()
    assert difference(joint, whole) < 1e-6


def test_an_edge_that_nothing_connects_waits() -> None:
    joint = JointMap()
    joint.learn([own_edge("red", 2, 1, 2)])
    joint.learn([own_edge("red", 3, 2, 3)])
    joint.learn([own_edge("blue", 1, 0, 1)])
    assert joint.robots["red"].vertices() == [VertexId("red", 0)]
    assert len(joint.robots["blue"].vertices()) == 2
    joint.learn([own_edge("red", 1, 0, 1)])
    assert joint.robots["red"].vertices() == [VertexId("red", n) for n in range(4)]
    assert joint.robots["red"].estimate(VertexId("red", 3)).x() == pytest.approx(3.0)
    assert joint.refused == {}


def test_of_versions_that_wait_the_highest_counts() -> None:
    joint = JointMap()
    for version in (0, 2, 1):
        joint.learn([own_edge("red", 2, 1, 2, version)])
    joint.learn([own_edge("red", 1, 0, 1)])
    assert {e.id.number: e.version for e in joint.robots["red"].edges()} == {1: 0, 2: 2}


def test_a_version_that_comes_twice_or_late_does_nothing(whole: JointMap) -> None:
    joint = told(EDGES, JOINS)
    before = [component.graph.estimates() for component in joint.components()]
    joint.learn(FIRST)
    joint.learn(EDGES)
    joint.join(JOINS)
    for component, poses in zip(joint.components(), before, strict=True):
        assert all(pose.equals(poses[v], 0.0) for v, pose in component.graph.estimates().items())


def test_a_new_version_reaches_the_joint_graph() -> None:
    joint = told(FIRST, JOINS)
    joint.learn(EDGES)
    joint.join(JOINS)
    (component,) = joint.components()
    versions = {e.id: e.version for e in component.graph.edges()}
    assert all(versions[e.id] == e.id.number % 2 for e in FIRST)
    assert difference(joint, told(EDGES, JOINS)) < 2e-4


BAD = {
    "tail of another robot": Edge(
        EdgeId("r1", 50), 0, EdgeKind.LOOP, VertexId("r0", 1), VertexId("r1", 2), gtsam.Pose2(1, 0, 0), STEP
    ),
    "head of another robot": Edge(
        EdgeId("r1", 50), 0, EdgeKind.LOOP, VertexId("r1", 2), VertexId("r0", 1), gtsam.Pose2(1, 0, 0), STEP
    ),
    "both of another robot": Edge(
        EdgeId("r1", 50), 0, EdgeKind.LOOP, VertexId("r0", 0), VertexId("r0", 1), gtsam.Pose2(1, 0, 0), STEP
    ),
}


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("when", ["before the others", "after the others", "joined"])
def test_an_edge_that_cannot_be_is_refused_and_named_and_nothing_else_suffers(
    whole: JointMap, name: str, when: str
) -> None:
    bad, joint = BAD[name], JointMap()
    if when == "before the others":
        joint.learn([e for e in FIRST if e.id.robot == "r1"])
    if when in ("after the others", "joined"):
        joint.learn(EDGES)
    if when == "joined":
        joint.join(JOINS)
    joint.learn([bad])
    joint.learn(EDGES, WORLD.names)
    joint.join(JOINS)
    assert difference(joint, whole) < 2e-4
    assert list(joint.refused) == [bad.id]
    (line,) = joint.refused.values()
    assert str(bad.id) in line
    assert str(bad.tail) in line


def test_after_a_refused_version_a_higher_good_one_counts() -> None:
    joint = told(FIRST, JOINS)
    bad = BAD["tail of another robot"]
    joint.learn([bad])
    joint.learn([bad])
    assert list(joint.refused) == [bad.id]
    joint.learn([own_edge("r1", 50, 1, 2, 9)])
    assert joint.refused == {}
    joint.join(JOINS)
    (component,) = joint.components()
    assert {e.id: e.version for e in component.graph.edges()}[bad.id] == 9


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("version", [0, 7])
def test_of_what_is_told_of_one_edge_the_last_of_the_highest_version_counts(first: int, version: int) -> None:
    """Also where its ends are others. Which of two records of one version is told last the store decides."""
    ways = [own_edge("r1", 60, 3, 4), own_edge("r1", 60, 0, 4, version)]
    joint = told(FIRST, JOINS)
    for n in (first, 1 - first):
        joint.learn([ways[n]])
        joint.join(JOINS)
    counts = ways[1] if version else ways[1 - first]
    (component,) = joint.components()
    for graph in (component.graph, joint.robots["r1"]):
        (edge,) = [e for e in graph.edges() if e.id == counts.id]
        assert (edge.version, edge.tail, edge.head) == (counts.version, counts.tail, counts.head)


@pytest.mark.parametrize("known", [["r0", "r1", "r2"], ["r0"]])
def test_a_robot_that_cannot_be_merged_stays_apart_and_the_others_come_together(
    monkeypatch: pytest.MonkeyPatch, known: list[str]
) -> None:
    plain = JointGraph.merge

    def give_up(graph: JointGraph, other: JointGraph, *rest: Any, **how: Any) -> None:
        if other.root.robot == "r0" or graph.root.robot == "r0":
            raise GraphError("the joint graph cannot be solved with this change")
        plain(graph, other, *rest, **how)

    joint = told([e for e in EDGES if e.id.robot in known])
    with monkeypatch.context() as patch:
        patch.setattr(JointGraph, "merge", give_up)
        joint.learn(EDGES, WORLD.names)
        for _ in range(2):
            joint.join(JOINS)
            assert [c.robots for c in joint.components()] == [("r0",), ("r1", "r2")]
        assert joint.refused.keys() == {JOINS[0].id, JOINS[2].id}
    joint.join(JOINS)
    assert joint.refused  # they are left out
    joint.learn([second_version(second_version(e)) for e in FIRST if e.id.robot == "r0"])
    joint.join(JOINS)
    assert joint.refused == {}
    assert [c.robots for c in joint.components()] == [("r0", "r1", "r2")]


def test_an_added_edge_that_cannot_be_is_left_out_until_it_comes_in_another_version(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plain, odd = JointGraph._place, between(VertexId("r0", 2), VertexId("r2", 3))

    def give_up(graph: JointGraph, added: list[Any], made: dict[VertexId, gtsam.Pose2]) -> None:
        if odd in added:
            raise GraphError("the joint graph cannot be solved with this change")
        plain(graph, added, made)

    monkeypatch.setattr(JointGraph, "_place", give_up)
    joint = told(EDGES, JOINS)
    for added in ([*JOINS, odd], [*JOINS[1:], odd], [*JOINS, odd]):
        joint.join(added)
        assert joint.refused.keys() == {odd.id}
        assert difference(joint, told(EDGES, [e for e in added if e is not odd])) < 2e-4
    again = between(VertexId("r0", 2), VertexId("r2", 3), version=1)
    joint.join([*JOINS, again])
    assert joint.refused == {}
    (component,) = joint.components()
    assert again in component.graph.edges()


@pytest.mark.parametrize("true", [4, 7])
def test_a_false_edge_that_alone_joined_two_robots_gives_way_and_they_stay_together(true: int) -> None:
    own = [replace(own_edge(robot, n, n, n + 1), kind=EdgeKind.INTER_VERTEX) for robot in "ab" for n in range(8)]

    def across(number: int, off: float) -> Edge:
        ends = VertexId("a", number), VertexId("b", number)
        return Edge(EdgeId(f"ab{number}", 0), 0, EdgeKind.FUSING, *ends, gtsam.Pose2(off, 3.0 + off, 0.0), STEP)

    false, rest = across(0, 4.0), [across(n, 0.0) for n in range(1, true + 1)]
    for steps in ([[false, *rest]], [[false, *rest[:n]] for n in range(true + 1)]):
        joint = JointMap()
        joint.learn(own)
        for added in steps:
            joint.join(added)
            assert [c.robots for c in joint.components()] == [("a", "b")]
        assert joint.refused == {}
        assert joint.components()[0].graph.doubted() == {false.id}


def test_a_change_of_added_edges_is_the_map_made_anew() -> None:
    """Other versions, some gone, some new, and one id that means something else now."""
    first = [JOINS[0], JOINS[1], between(VertexId("r0", 2), VertexId("r1", 3), 5, off=0.3)]
    other_ends = between(VertexId("r1", 3), VertexId("r0", 2))
    then = [
        JOINS[1],
        JOINS[2],
        Edge(first[2].id, 1, EdgeKind.FUSING, other_ends.tail, other_ends.head, other_ends.measurement, STEP),
    ]
    joint = told(EDGES, first)
    joint.join(then)
    assert difference(joint, told(EDGES, then)) < 2e-4
    assert joint.refused == {}


def test_robots_fall_apart_with_the_last_edge_that_fixes_a_pose_and_are_as_they_were() -> None:
    joint = told(EDGES, JOINS)
    joint.join(JOINS[1:2])
    assert [c.robots for c in joint.components()] == [("r0",), ("r1", "r2")]
    joint.join(())
    assert [c.robots for c in joint.components()] == [("r0",), ("r1",), ("r2",)]
    assert difference(joint, told(EDGES)) == 0.0
    for robot, graph in joint.robots.items():
        assert joint.component(robot).graph is graph


def test_a_robot_of_one_vertex_is_a_component_and_can_be_joined() -> None:
    joint = JointMap()
    joint.learn((), ["red", "blue"])
    assert [c.robots for c in joint.components()] == [("blue",), ("red",)]
    tail, head = VertexId("blue", 0), VertexId("red", 0)
    joint.join([Edge(EdgeId("x", 0), 0, EdgeKind.FUSING, tail, head, gtsam.Pose2(1, 2, 0.5), STEP)])
    assert joint.seen_from("red")[tail].equals(gtsam.Pose2(1, 2, 0.5).inverse(), 1e-9)


def test_every_robot_sees_the_same_map_from_its_own_first_vertex(whole: JointMap) -> None:
    poses = whole.component("r0").graph.estimates()
    for robot in WORLD.names:
        mine = whole.seen_from(robot)
        assert mine[VertexId(robot, 0)].equals(gtsam.Pose2(), 1e-12)
        assert all(poses[VertexId(robot, 0)].between(pose).equals(mine[vertex], 1e-9) for vertex, pose in poses.items())


def test_the_map_is_near_the_truth(whole: JointMap) -> None:
    """Else all of the above could agree on nonsense."""
    true = {v: WORLD.truth[VertexId("r0", 0)].between(pose) for v, pose in WORLD.truth.items()}
    errors = [np.hypot(*(pose.translation() - true[v].translation())) for v, pose in whole.seen_from("r0").items()]
    assert max(errors) < 1.0


def test_what_an_edge_that_cannot_be_would_have_connected_waits_for_another(monkeypatch: pytest.MonkeyPatch) -> None:
    bad, rest = own_edge("red", 1, 0, 1), [own_edge("red", 2, 1, 2), own_edge("red", 3, 0, 2)]
    plain = JointGraph._place

    def give_up(graph: JointGraph, added: list[Any], made: dict[VertexId, gtsam.Pose2]) -> None:
        if bad in added:
            raise GraphError("the joint graph cannot be solved with this change")
        plain(graph, added, made)

    monkeypatch.setattr(JointGraph, "_place", give_up)
    joint = JointMap()
    joint.learn([bad, *rest])
    assert joint.refused.keys() == {bad.id}
    assert {edge.id for edge in joint.robots["red"].edges()} == {edge.id for edge in rest}
