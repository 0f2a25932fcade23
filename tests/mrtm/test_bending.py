"""Local maps give way where edges hold: against conditioning by hand, against simulated drifting maps."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors import Edge, EdgeId, EdgeKind, VertexId, adjoint_transport
from factors.noise import FloatArray
from frontend import se2
from frontend.local_map import Bends
from mrtm.joint import bending
from mrtm.joint.bending import BentMap, Holding, bend
from mrtm.joint.graph import JointGraph
from mrtm.robot.poses import array_of, pose_of

LENGTH = 12  # metres driven in a map, a place each
DRIFT = np.diag([4e-4, 9e-4, 4e-6])  # covariance of the motion at the origin that gathers in a metre
FINE = 1e-8 * np.eye(3)
A, B, C = (VertexId("red", index) for index in range(3))
AHEAD = gtsam.Pose2(LENGTH, 0.0, 0.0)
WAY = np.column_stack([np.arange(LENGTH + 1.0), np.zeros((LENGTH + 1, 2))])


def straight() -> Bends:
    """Of a map drawn straight ahead."""
    places = WAY[:, :2]
    return Bends(places, places[:, :1, None] * DRIFT)


def at(x: float) -> FloatArray:
    """The shares of a point that was drawn from one place."""
    return np.asarray(np.arange(LENGTH + 1) == x, np.float64)


def edge(number: int, tail: VertexId, head: VertexId, pose: gtsam.Pose2, covariance: FloatArray) -> Edge:
    return Edge(EdgeId("red", number), 0, EdgeKind.INTER_VERTEX, tail, head, pose, covariance)


def drifted(pose: gtsam.Pose2) -> FloatArray:
    """The covariance of an edge that measures ``pose`` at the end of a map's way, but for the map's drift exactly."""
    return adjoint_transport(pose.inverse(), LENGTH * DRIFT)


def optimum(*edges: Edge) -> dict[VertexId, gtsam.Pose2]:
    graph = JointGraph(A)
    graph.update(add=edges)
    graph.optimize_fully()
    return graph.estimates()


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Covariances of edges that are of bends to a thousandth."""
    monkeypatch.setattr(bending, "LEAST", 1e-3)


@pytest.mark.usefixtures("exact")
def test_scans_follow_as_far_as_their_way_when_a_loop_closes() -> None:
    """B, measured at the end of the way through A, turns out to lie aside: A's scans go along, the later the more."""
    driven = edge(0, A, B, AHEAD, drifted(AHEAD))
    loop = edge(1, A, B, AHEAD.compose(gtsam.Pose2(0.0, 0.12, 0.0)), FINE)
    found = bend(optimum(driven, loop), [Holding(driven, at(LENGTH)), Holding(loop)], {A: straight()})
    np.testing.assert_allclose(found[A].motions[:, 1], 0.01 * np.arange(LENGTH + 1), atol=2e-4)
    np.testing.assert_allclose(found[A].motions[:, [0, 2]], 0.0, atol=1e-5)
    placed = found[A].placed(WAY)
    np.testing.assert_allclose(placed[:, 1], 0.01 * np.arange(LENGTH + 1), atol=2e-4)
    assert found[A].rigid(WAY).y() == pytest.approx(placed[:, 1].mean(), abs=1e-4)
    assert found[A].origin.equals(gtsam.Pose2(), 1e-9)
    assert found[B].origin.equals(loop.measurement, 1e-4)


def test_nothing_moves_where_all_edges_agree() -> None:
    edges = [edge(0, A, B, AHEAD, drifted(AHEAD)), edge(1, B, C, AHEAD, drifted(AHEAD))]
    poses = optimum(*edges)
    found = bend(poses, [Holding(e, at(LENGTH), at(0)) for e in edges], dict.fromkeys((A, B, C), straight()))
    for vertex, pose in poses.items():
        assert found[vertex].origin.equals(pose, 1e-9)
        np.testing.assert_allclose(found[vertex].motions, 0.0, atol=1e-9)


