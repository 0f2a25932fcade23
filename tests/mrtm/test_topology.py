"""The topological map: versions, fates, and the projection along shortest paths."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from factors import Edge, EdgeKind, UncertainPose, VertexId
from frontend.local_map import Bends
from frontend.records import FloatArray
from mrtm.joint.graph import JointGraph
from mrtm.robot.topology import Topology, Vertex

SAMPLES = 20_000


def covariance(rng: np.random.Generator, sigma: float) -> FloatArray:
    root = sigma * rng.standard_normal((3, 3))
    return np.asarray(root @ root.T + 0.1 * sigma**2 * np.eye(3))


def join(topology: Topology, tail: Vertex, head: Vertex, pose: gtsam.Pose2, cov: FloatArray) -> Edge:
    edge = topology.new_edge(EdgeKind.INTER_VERTEX, tail.id, head.id, UncertainPose(pose, cov))
    topology.put(edge)
    return edge


def chain(rng: np.random.Generator, steps: list[tuple[gtsam.Pose2, bool]], sigma: float) -> tuple[Topology, list[Edge]]:
    """Vertices in a row; a step is the way to the next vertex and whether its edge points forward."""
    topology = Topology("red")
    vertices = [topology.new_vertex() for _ in range(len(steps) + 1)]
    edges = []
    for (a, b), (step, forward) in zip(pairwise(vertices), steps, strict=True):
        if forward:
            edges.append(join(topology, a, b, step, covariance(rng, sigma)))
        else:
            edges.append(join(topology, b, a, step.inverse(), covariance(rng, sigma)))
    return topology, edges


STEPS = [
    (gtsam.Pose2(5.0, 1.0, 0.4), True),
    (gtsam.Pose2(4.0, -2.0, -1.3), False),
    (gtsam.Pose2(6.0, 0.5, 2.9), True),
    (gtsam.Pose2(-3.0, 2.0, 1.0), False),
]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_vertices_are_numbered_and_edges_have_ids_of_their_own() -> None:
    topology = Topology("red")
    a, b, c = (topology.new_vertex() for _ in range(3))
    assert [v.id for v in topology.vertices] == [VertexId("red", i) for i in range(3)]
    assert a.maps is None
    assert a.scans == []
    first = join(topology, a, b, gtsam.Pose2(1, 0, 0), np.eye(3))
    second = join(topology, b, c, gtsam.Pose2(1, 0, 0), np.eye(3))
    assert first.id != second.id
    assert (first.version, second.version) == (0, 0)


def test_a_new_edge_is_no_part_of_the_map_until_it_is_put() -> None:
    topology = Topology("red")
    a, b = topology.new_vertex(), topology.new_vertex()
    edge = topology.new_edge(EdgeKind.LOOP, a.id, b.id, UncertainPose(gtsam.Pose2(), np.eye(3)))
    assert topology.edges == {}
    assert topology.between(a.id, b.id) is None
    topology.put(edge)
    assert topology.between(a.id, b.id) is edge
    assert topology.between(b.id, a.id) is edge


def test_a_new_version_takes_the_place_of_the_old_one_which_becomes_history() -> None:
    topology = Topology("red")
    a, b = topology.new_vertex(), topology.new_vertex()
    old = join(topology, a, b, gtsam.Pose2(1, 0, 0), np.eye(3))
    kind = EdgeKind.COVARIANCE_INTERSECTION
    newer = [Edge(old.id, i, kind, a.id, b.id, gtsam.Pose2(1.1, 0, 0), 0.5 * np.eye(3)) for i in (1, 2)]
    for edge in newer:
        topology.put(edge)
    assert list(topology.edges.values()) == [newer[1]]
    assert [(f.edge, f.fate) for f in topology.past] == [(old, "replaced"), (newer[0], "replaced")]
    assert [f.reason for f in topology.past] == ["by version 1", "by version 2"]
    assert topology.between(a.id, b.id) is newer[1]


def test_a_vertex_seen_from_itself_is_at_the_origin_without_doubt(rng: np.random.Generator) -> None:
    topology, _ = chain(rng, STEPS, 0.05)
    here = topology.along_shortest_paths(topology.vertices[2].id)[topology.vertices[2].id]
    assert here.pose.equals(gtsam.Pose2(), 1e-12)
    assert not here.covariance.any()


@pytest.mark.parametrize("start", range(len(STEPS) + 1))
def test_poses_are_composed_by_hand_in_both_directions(rng: np.random.Generator, start: int) -> None:
    topology, _ = chain(rng, STEPS, 0.05)
    poses = [gtsam.Pose2()]
    for step, _ in STEPS:
        poses.append(poses[-1].compose(step))
    seen = topology.along_shortest_paths(topology.vertices[start].id)
    for end, vertex in enumerate(topology.vertices):
        assert seen[vertex.id].pose.equals(poses[start].between(poses[end]), 1e-9)


def test_covariances_are_composed_by_hand(rng: np.random.Generator) -> None:
    """a_T_c = a_T_b Exp(x) b_T_c Exp(y): x moves to c by the adjoint of c_T_b; an edge turned round, to its tail."""
    topology, edges = chain(rng, STEPS[:2], 0.05)
    first, second = edges
    b_T_c = STEPS[1][0]
    out = b_T_c.AdjointMap()  # the second edge points from c to b: its covariance is in the frame of b
    turned = np.linalg.inv(out) @ second.covariance @ np.linalg.inv(out).T
    assert second.measurement.equals(b_T_c.inverse(), 1e-12)
    carried = np.linalg.inv(out) @ first.covariance @ np.linalg.inv(out).T
    seen = topology.along_shortest_paths(topology.vertices[0].id)[topology.vertices[2].id]
    np.testing.assert_allclose(seen.covariance, carried + turned, rtol=1e-9)


def test_covariances_are_those_of_noisy_edges(rng: np.random.Generator) -> None:
    """Monte Carlo over the whole chain, edges in both directions: nothing of the algebra is used."""
    topology, edges = chain(rng, STEPS, 0.01)
    seen = topology.along_shortest_paths(topology.vertices[0].id)[topology.vertices[-1].id]
    noise = [rng.multivariate_normal(np.zeros(3), edge.covariance, SAMPLES) for edge in edges]
    tangents = np.empty((SAMPLES, 3))
    for i in range(SAMPLES):
        pose = gtsam.Pose2()
        for edge, (_, forward), xi in zip(edges, STEPS, noise, strict=True):
            true = edge.measurement.compose(gtsam.Pose2.Expmap(xi[i]))
            pose = pose.compose(true if forward else true.inverse())
        tangents[i] = gtsam.Pose2.Logmap(seen.pose.between(pose))
    found = np.cov(tangents.T)
    whitened = np.linalg.solve(np.linalg.cholesky(seen.covariance), np.linalg.cholesky(found))
    np.testing.assert_allclose(whitened @ whitened.T, np.eye(3), atol=0.06)


def test_a_chain_is_seen_as_the_joint_graph_sees_it(rng: np.random.Generator) -> None:
    """Without loops both projections of M6 are the same."""
    topology, edges = chain(rng, STEPS, 0.01)
    graph = JointGraph(topology.vertices[0].id)
    graph.update(add=edges)
    for a in topology.vertices:
        seen = topology.along_shortest_paths(a.id)
        for b in topology.vertices:
            if a is not b:
                joint = graph.relative(a.id, b.id)
                assert seen[b.id].pose.equals(joint.pose, 1e-6)
                np.testing.assert_allclose(seen[b.id].covariance, joint.covariance, rtol=1e-4, atol=1e-12)


def test_of_two_ways_round_a_ring_the_shorter_one_is_taken(rng: np.random.Generator) -> None:
    """A ring of four whose long side contradicts the others by a metre: which way was gone can be read off."""
    topology, edges = chain(rng, [(gtsam.Pose2(4, 0, np.pi / 2), True)] * 3, 0.05)
    a, _, _, d = topology.vertices
    long_way = join(topology, a, d, gtsam.Pose2(0, 13.0, -np.pi / 2), covariance(rng, 0.001))
    seen = topology.along_shortest_paths(a.id)[d.id]
    assert seen.pose.equals(gtsam.Pose2(0, 4, -np.pi / 2), 1e-9)  # 12 m of driving against 13 m
    topology.put(Edge(long_way.id, 1, long_way.kind, a.id, d.id, gtsam.Pose2(0, 11.0, -np.pi / 2), 0.1 * np.eye(3)))
    assert topology.along_shortest_paths(a.id)[d.id].pose.equals(gtsam.Pose2(0, 11, -np.pi / 2), 1e-9)
    assert len(edges) == 3


def test_the_path_goes_along_the_present_versions(rng: np.random.Generator) -> None:
    topology, edges = chain(rng, STEPS[:1], 0.05)
    a, b = topology.vertices
    seen = topology.along_shortest_paths(a.id)
    moved = gtsam.Pose2(5.2, 1.1, 0.5)
    topology.put(Edge(edges[0].id, 1, EdgeKind.COVARIANCE_INTERSECTION, a.id, b.id, moved, 1e-4 * np.eye(3)))
    assert seen[b.id].pose.equals(STEPS[0][0], 1e-12)  # what was projected before stays what it was
    now = topology.along_shortest_paths(a.id)[b.id]
    assert now.pose.equals(moved, 1e-12)
    np.testing.assert_allclose(now.covariance, 1e-4 * np.eye(3))


def test_the_error_of_a_map_is_that_of_the_poses_it_was_made_from() -> None:
    vertex = Vertex(VertexId("red", 0))
    own = np.diag([1e-4, 4e-4, 1e-5])
    pose = np.array([5.0, 0.0, np.pi / 2])
    np.testing.assert_array_equal(vertex.uncertain(pose, own).covariance, own)
    vertex.drawn_from(np.zeros((1, 3)), np.diag([1e-4, 2e-4, 1e-4])[None])
    found = vertex.uncertain(pose, own)
    assert found.pose.equals(gtsam.Pose2(5.0, 0.0, np.pi / 2), 1e-12)
    # Five metres on, turned left: what was to the side is ahead, and moves by 5 m times the error of the heading.
    added = found.covariance - own
    assert added[0, 0] == pytest.approx(2e-4 + 25.0 * 1e-4)
    assert added[1, 1] == pytest.approx(1e-4)
    assert added[2, 2] == pytest.approx(1e-4)
    assert np.linalg.eigvalsh(added).min() > -1e-12
    # Of two poses the nearer one counts more.
    vertex.bends = Bends().extended(
        np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]), np.stack([np.diag([1e-4, 2e-4, 1e-4]), 1e-6 * np.eye(3)])
    )
    assert vertex.uncertain(pose, own).covariance[0, 0] - own[0, 0] < 0.3 * added[0, 0]
    # A later visit draws into the map that is there, and does not make it worse.
    before = vertex.bends.places
    vertex.drawn_from(np.array([[5.5, 0.5, 1.0], [0.0, 12.0, 0.0]]), np.stack([np.eye(3), 1e-2 * np.eye(3)]))
    np.testing.assert_array_equal(vertex.bends.places, [*before, [0.0, 12.0]])
    there = vertex.uncertain(np.array([0.0, 12.0, 0.0]), own).covariance - own
    np.testing.assert_allclose(there, 1e-2 * np.eye(3), rtol=0.1, atol=2e-3)
    # Errors are averaged, not their squares: beside a pose without error, half an error is a quarter of its square.
    vertex.bends = Bends().extended(
        np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]), np.stack([np.zeros((3, 3)), np.diag([4e-4, 1e-4, 0.0])])
    )
    half = vertex.uncertain(np.array([5.0, 0.0, 0.0]), own).covariance - own
    np.testing.assert_allclose(half, np.diag([1e-4, 0.25e-4, 0.0]), atol=1e-12)
