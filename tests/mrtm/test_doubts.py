"""Which edges a graph believes: false ones are without effect, and what was believed wrongly is taken back."""

import json
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors import Edge, EdgeId, EdgeKind, VertexId
from mrtm.joint.agreeing import clique
from mrtm.joint.doubts import chance
from mrtm.joint.graph import GraphError, JointGraph
from mrtm.joint.joint_map import JointMap

STEP = np.diag([0.03, 0.02, np.radians(0.3)]) ** 2
LOOP = np.diag([0.02, 0.02, np.radians(0.2)]) ** 2
COUNT = 60


def red(index: int) -> VertexId:
    return VertexId("red", index)


class Ring:
    """A robot once round a ring of 480 m, which knows little of where it is when it comes back."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.truth = [gtsam.Pose2()]
        for _ in range(COUNT - 1):
            self.truth.append(self.truth[-1].compose(gtsam.Pose2(8.0, 0.0, 2.0 * np.pi / COUNT)))
        self.graph = JointGraph(red(0))
        self.graph.update(add=[self.edge(i, i, i + 1, EdgeKind.INTER_VERTEX) for i in range(COUNT - 1)])

    def edge(
        self, number: int, tail: int, head: int, kind: EdgeKind = EdgeKind.LOOP, moved: gtsam.Pose2 | None = None
    ) -> Edge:
        """A true edge, or as if what is around ``head`` were ``moved``."""
        covariance = LOOP if kind is EdgeKind.LOOP else STEP
        at = self.truth[head] if moved is None else moved.compose(self.truth[head])
        noise = gtsam.Pose2.Expmap(self.rng.multivariate_normal(np.zeros(3), covariance))
        pose = self.truth[tail].between(at).compose(noise)
        return Edge(EdgeId("red", number), 0, kind, red(tail), red(head), pose, covariance)


def closing(ring: Ring, first: int, count: int, moved: gtsam.Pose2 | None = None) -> list[Edge]:
    """Loops from the end of the way to its beginning."""
    return [ring.edge(first + n, COUNT - 1 - n, n, moved=moved) for n in range(count)]


@pytest.mark.parametrize("seed", range(3))
def test_a_false_loop_is_doubted_and_without_effect(seed: int) -> None:
    ring = Ring(seed)
    ring.graph.update(add=closing(ring, 100, 1))
    before = ring.graph.estimates()
    false = ring.edge(200, 40, 10, moved=gtsam.Pose2(6.0, 0.0, 0.0))
    ring.graph.update(add=[false])
    assert ring.graph.doubted() == {false.id}
    assert ring.graph.edges()[-1] is false
    assert all(pose.equals(before[v], 1e-9) for v, pose in ring.graph.estimates().items())
    ring.graph.update(remove=[false.id])
    assert ring.graph.doubted() == frozenset()


@pytest.mark.parametrize("seed", range(3))
def test_four_that_agree_put_out_a_false_one_that_came_first(seed: int) -> None:
    ring = Ring(seed)
    (false,) = closing(ring, 100, 1, gtsam.Pose2(0.8, -0.6, 0.05))
    ring.graph.update(add=[false])
    assert ring.graph.doubted() == frozenset()  # nothing tells it from a true one yet
    true = closing(ring, 200, 6)
    for number, edge in enumerate(true, 1):
        ring.graph.update(add=[edge])
        if number < 4:
            assert false.id not in ring.graph.doubted()
    assert ring.graph.doubted() == {false.id}
    with_it = ring.graph.estimates()
    ring.graph.update(remove=[false.id])
    assert all(pose.equals(with_it[v], 1e-4) for v, pose in ring.graph.estimates().items())


def test_three_that_agree_put_out_nothing() -> None:
    ring = Ring(3)
    true = closing(ring, 100, 2)
    false = closing(ring, 200, 5, gtsam.Pose2(3.0, 1.0, 0.1))[2:]
    ring.graph.update(add=true)
    for edge in false:
        ring.graph.update(add=[edge])
    assert ring.graph.doubted() == {edge.id for edge in false}


@pytest.mark.parametrize(("slip", "believed"), [(0.25, True), (1.0, False)])
def test_four_that_agree_outvote_a_slip_but_not_a_look_alike_place(slip: float, believed: bool) -> None:
    ring = Ring(9)
    # As if the robot, between 30 and 31, had come farther than it noticed.
    aside = ring.truth[30].compose(gtsam.Pose2(slip, 0.0, 0.0)).compose(ring.truth[30].inverse())
    over = [ring.edge(100 + n, 30, 31, moved=aside) for n in range(4)]
    for number, edge in enumerate(over, 1):
        ring.graph.update(add=[edge])
        if number < 4:
            assert ring.graph.doubted() == {e.id for e in over[:number]}
    assert ring.graph.doubted() == (frozenset() if believed else {e.id for e in over})


def test_edges_come_in_when_the_estimate_has_come_near() -> None:
    """Where many are false one loop is not believed across a long drift, but when others have closed it."""
    ring = Ring(4)
    false = [ring.edge(300 + n, 30 + n, 5 * n, moved=gtsam.Pose2(0.0, 7.0 + n, 1.0)) for n in range(5)]
    ring.graph.update(add=false)
    true = closing(ring, 100, 4)
    ring.graph.update(add=true[:1])
    assert true[0].id in ring.graph.doubted()
    for edge in true[1:]:
        ring.graph.update(add=[edge])
    assert ring.graph.doubted() == {edge.id for edge in false}


def test_what_alone_holds_a_vertex_is_believed_again() -> None:
    ring = Ring(5)
    ring.graph.update(add=closing(ring, 100, 1))
    false = ring.edge(200, 30, COUNT - 1, moved=gtsam.Pose2(5.0, 5.0, 0.3))
    ring.graph.update(add=[false])
    assert false.id in ring.graph.doubted()
    last = EdgeId("red", COUNT - 2)
    ring.graph.update(remove=[last, EdgeId("red", 100)])
    assert ring.graph.doubted() == frozenset()
    with pytest.raises(GraphError, match="would be cut off"):
        ring.graph.update(remove=[false.id])


def test_doubts_survive_a_checkpoint() -> None:
    ring = Ring(6)
    ring.graph.update(add=[*closing(ring, 100, 1), ring.edge(200, 40, 10, moved=gtsam.Pose2(6.0, 0.0, 0.0))])
    again = JointGraph.restore(json.loads(json.dumps(ring.graph.checkpoint())))
    assert again.doubted() == ring.graph.doubted() == {EdgeId("red", 200)}
    assert all(pose.equals(ring.graph.estimate(v), 1e-4) for v, pose in again.estimates().items())


def test_doubts_come_along_with_another_component() -> None:
    ring = Ring(7)
    ring.graph.update(add=[*closing(ring, 100, 1), ring.edge(200, 40, 10, moved=gtsam.Pose2(6.0, 0.0, 0.0))])
    blue = JointGraph(VertexId("blue", 0))
    bridge = Edge(EdgeId("x", 0), 0, EdgeKind.FUSING, blue.root, red(3), gtsam.Pose2(1.0, 2.0, 0.3), LOOP)
    blue.merge(ring.graph, bridge)
    assert blue.doubted() == {EdgeId("red", 200)}
    for v in map(red, range(COUNT)):
        relative = blue.estimate(red(3)).between(blue.estimate(v))
        assert relative.equals(ring.graph.estimate(red(3)).between(ring.graph.estimate(v)), 1e-6)


def test_robots_whose_sightings_are_judged_otherwise_are_joined_anew() -> None:
    """Alignments found where the robots seemed to be do not hold them there."""
    step, inter = gtsam.Pose2(5.0, 0.0, 0.2), EdgeKind.INTER_VERTEX
    ways = [(VertexId(robot, n), VertexId(robot, n + 1)) for robot in ("a", "b") for n in range(6)]
    way = [Edge(EdgeId(u.robot, u.number), 0, inter, u, v, step, STEP) for u, v in ways]
    joint = JointMap()
    joint.learn(way)
    poses = {v: pose for graph in joint.robots.values() for v, pose in graph.estimates().items()}

    def between(kind: EdgeKind, number: int, n: int, offset: gtsam.Pose2) -> Edge:
        tail, head = VertexId("a", n), VertexId("b", n)
        pose = poses[tail].inverse().compose(offset).compose(poses[head])
        return Edge(EdgeId(f"{tail}{'=' if kind is EdgeKind.ALIGNMENT else '-'}{head}", number), 0, kind, tail, head,
                    pose, LOOP)  # fmt: skip

    wrong, right = gtsam.Pose2(6.0, 0.0, 0.0), gtsam.Pose2(0.0, 0.5, 0.1)
    aligned = [between(EdgeKind.ALIGNMENT, 0, n, wrong) for n in range(6)]
    joint.join([between(EdgeKind.FUSING, 0, 2, wrong), *aligned])
    joint.join([between(EdgeKind.FUSING, 1, n, right) for n in range(4)] + aligned)
    (component,) = joint.components()
    a_T_b = component.graph.estimate(VertexId("a", 0)).between(component.graph.estimate(VertexId("b", 0)))
    assert a_T_b.equals(right, 0.05)
    assert component.graph.doubted() == {edge.id for edge in aligned}


def test_chance_is_the_volume_of_the_gate() -> None:
    rng = np.random.default_rng(8)
    covariance = np.diag([0.2, 0.4, 0.1]) ** 2
    angle, radius = rng.uniform(-np.pi, np.pi, (2, 2_000_000)), 10.0 * np.sqrt(rng.random(2_000_000))
    anywhere = np.stack([radius * np.cos(angle[0]), radius * np.sin(angle[0]), angle[1]])
    inside = (anywhere**2 / np.diag(covariance)[:, None]).sum(axis=0) <= 30.0
    assert chance(covariance) == pytest.approx(inside.mean(), rel=0.1)


def test_a_clique_agrees_all_with_all() -> None:
    ids = [EdgeId("red", n) for n in range(5)]
    pairs = [(0, 1), (0, 2), (1, 2), (0, 3), (3, 4), (0, 4), (1, 3)]
    agreeing = {i: {ids[b] for a, b in pairs if ids[a] == i} | {ids[a] for a, b in pairs if ids[b] == i} for i in ids}
    found = clique(ids[0], agreeing, set(ids))
    assert len(found) == 3
    assert all(b in agreeing[a] for a in found for b in found if a != b)
    assert clique(ids[2], agreeing, set(ids) - {ids[0]}) == [ids[2], ids[1]]


def test_what_a_doubted_loop_agreed_with_does_not_hold_its_next_version_back() -> None:
    """At the end of a visit every loop gets one. This one's first agreed with three false ones."""
    ring = Ring(3)
    ring.graph.update(add=closing(ring, 100, 2))
    slip = ring.truth[30].compose(gtsam.Pose2(0.25, 0.0, 0.0)).compose(ring.truth[30].inverse())
    far = ring.truth[30].compose(gtsam.Pose2(6.0, 2.0, 0.4)).compose(ring.truth[30].inverse())
    true = [ring.edge(300 + n, 30, 31, moved=slip) for n in range(4)]
    false = [ring.edge(250 + n, 30, 31, moved=far) for n in range(3)]
    first = ring.edge(303, 30, 31, moved=far)
    for edge in (*true[:3], *false, first):
        ring.graph.update(add=[edge])
    on = [
        Edge(EdgeId("red", 500 + n), 0, EdgeKind.INTER_VERTEX, red(COUNT - 1 + n), red(COUNT + n), gtsam.Pose2(), STEP)
        for n in range(4)
    ]
    ring.graph.update(add=on)
    assert {edge.id for edge in (*true[:3], *false, first)} <= ring.graph.doubted()
    ring.graph.update(replace=[replace(true[3], version=1)])
    assert not ring.graph.doubted() & {edge.id for edge in true}