def test_maps_of_which_nothing_is_known_stay_where_the_graph_has_them() -> None:
    edges = [edge(n, A, B, AHEAD.compose(gtsam.Pose2(0.0, y, 0.0)), DRIFT) for n, y in enumerate((-0.02, 0.05))]
    poses = optimum(*edges)
    found = bend(poses, [Holding(e) for e in edges], {})
    for vertex, pose in poses.items():
        assert found[vertex].origin.equals(pose, 1e-6)
        np.testing.assert_allclose(found[vertex].placed(WAY), se2.compose(array_of(pose), WAY), atol=1e-6)
        assert found[vertex].rigid(WAY).equals(pose, 1e-6)
    assert bend({A: gtsam.Pose2()}, [], {A: straight()})[A].origin.equals(gtsam.Pose2(), 0.0)


@pytest.mark.usefixtures("exact")
def test_edges_at_one_place_do_not_count_twice() -> None:
    """Nine alignments at the end of A have one error; the graph takes it for nine, and one more edge as a tenth."""
    aside = AHEAD.compose(gtsam.Pose2(0.0, 0.1, 0.0))
    lone, same = edge(9, A, B, AHEAD, drifted(AHEAD)), [edge(n, A, B, aside, drifted(aside)) for n in range(9)]
    poses = optimum(lone, *same)
    assert poses[B].y() == pytest.approx(0.09, abs=1e-3)
    found = bend(poses, [Holding(lone), *(Holding(e, at(LENGTH)) for e in same)], {A: straight()})
    assert found[B].origin.y() == pytest.approx(0.05, abs=1e-3)


def test_an_edge_under_the_robust_kernel_has_the_weight_that_the_graph_gives_it() -> None:
    good = edge(0, A, B, AHEAD, DRIFT)
    wrong = replace(edge(1, A, B, AHEAD.compose(gtsam.Pose2(0.0, 0.3, 0.0)), DRIFT), kind=EdgeKind.LOOP)
    moved = bend({A: gtsam.Pose2(), B: AHEAD}, [Holding(good), Holding(wrong)], {})[B].origin.y()
    chi2 = 0.3**2 / DRIFT[1, 1]
    share = (2 * 7.815 / (7.815 + chi2)) ** 2
    assert moved == pytest.approx(0.3 * share / (1.0 + share), rel=1e-3)


def by_hand(poses: dict[VertexId, gtsam.Pose2], holdings: list[Holding], bends: dict[VertexId, Bends]) -> FloatArray:
    """(n, 3) y of the scans of all maps in a world in which nothing turns: conditioned with one dense matrix."""
    vertices, n = list(poses), len(holdings)
    wide = 1e4 * np.eye(len(vertices))
    wide[0, 0] = 0.0
    origins = np.zeros((n, len(vertices)))
    residual, own = np.zeros(n), np.zeros(n)
    seen = {v: np.zeros((n, len(b.places))) for v, b in bends.items()}
    for row, (e, tail, head) in enumerate(holdings):
        assert tail is not None
        assert head is not None
        residual[row] = e.estimate.pose.y() - (poses[e.head].y() - poses[e.tail].y()) if e.estimate else 0.0
        for vertex, shares, sign in ((e.tail, tail, -1.0), (e.head, head, 1.0)):
            origins[row, vertices.index(vertex)] = sign
            seen[vertex][row] = sign * shares
        own[row] = e.covariance[1, 1]
    prior = {
        v: np.sqrt(np.outer(b.covariances[:, 1, 1], b.covariances[:, 1, 1])) * b.together() for v, b in bends.items()
    }
    bent = sum(seen[v] @ prior[v] @ seen[v].T for v in bends)
    own = np.maximum(own - np.diag(bent), bending.LEAST * own)
    whole = origins @ wide @ origins.T + bent + np.diag(own)
    gain = np.linalg.solve(whole, residual)
    return np.array([(wide @ origins.T @ gain)[k] + prior[v] @ seen[v].T @ gain for k, v in enumerate(vertices)])


@pytest.mark.parametrize("seed", range(3))
def test_it_is_what_conditioning_by_hand_gives(seed: int) -> None:
    """Maps that only slip aside, by edges between any two of them that hold anywhere, against one dense solution."""
    rng = np.random.default_rng(seed)
    aside = np.diag([1e-12, 9e-4, 1e-12])
    bends = {v: Bends(WAY[:, :2], WAY[:, :1, None] * rng.uniform(0.5, 2.0) * aside) for v in (A, B, C)}
    holdings = []
    for number, (tail, head) in enumerate([(A, B), (B, C), (A, C), (A, B), (C, A)]):
        ends = rng.dirichlet(np.ones(LENGTH + 1), 2)
        covariance = np.diag([1e-8, rng.uniform(0.5, 20.0) * 9e-4, 1e-8])
        measured = gtsam.Pose2(0.0, rng.normal(0.0, 0.1), 0.0)
        holdings.append(Holding(edge(number, tail, head, measured, covariance), *ends))
    poses = optimum(*(h.edge for h in holdings if isinstance(h.edge, Edge)))
    found = bend(poses, holdings, bends)
    expected = by_hand(poses, holdings, bends)
    for k, v in enumerate(poses):
        moved = found[v].origin.y() - poses[v].y() + found[v].motions[:, 1]
        np.testing.assert_allclose(moved, expected[k], atol=1e-5)


def test_drifting_maps_come_nearer_to_the_truth() -> None:
    """A robot drives a square of four maps that drift as they say, and meets its beginning again; many times."""
    rng = np.random.default_rng(4)
    turn = gtsam.Pose2(LENGTH, 0.0, np.pi / 2)
    square = [VertexId("red", index) for index in range(4)]
    errors: dict[str, list[float]] = {"rigid": [], "bent": [], "whole": []}
    for _ in range(40):
        walks = rng.multivariate_normal(np.zeros(3), DRIFT, (4, LENGTH)).cumsum(axis=1)
        walks = np.concatenate([np.zeros((4, 1, 3)), walks], axis=1)
        true, edges = [gtsam.Pose2()], []
        for index, walk in enumerate(walks):
            true.append(true[-1].compose(gtsam.Pose2.Expmap(walk[-1])).compose(turn))
            if index < 3:
                edges.append(edge(index, square[index], square[index + 1], turn, drifted(turn)))
        # The end of the last way, seen in the first map at its origin, is where its scans have it but for its drift.
        back = turn.compose(true[4].inverse()).compose(true[0])
        edges.append(edge(3, square[3], square[0], back, drifted(back)))
        poses = optimum(*edges)
        found = bend(poses, [Holding(e, at(LENGTH)) for e in edges], dict.fromkeys(square, straight()))
        for index, vertex in enumerate(square):
            truth = se2.compose(se2.compose(array_of(true[index]), se2.exp(walks[index])), WAY)
            rigid, whole = (se2.compose(array_of(p), WAY) for p in (poses[vertex], found[vertex].rigid(WAY)))
            for name, placed in (("rigid", rigid), ("bent", found[vertex].placed(WAY)), ("whole", whole)):
                errors[name].extend(np.square(placed - truth)[:, :2].sum(axis=1))
    means = {name: np.sqrt(np.mean(squares)) for name, squares in errors.items()}
    assert means["bent"] < 0.95 * means["rigid"]
    assert means["bent"] < means["whole"] < means["rigid"]


def test_a_map_is_placed_rigid_where_its_scans_lie_on_average() -> None:
    motions = np.column_stack([np.zeros(LENGTH + 1), 0.01 * np.arange(LENGTH + 1), np.zeros(LENGTH + 1)])
    one = BentMap(pose_of(np.array([1.0, 2.0, 0.5])), straight(), motions)
    rigid = se2.compose(array_of(one.rigid(WAY)), WAY)
    offsets = se2.log(se2.between(rigid, one.placed(WAY)))
    np.testing.assert_allclose(offsets.mean(axis=0), 0.0, atol=1e-4)
    assert np.abs(offsets[:, 1]).max() > 0.02
