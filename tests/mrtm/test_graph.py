import json
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
import pytest

from factors import (
    FULL_WEIGHT,
    AnchoredSighting,
    Edge,
    EdgeId,
    EdgeKind,
    FactorError,
    GraphEdge,
    Sighting,
    SightingEdge,
    UncertainPose,
    VertexId,
    compose,
    factor_of,
    inverse,
    prior_factor,
    without_kernel,
)
from mrtm.joint import relinearization, smoother
from mrtm.joint.graph import GraphError, JointGraph

FloatArray = npt.NDArray[np.float64]

STEP_COVARIANCE = np.diag([0.03, 0.02, np.radians(0.3)]) ** 2
LOOP_COVARIANCE = np.diag([0.02, 0.02, np.radians(0.2)]) ** 2


def vertex(index: int) -> VertexId:
    return VertexId("red", index)


class World:
    """A random walk among vertices with known poses, and edges with honest noise between any two of them."""

    def __init__(self, seed: int, count: int, turn: float = 0.9) -> None:
        self.rng = np.random.default_rng(seed)
        self.truth = [gtsam.Pose2()]
        while len(self.truth) < count:
            step = gtsam.Pose2(*self.rng.uniform([4.0, -1.0, -turn], [8.0, 1.0, turn]))
            self.truth.append(self.truth[-1].compose(step))

    def edge(
        self,
        number: int,
        tail: int,
        head: int,
        kind: EdgeKind = EdgeKind.INTER_VERTEX,
        version: int = 0,
        off: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> Edge:
        covariance = LOOP_COVARIANCE if kind is EdgeKind.LOOP else STEP_COVARIANCE
        noise = gtsam.Pose2.Expmap(self.rng.multivariate_normal(np.zeros(3), covariance))
        measured = self.truth[tail].between(self.truth[head]).compose(noise).compose(gtsam.Pose2(*off))
        return Edge(EdgeId("red", number), version, kind, vertex(tail), vertex(head), measured, covariance)

    def chain(self) -> list[Edge]:
        return [self.edge(i, i, i + 1) for i in range(len(self.truth) - 1)]


def batch_optimum(
    graph: JointGraph, start: dict[VertexId, gtsam.Pose2], solver: str = "MULTIFRONTAL_CHOLESKY"
) -> dict[VertexId, gtsam.Pose2]:
    """Levenberg-Marquardt over the edges the graph says it has, from elsewhere."""
    keys = {v: i for i, v in enumerate(graph.vertices())}
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.push_back(prior_factor(keys[graph.root], gtsam.Pose2()))
    for edge in graph.edges():
        factors.push_back(factor_of(edge, keys[edge.tail], keys[edge.head]))
    for v, key in keys.items():
        values.insert(key, start[v])
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-15)
    params.setAbsoluteErrorTol(1e-15)
    params.setMaxIterations(200)
    params.setLinearSolverType(solver)
    result = gtsam.LevenbergMarquardtOptimizer(factors, values, params).optimize()
    return {v: result.atPose2(key) for v, key in keys.items()}


def distance(a: dict[VertexId, gtsam.Pose2], b: dict[VertexId, gtsam.Pose2]) -> float:
    assert a.keys() == b.keys()
    return max(float(np.abs(gtsam.Pose2.Logmap(a[v].between(b[v]))).max()) for v in a)


def built(edges: Iterable[GraphEdge]) -> JointGraph:
    graph = JointGraph(vertex(0))
    graph.update(add=edges)
    return graph


def dense_covariance(graph: JointGraph) -> np.ndarray:
    """The joint covariance of all vertices by inverting the whole information matrix, kernels off."""
    keys = {v: i for i, v in enumerate(graph.vertices())}
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.push_back(prior_factor(0, gtsam.Pose2()))
    for edge in graph.edges():
        factors.push_back(without_kernel(factor_of(edge, keys[edge.tail], keys[edge.head])))
    for v, pose in graph.estimates().items():
        values.insert(keys[v], pose)
    information, _ = factors.linearize(values).hessian()
    return np.linalg.inv(information)


@pytest.mark.parametrize("seed", range(4))
def test_estimate_is_the_batch_optimum_after_every_change(seed: int) -> None:
    world = World(seed, 25)
    truth = {vertex(i): pose for i, pose in enumerate(world.truth)}
    graph = JointGraph(vertex(0))

    def check() -> None:
        start = {v: truth[v] for v in graph.vertices()}
        assert distance(graph.estimates(), batch_optimum(graph, start)) < 1e-4

    number = 100
    for edge in world.chain():
        graph.update(add=[edge])
        last = edge.head.number
        if last > 3 and world.rng.random() < 0.5:
            back = int(world.rng.integers(0, last - 1))
            graph.update(add=[world.edge(number, last, back, EdgeKind.LOOP)])
            number += 1
        check()
    for edge_id in world.rng.permutation(24)[:6]:
        old = next(e for e in graph.edges() if e.id == EdgeId("red", int(edge_id)))
        kind = EdgeKind.COVARIANCE_INTERSECTION
        graph.update(replace=[world.edge(old.id.number, old.tail.number, old.head.number, kind, version=1)])
        check()
    for loop in [e for e in graph.edges() if e.kind is EdgeKind.LOOP]:
        graph.update(remove=[loop.id])
        check()


def test_one_update_or_many_come_to_the_same() -> None:
    world = World(5, 15)
    edges = [*world.chain(), world.edge(50, 14, 2, EdgeKind.LOOP), world.edge(51, 9, 0, EdgeKind.LOOP)]
    one_by_one = JointGraph(vertex(0))
    for edge in edges:
        one_by_one.update(add=[edge])
    assert distance(built(edges).estimates(), one_by_one.estimates()) < 1e-4
    assert distance(built(reversed(edges)).estimates(), one_by_one.estimates()) < 1e-4


def test_replace_and_remove_leave_no_trace() -> None:
    world = World(6, 12)
    chain, loop = world.chain(), world.edge(50, 11, 1, EdgeKind.LOOP)
    newer = world.edge(4, 4, 5, EdgeKind.COVARIANCE_INTERSECTION, version=3)
    graph = built([*chain, loop])
    graph.update(replace=[newer])
    assert distance(graph.estimates(), built([*chain[:4], newer, *chain[5:], loop]).estimates()) < 1e-4
    graph.update(remove=[loop.id])
    plain = built([*chain[:4], newer, *chain[5:]])
    assert distance(graph.estimates(), plain.estimates()) < 1e-4
    np.testing.assert_allclose(graph.marginal(vertex(11)), plain.marginal(vertex(11)), rtol=1e-3, atol=1e-9)


def test_a_vertex_goes_with_its_edges_and_may_come_back() -> None:
    world = World(7, 8)
    chain = world.chain()
    graph = built(chain)
    graph.update(add=[world.edge(50, 7, 3, EdgeKind.LOOP)])
    graph.update(remove_vertices=[vertex(7)])
    assert graph.vertices() == [vertex(i) for i in range(7)]
    assert [e.id for e in graph.edges()] == [e.id for e in chain[:6]]
    assert distance(graph.estimates(), built(chain[:6]).estimates()) < 1e-6
    graph.update(add=[chain[6]])
    assert distance(graph.estimates(), built(chain).estimates()) < 1e-6


def test_undo_and_redo_in_one_update() -> None:
    """A re-entry undone: vertex and loop go, the new vertex comes, all at once."""
    world = World(8, 8)
    chain = world.chain()
    graph = built([*chain, world.edge(50, 5, 1, EdgeKind.LOOP)])
    again = world.edge(60, 5, 7)
    graph.update(remove=[EdgeId("red", 50)], remove_vertices=[vertex(7)], add=[again])
    assert distance(graph.estimates(), built([*chain[:6], again]).estimates()) < 1e-6


def test_edge_may_point_either_way() -> None:
    world = World(9, 3)
    edges = [world.edge(0, 1, 0), world.edge(1, 2, 1)]
    graph = built(edges)
    expected = graph.estimate(vertex(1)).between(graph.estimate(vertex(0)))
    assert expected.equals(edges[0].measurement, 1e-6)


@pytest.fixture
def looped() -> tuple[World, JointGraph]:
    world = World(11, 10)
    return world, built([*world.chain(), world.edge(50, 9, 4, EdgeKind.LOOP), world.edge(51, 6, 0, EdgeKind.LOOP)])


def test_refusals_name_the_fault_and_change_nothing(looped: tuple[World, JointGraph]) -> None:
    world, graph = looped
    before, edges, vertices = graph.estimates(), graph.edges(), graph.vertices()
    stray = Edge(
        EdgeId("blue", 1),
        0,
        EdgeKind.INTER_VERTEX,
        VertexId("blue", 0),
        VertexId("blue", 1),
        gtsam.Pose2(),
        STEP_COVARIANCE,
    )
    new = world.edge(70, 9, 5, EdgeKind.LOOP)
    faults: list[tuple[dict[str, Any], str]] = [
        ({"add": [new, world.edge(3, 3, 4)]}, r"edge red#3 .* already in the joint graph, at version 0"),
        ({"add": [new, stray]}, r"edge blue#1 .* neither end is connected to root red:0"),
        ({"add": [new], "replace": [world.edge(99, 3, 4, version=1)]}, "edge red#99 is not in"),
        ({"add": [new], "replace": [world.edge(3, 3, 4, version=0)]}, "cannot replace version 0"),
        ({"add": [new], "replace": [world.edge(3, 3, 5, version=1)]}, "joins other vertices"),
        ({"add": [new], "remove": [EdgeId("red", 98)]}, "edge red#98 cannot be removed"),
        ({"add": [new], "remove": [EdgeId("red", 3), EdgeId("red", 51)]}, r"vertices red:4, .*red:9 would be cut off"),
        ({"add": [new], "remove_vertices": [vertex(0)]}, "red:0 is the root"),
        ({"add": [new], "remove_vertices": [vertex(42)]}, "red:42 is not in"),
    ]
    for change, message in faults:
        with pytest.raises(GraphError, match=message):
            graph.update(**change)
        assert graph.edges() == edges
        assert graph.vertices() == vertices
        assert distance(graph.estimates(), before) == 0.0
    for ask in (graph.estimate, graph.marginal):
        with pytest.raises(GraphError, match="red:42 is not in"):
            ask(vertex(42))
    with pytest.raises(GraphError, match="red#98 is not in"):
        graph.chi2(EdgeId("red", 98))
    with pytest.raises(FactorError, match="root red:0: pose is not finite"):
        JointGraph(vertex(0), gtsam.Pose2(np.nan, 0.0, 0.0))
    graph.update(add=[new])
    assert new in graph.edges()


@pytest.mark.parametrize("where", ["update", "come_to_rest"])
@pytest.mark.parametrize("error", [RuntimeError, IndexError, np.linalg.LinAlgError, ZeroDivisionError])
def test_survives_a_solver_that_gives_up(
    looped: tuple[World, JointGraph], monkeypatch: pytest.MonkeyPatch, where: str, error: type[Exception]
) -> None:
    """A fault of the program is not called one of the numbers, but leaves the graph as good."""
    world, graph = looped
    before = graph.estimates()

    def give_up(*_: object) -> None:
        raise error("Indeterminate linear system")

    with monkeypatch.context() as patch:
        patch.setattr(smoother.Smoother, where, give_up)
        expected = ZeroDivisionError if error is ZeroDivisionError else GraphError
        with pytest.raises(expected, match="Indeterminate linear system"):
            graph.update(add=[world.edge(70, 9, 5, EdgeKind.LOOP)])
    assert distance(graph.estimates(), before) < 1e-6
    graph.update(add=[world.edge(70, 9, 5, EdgeKind.LOOP)])
    assert distance(graph.estimates(), batch_optimum(graph, graph.estimates())) < 1e-4


def test_levenberg_marquardt_takes_over_where_gauss_newton_does_not_settle(
    looped: tuple[World, JointGraph], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, graph = looped
    monkeypatch.setattr(smoother, "_MAX_STEPS", 0)
    again = built(graph.edges())
    assert distance(again.estimates(), graph.estimates()) < 1e-4


def test_a_second_step_that_fails_takes_back_the_first(
    looped: tuple[World, JointGraph], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vertex is gone from the solver and a new one in it, when the strained loop's own update gives up."""
    world, graph = looped
    before, edges, plain, calls = graph.estimates(), graph.edges(), smoother.Smoother.update, []

    def give_up_later(solver: smoother.Smoother, *change: Any) -> None:
        calls.append(change)
        if len(calls) > 1:
            raise RuntimeError("Indeterminate linear system")
        plain(solver, *change)

    new = Edge(
        EdgeId("red", 80), 0, EdgeKind.INTER_VERTEX, vertex(8), vertex(20), gtsam.Pose2(3.0, 0.0, 0.0), STEP_COVARIANCE
    )
    strained = world.edge(81, 5, 0, EdgeKind.LOOP, off=(0.12, 0.0, 0.0))
    with monkeypatch.context() as patch:
        patch.setattr(smoother.Smoother, "update", give_up_later)
        with pytest.raises(GraphError, match="cannot be solved with this change"):
            graph.update(remove_vertices=[vertex(9)], add=[new, strained])
    assert len(calls) == 2
    assert graph.edges() == edges
    assert distance(graph.estimates(), before) < 1e-6
    graph.update(remove_vertices=[vertex(9)], add=[new])
    assert distance(graph.estimates(), batch_optimum(graph, graph.estimates())) < 1e-4


def laps(count: int, lap: int) -> tuple[World, list[Edge]]:
    """Rounds of a ring of ``lap`` vertices 5 m apart, with a loop to the round before at every tenth vertex."""
    world = World(17, 1)
    step = gtsam.Pose2(5.0, 0.0, 2.0 * np.pi / lap)
    while len(world.truth) < count:
        world.truth.append(world.truth[-1].compose(step))
    edges = []
    for i in range(1, count):
        edges.append(world.edge(i, i - 1, i))
        if i >= lap and i % 10 == 0:
            edges.append(world.edge(count + i, i, i - lap, EdgeKind.LOOP))
    return world, edges


def test_a_large_graph_stays_within_millimetres_and_ends_at_the_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(smoother, "_LARGE", 200)
    _, edges = laps(400, 100)
    graph, off = JointGraph(vertex(0)), []
    for number, edge in enumerate(edges):
        graph.update(add=[edge])
        if number % 40 == 0 and len(graph.vertices()) > 200:
            off.append(distance(graph.estimates(), batch_optimum(graph, graph.estimates())))
    assert len(off) > 4
    assert max(off) < 0.005
    graph.optimize_fully()
    assert distance(graph.estimates(), batch_optimum(graph, graph.estimates())) < 1e-6


def test_a_large_graph_is_linearised_anew_in_portions(monkeypatch: pytest.MonkeyPatch) -> None:
    """One loop turns most of a long chain: the next updates work that off, without one that takes it all."""
    monkeypatch.setattr(smoother, "_LARGE", 100)
    monkeypatch.setattr(smoother, "_PORTION", 30)
    world, portions, plain = World(7, 220, turn=0.3), [], relinearization.portion

    def remember(*asked: Any) -> Any:
        portions.append(len(plain(*asked)))
        return plain(*asked)

    monkeypatch.setattr(smoother, "portion", remember)
    graph = JointGraph(vertex(0))
    chain = world.chain()
    for edge in chain[:199]:
        graph.update(add=[edge])
    assert not any(portions)
    loop, off = replace(world.edge(500, 199, 5, EdgeKind.LOOP), kind=EdgeKind.INTER_VERTEX), []
    for edge in [loop, *chain[199:]]:
        graph.update(add=[edge])
        off.append(distance(graph.estimates(), batch_optimum(graph, graph.estimates())))
    assert portions.count(30) > 2
    assert max(portions) == 30
    assert portions[-1] == 0
    assert off[-1] < 0.02
    assert off[-1] < 0.5 * off[0]


def test_kernels_that_bite_have_the_weight_of_the_estimate_in_a_large_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """Laps with a loop at every vertex, of which every third is off by five standard deviations."""
    monkeypatch.setattr(smoother, "_LARGE", 100)
    world, edges = laps(240, 40)
    edges = [edge for edge in edges if edge.kind is not EdgeKind.LOOP]
    for i in range(40, 240):
        off = (0.0, 0.1, 0.0) if i % 3 == 0 else (0.0, 0.0, 0.0)
        edges.insert(2 * i - 40, world.edge(1000 + i, i, i - 40, EdgeKind.LOOP, off=off))
    graph = JointGraph(vertex(0))
    for edge in edges:
        graph.update(add=[edge])
    believed = [edge.id for edge in edges if edge.kind is EdgeKind.LOOP and edge.id not in graph.doubted()]
    assert sum(graph.chi2(edge_id) > FULL_WEIGHT[3] for edge_id in believed) > 2
    on_the_way = graph.estimates()
    graph.optimize_fully()
    assert distance(on_the_way, graph.estimates()) < 0.02
    restored = JointGraph.restore(json.loads(json.dumps(graph.checkpoint())))
    assert distance(restored.estimates(), graph.estimates()) < 1e-4


def test_in_a_large_graph_an_edge_that_has_no_kernel_any_more_has_its_full_weight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(smoother, "_LARGE", 100)
    chain = [chain_edge(n, EdgeKind.INTER_VERTEX, n, n + 1, 1.0) for n in range(150)]
    graph = built([*chain[:130], chain_edge(500, EdgeKind.LOOP, 10, 12, 2.0)])
    graph.update(replace=[chain_edge(500, EdgeKind.COVARIANCE_INTERSECTION, 10, 12, 2.0, 1.0, version=1)])
    for edge in chain[130:]:
        graph.update(add=[edge])
    on_the_way = graph.estimates()
    graph.optimize_fully()
    assert distance(on_the_way, graph.estimates()) < 0.02


def chain_edge(number: int, kind: EdgeKind, tail: int, head: int, x: float, y: float = 0.0, version: int = 0) -> Edge:
    """Straight on, or ``y`` to the left."""
    covariance = np.diag([0.01, 0.01, 0.001])
    ends = vertex(tail), vertex(head)
    return Edge(EdgeId("red", number), version, kind, *ends, gtsam.Pose2(x, y, 0.0), covariance)


@pytest.mark.parametrize("first", [10, 11])
def test_doubted_edges_hold_a_chain_of_vertices_that_have_nothing_else(first: int) -> None:
    """In whatever order they came to be doubted: one holds the vertex by which the other does."""
    graph = built([chain_edge(n, EdgeKind.INTER_VERTEX, n, n + 1, 1.0) for n in range(3)])
    doubted = {
        10: chain_edge(10, EdgeKind.FUSING, 2, 3, 1.0, 8.0),
        11: chain_edge(11, EdgeKind.FUSING, 0, 2, 2.0, 8.0),
    }
    for number in (first, 21 - first):
        graph.update(add=[doubted[number]])
    assert len(graph.doubted()) == 2
    graph.update(remove=[EdgeId("red", 1), EdgeId("red", 2)])
    assert graph.doubted() == frozenset()
    assert graph.estimate(vertex(3)).equals(gtsam.Pose2(3.0, 16.0, 0.0), 1e-6)


@pytest.mark.parametrize("most", [20, 1000])  # variables that are solved to the last digit
def test_where_cholesky_gives_up_qr_goes_on(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """With a vertex removed, one replaced and a loop in the same update."""
    monkeypatch.setattr(smoother, "_LARGE", most)
    world = World(18, 30)
    graph = built([*world.chain(), world.edge(50, 29, 2, EdgeKind.LOOP)])
    wide = np.diag([4.0, 1e-9, 1e-10])
    tight = [replace(world.edge(60 + i, 25, 10 + i), covariance=wide) for i in range(3)]
    change: dict[str, Any] = {
        "remove_vertices": [vertex(29)],
        "replace": [world.edge(4, 4, 5, EdgeKind.COVARIANCE_INTERSECTION, version=1)],
        "add": [*tight, world.edge(70, 28, 2, EdgeKind.LOOP)],
    }
    asked: list[str] = []
    plain = smoother._parameters

    def remember(tolerance: smoother._Tolerance, factorization: str) -> gtsam.ISAM2Params:
        asked.append(factorization)
        return plain(tolerance, factorization)

    monkeypatch.setattr(smoother, "_parameters", remember)
    graph.update(**change)
    assert "QR" in asked
    assert len(graph.vertices()) == 29
    assert distance(graph.estimates(), batch_optimum(graph, graph.estimates(), "MULTIFRONTAL_QR")) < 1e-3


def test_solves_covariances_of_very_different_size() -> None:
    """Corridors: millimetres across, metres along. GTSAM's Cholesky calls such graphs indeterminate."""
    world = World(12, 30)
    covariance = np.diag([4.0, 1e-6, 1e-8])
    edges = []
    for edge in [*world.chain(), world.edge(50, 29, 0), world.edge(51, 15, 3)]:
        edges.append(Edge(edge.id, 0, edge.kind, edge.tail, edge.head, edge.measurement, covariance))
    graph = JointGraph(vertex(0))
    for edge in edges:
        graph.update(add=[edge])
    assert np.all(np.isfinite(graph.marginal(vertex(20))))
    far = world.edge(52, 25, 8)
    residual, by = far.residual(graph.estimate(far.tail).between(graph.estimate(far.head)))
    around = far.covariance + by @ graph.relative(far.tail, far.head).covariance @ by.T
    assert graph.innovation(far) == pytest.approx(float(residual @ np.linalg.solve(around, residual)), rel=0.01)


def test_marginal_is_that_of_the_dense_inverse(looped: tuple[World, JointGraph]) -> None:
    _, graph = looped
    dense = dense_covariance(graph)
    for i in range(10):
        block = dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        np.testing.assert_allclose(graph.marginal(vertex(i)), block, rtol=1e-3, atol=1e-10)


def test_relative_is_that_of_the_dense_inverse(looped: tuple[World, JointGraph]) -> None:
    _, graph = looped
    dense = dense_covariance(graph)
    for a, b in ((0, 9), (9, 0), (3, 7), (8, 2), (5, 5)):
        pose, covariance = graph.relative(vertex(a), vertex(b))
        assert pose.equals(graph.estimate(vertex(a)).between(graph.estimate(vertex(b))), 1e-9)
        # a Exp(x), b Exp(y): a_T_b Exp(-Ad(b_T_a) x + y) to first order.
        by = np.zeros((3, dense.shape[0]))
        by[:, 3 * a : 3 * a + 3] -= pose.inverse().AdjointMap()
        by[:, 3 * b : 3 * b + 3] += np.eye(3)
        np.testing.assert_allclose(covariance, by @ dense @ by.T, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("pairs", [1, 2])
def test_where_cholesky_gives_up_in_a_question_qr_answers_it(
    looped: tuple[World, JointGraph], monkeypatch: pytest.MonkeyPatch, pairs: int
) -> None:
    _, graph = looped
    asked = [(vertex(i), vertex(i + 3)) for i in range(pairs)]
    before, name = graph.relatives(asked), "_relative_covariance" if pairs == 1 else "_roots"
    plain = getattr(smoother.Smoother, name)

    def give_up(solver: smoother.Smoother, *question: Any) -> Any:
        if solver._factorization == "CHOLESKY":
            raise RuntimeError("Indeterminate linear system")
        return plain(solver, *question)

    monkeypatch.setattr(smoother.Smoother, name, give_up)
    for one, other in zip(graph.relatives(asked), before, strict=True):
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-3, atol=1e-9)


def test_relative_along_a_chain_is_the_composition() -> None:
    world = World(13, 6)
    chain = world.chain()
    graph = built(chain)
    along = chain[2].estimate
    for edge in chain[3:]:
        along = compose(along, edge.estimate)
    for expected, found in (
        (along, graph.relative(vertex(2), vertex(5))),
        (inverse(along), graph.relative(vertex(5), vertex(2))),
    ):
        assert found.pose.equals(expected.pose, 1e-6)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-4, atol=1e-9)


def test_relative_follows_an_update(looped: tuple[World, JointGraph]) -> None:
    world, graph = looped
    before = graph.relative(vertex(1), vertex(8)).covariance
    graph.update(add=[world.edge(70, 1, 8, EdgeKind.LOOP)])
    after = graph.relative(vertex(1), vertex(8)).covariance
    assert np.linalg.det(after) < 0.5 * np.linalg.det(before)


def test_innovation_is_chi2_over_honest_worlds() -> None:
    """Over many worlds the innovation of a true loop has mean 3: the joint covariance is honest, in the right frame."""
    values = []
    for seed in range(300):
        world = World(1000 + seed, 8)
        values.append(built(world.chain()).innovation(world.edge(50, 7, 1, EdgeKind.LOOP)))
    assert np.mean(values) == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / 300.0))


def test_innovation_far_off_in_heading_is_closed_form(looped: tuple[World, JointGraph]) -> None:
    world, graph = looped
    edge = world.edge(70, 8, 1, EdgeKind.LOOP, off=(1.0, -2.0, 1.2))
    pose, covariance = graph.relative(edge.tail, edge.head)

    def residual(xi: FloatArray) -> FloatArray:
        return gtsam.Pose2.Logmap(edge.measurement.between(pose.compose(gtsam.Pose2.Expmap(xi))))

    by = np.column_stack([(residual(1e-6 * x) - residual(-1e-6 * x)) / 2e-6 for x in np.eye(3)])
    away = residual(np.zeros(3))
    expected = away @ np.linalg.solve(edge.covariance + by @ covariance @ by.T, away)
    assert graph.innovation(edge) == pytest.approx(float(expected), rel=1e-3)


def test_chi2_is_the_squared_whitened_residual(looped: tuple[World, JointGraph]) -> None:
    _, graph = looped
    for edge in graph.edges():
        found = graph.estimate(edge.tail).between(graph.estimate(edge.head))
        assert edge.estimate is not None
        residual = gtsam.Pose2.Logmap(edge.estimate.pose.between(found))
        expected = residual @ np.linalg.solve(edge.covariance, residual)
        assert graph.chi2(edge.id) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def ring(count: int, rng: np.random.Generator) -> list[gtsam.Pose2]:
    """True poses on a circle of steps of 8 m, back where it began."""
    poses = [gtsam.Pose2()]
    for _ in range(count - 1):
        poses.append(poses[-1].compose(gtsam.Pose2(8.0, 0.0, 2.0 * np.pi / count)))
    return poses


@pytest.mark.parametrize("seed", range(5))
def test_true_loop_after_a_long_drift_is_kept(seed: int) -> None:
    world = World(seed, 1)
    world.truth = ring(60, world.rng)
    graph = built(world.chain())
    loop = world.edge(100, 59, 0, EdgeKind.LOOP)
    drift = gtsam.Pose2.Logmap(loop.measurement.between(graph.relative(loop.tail, loop.head).pose))
    residual = float(drift @ np.linalg.solve(loop.covariance, drift))
    assert residual > 100.0  # far outside the kernel
    graph.update(add=[loop])
    assert graph.chi2(loop.id) < 1.0


@pytest.mark.parametrize("seed", range(5))
def test_false_loop_does_not_bend_the_map(seed: int) -> None:
    world = World(seed, 1)
    world.truth = ring(20, world.rng)
    graph = built([*world.chain(), world.edge(100, 19, 0, EdgeKind.LOOP), world.edge(101, 10, 0, EdgeKind.LOOP)])
    before = graph.estimates()
    false = world.edge(102, 15, 3, EdgeKind.LOOP, off=(3.0, -1.0, 0.3))
    assert graph.innovation(false) > 100.0
    graph.update(add=[false])
    assert distance(graph.estimates(), before) < 0.01
    assert graph.chi2(false.id) > 1000.0
    graph.update(remove=[false.id])
    assert distance(graph.estimates(), before) < 1e-4


def test_a_loop_may_be_the_only_hold_of_a_vertex() -> None:
    world = World(14, 4)
    graph = built(world.chain())
    graph.update(replace=[world.edge(2, 2, 3, EdgeKind.LOOP, version=1)])
    graph.update(replace=[world.edge(1, 1, 2, EdgeKind.LOOP, 1), world.edge(2, 2, 3, EdgeKind.LOOP, 2)])
    assert distance(graph.estimates(), batch_optimum(graph, graph.estimates())) < 1e-4
    with pytest.raises(GraphError, match="vertices red:3 would be cut off"):
        graph.update(remove=[EdgeId("red", 2)])


def test_two_loops_that_hold_a_vertex_together_are_replaced_at_once() -> None:
    """Either could wait for the other; both out at the same time would lose the vertex."""
    world = World(16, 5)
    holds = [world.edge(50, 0, 4, EdgeKind.LOOP), world.edge(51, 2, 4, EdgeKind.LOOP)]
    graph = built([*world.chain()[:3], *holds])
    newer = [world.edge(50, 0, 4, EdgeKind.LOOP, version=1), world.edge(51, 2, 4, EdgeKind.LOOP, version=1)]
    graph.update(replace=newer)
    assert distance(graph.estimates(), built(graph.edges()).estimates()) < 1e-4


def test_checkpoint_goes_through_json_and_goes_on(looped: tuple[World, JointGraph]) -> None:
    world, graph = looped
    back = JointGraph.restore(json.loads(json.dumps(graph.checkpoint())))
    assert back.root == graph.root
    assert back.vertices() == graph.vertices()
    assert [str(e) for e in back.edges()] == [str(e) for e in graph.edges()]
    assert distance(back.estimates(), graph.estimates()) < 1e-5
    change = world.edge(70, 9, 5, EdgeKind.LOOP)
    for one in (graph, back):
        one.update(add=[change], remove=[EdgeId("red", 50)])
    assert distance(back.estimates(), graph.estimates()) < 1e-5
    np.testing.assert_allclose(back.marginal(vertex(9)), graph.marginal(vertex(9)), rtol=1e-3, atol=1e-10)


def test_restore_refuses_what_is_no_checkpoint(looped: tuple[World, JointGraph]) -> None:
    data = looped[1].checkpoint()
    with pytest.raises(GraphError, match="not a checkpoint"):
        JointGraph.restore({"root": [0.0, 0.0, 0.0]})
    with pytest.raises(GraphError, match="cut off"):
        JointGraph.restore(data | {"edges": data["edges"][:3]})
    with pytest.raises(GraphError, match="red:9 is not in"):
        JointGraph.restore(data | {"vertices": data["vertices"][:-1]})


def test_optimize_fully_stays_at_the_optimum(looped: tuple[World, JointGraph]) -> None:
    world, graph = looped
    before = graph.estimates()
    graph.optimize_fully()
    assert distance(graph.estimates(), before) < 1e-4
    graph.update(add=[world.edge(70, 9, 5, EdgeKind.LOOP)])
    assert distance(graph.estimates(), batch_optimum(graph, graph.estimates())) < 1e-4


def test_root_may_stand_anywhere() -> None:
    world = World(15, 4)
    pose = gtsam.Pose2(10.0, -5.0, 2.0)
    graph = JointGraph(vertex(0), pose)
    graph.update(add=world.chain())
    assert graph.estimate(vertex(0)).equals(pose, 1e-9)
    assert JointGraph.restore(graph.checkpoint()).estimate(vertex(3)).equals(graph.estimate(vertex(3)), 1e-9)


def test_closed_square_is_a_square() -> None:
    side, covariance = gtsam.Pose2(5.0, 0.0, np.pi / 2), np.eye(3) * 1e-2
    edges = [
        Edge(EdgeId("red", i), 0, EdgeKind.INTER_VERTEX, vertex(i), vertex((i + 1) % 4), side, covariance)
        for i in range(4)
    ]
    graph = built(edges)
    assert graph.estimate(vertex(2)).equals(gtsam.Pose2(5.0, 5.0, np.pi), 1e-6)
    assert sum(graph.chi2(edge.id) for edge in edges) == pytest.approx(0.0, abs=1e-9)


def other_vertex(index: int) -> VertexId:
    return VertexId("blue", index)


def blue_world(count: int) -> tuple[World, list[Edge], gtsam.Pose2]:
    """Another robot's world, its chain with a loop, and where its origin is in red's frame."""
    world = World(40, count)
    edges = [*world.chain(), world.edge(900, count - 1, 1, EdgeKind.LOOP)]
    renamed = [
        Edge(
            EdgeId("blue", e.id.number),
            0,
            e.kind,
            other_vertex(e.tail.number),
            other_vertex(e.head.number),
            e.measurement,
            e.covariance,
        )
        for e in edges
    ]
    return world, renamed, gtsam.Pose2(12.0, -7.0, 2.5)


def fusing(number: int, red: World, blue: World, offset: gtsam.Pose2, i: int, j: int, off: float = 0.0) -> Edge:
    """A fusing edge from red's vertex ``i`` to blue's ``j``, wrong by ``off`` metres and a tenth of it in radians."""
    noise = gtsam.Pose2.Expmap(red.rng.multivariate_normal(np.zeros(3), LOOP_COVARIANCE))
    measured = (
        red.truth[i].between(offset.compose(blue.truth[j])).compose(noise).compose(gtsam.Pose2(off, 0, 0.1 * off))
    )
    return Edge(EdgeId("meeting", number), 0, EdgeKind.FUSING, vertex(i), other_vertex(j), measured, LOOP_COVARIANCE)


def sighting(
    number: int, red: World, blue: World, offset: gtsam.Pose2, i: int, j: int, off: float = 0.0
) -> SightingEdge:
    """Red at its vertex ``i`` sees blue, 2 m from the origin of blue's vertex ``j``; the range is wrong by ``off``."""
    observed = UncertainPose(gtsam.Pose2(2.0, 1.0, -1.0), np.diag([0.01, 0.01, 0.01]) ** 2)
    observer = UncertainPose(gtsam.Pose2(-1.0, 0.5, 2.0), np.diag([0.01, 0.02, 0.01]) ** 2)
    seen = red.truth[i].compose(observer.pose).between(offset.compose(blue.truth[j]).compose(observed.pose))
    r, b = red.rng.normal([np.hypot(seen.x(), seen.y()) + off, np.arctan2(seen.y(), seen.x())], [0.05, 0.005])
    measured = Sighting(r, b, None, 0.05, 0.005, None)
    anchored = AnchoredSighting(measured, vertex(i), other_vertex(j), observer, observed)
    return SightingEdge(EdgeId("seen", number), 0, anchored)


@pytest.fixture
def met() -> tuple[World, World, gtsam.Pose2, JointGraph, JointGraph]:
    red, (blue, edges, offset) = World(41, 12), blue_world(10)
    theirs = JointGraph(other_vertex(0))
    theirs.update(add=edges)
    return red, blue, offset, built([*red.chain(), red.edge(50, 11, 2, EdgeKind.LOOP)]), theirs


Met = tuple[World, World, gtsam.Pose2, JointGraph, JointGraph]


@pytest.mark.parametrize("swapped", [False, True])
def test_merged_components_are_the_batch_optimum(met: Met, swapped: bool) -> None:
    red, blue, offset, ours, theirs = met
    bridge, more = fusing(0, red, blue, offset, 3, 4), fusing(1, red, blue, offset, 9, 7)
    first, second = (theirs, ours) if swapped else (ours, theirs)
    edges: list[GraphEdge] = [more, sighting(0, red, blue, offset, 5, 2)]
    expected = {*first.edges(), *second.edges(), bridge, *edges}
    first.merge(second, bridge, edges)
    assert set(first.edges()) == expected
    assert distance(first.estimates(), batch_optimum(first, first.estimates())) < 1e-4
    found = first.relative(vertex(11), other_vertex(9))
    truth = red.truth[11].between(offset.compose(blue.truth[9]))
    error = gtsam.Pose2.Logmap(found.pose.between(truth))
    assert error @ np.linalg.solve(found.covariance, error) < 20.0


def test_merging_is_the_same_as_adding_everything(met: Met) -> None:
    red, blue, offset, ours, theirs = met
    bridge = fusing(0, red, blue, offset, 3, 4)
    together = built([*ours.edges(), bridge, *theirs.edges()])
    ours.merge(theirs, bridge)
    assert distance(ours.estimates(), together.estimates()) < 1e-4
    for v in theirs.vertices():  # one bridge bends neither side
        inside = theirs.relative(other_vertex(0), v)
        assert ours.relative(other_vertex(0), v).pose.equals(inside.pose, 1e-4)
    back = JointGraph.restore(json.loads(json.dumps(ours.checkpoint())))
    assert distance(back.estimates(), ours.estimates()) < 1e-5


def test_a_merge_that_fails_changes_nothing(met: Met, monkeypatch: pytest.MonkeyPatch) -> None:
    red, blue, offset, ours, theirs = met
    bridge, seen = fusing(0, red, blue, offset, 3, 4), sighting(0, red, blue, offset, 5, 2)
    before, edges = ours.estimates(), ours.edges()
    stray = fusing(1, red, World(3, 30), offset, 3, 25)
    unheld = sighting(1, red, World(3, 30), offset, 3, 25)
    faults: list[tuple[JointGraph, GraphEdge, list[GraphEdge], str]] = [
        (theirs, seen, [], "seen#0 .* cannot join the component of blue:0 to that of red:0"),
        (theirs, stray, [], "cannot join"),
        (theirs, ours.edges()[0], [], "cannot join"),
        (ours, bridge, [], "red#0 is in both"),
        (theirs, bridge, [bridge], "meeting#0 .* already in the joint graph"),
        (theirs, bridge, [unheld], r"seen#1 .* its ends are not both connected to root red:0"),
    ]
    for other, joining, more, message in faults:
        with pytest.raises(GraphError, match=message):
            ours.merge(other, joining, more)
        assert ours.edges() == edges
        assert distance(ours.estimates(), before) == 0.0

    def give_up(*_: object) -> None:
        raise RuntimeError("Indeterminate linear system")

    with monkeypatch.context() as patch:
        patch.setattr(smoother.Smoother, "update", give_up)
        with pytest.raises(GraphError, match="cannot be solved with this change"):
            ours.merge(theirs, bridge)
    assert distance(ours.estimates(), before) < 1e-6
    ours.merge(theirs, bridge, [seen])
    assert distance(ours.estimates(), batch_optimum(ours, ours.estimates())) < 1e-4


def test_a_false_fusing_edge_neither_bends_nor_holds(met: Met) -> None:
    red, blue, offset, ours, theirs = met
    good = [fusing(i, red, blue, offset, a, b) for i, (a, b) in enumerate([(3, 4), (9, 7), (6, 2)])]
    ours.merge(theirs, good[0], good[1:])
    before = ours.estimates()
    false, far = fusing(7, red, blue, offset, 8, 3, off=3.0), sighting(7, red, blue, offset, 8, 3, off=3.0)
    ours.update(add=[false, far])
    assert distance(ours.estimates(), before) < 0.01
    assert ours.chi2(false.id) > 100.0
    assert ours.chi2(far.id) > 100.0
    ours.update(remove=[false.id, far.id, good[0].id])
    for edge in good[1:]:
        assert ours.chi2(edge.id) < 20.0
    ours.update(remove=[good[1].id])
    with pytest.raises(GraphError, match=r"vertices blue:0, .* would be cut off from root red:0"):
        ours.update(remove=[good[2].id])


def test_sightings_hold_no_vertex_but_pull(met: Met) -> None:
    """Three ranges and bearings make a poor bridge good, and are what they are, two numbers each."""
    red, blue, offset, ours, theirs = met
    bridge = fusing(0, red, blue, offset, 3, 4)
    loose = Edge(bridge.id, 0, bridge.kind, bridge.tail, bridge.head, bridge.measurement, np.diag([1.0, 1.0, 0.1]))
    seen = [sighting(i, red, blue, offset, a, b) for i, (a, b) in enumerate([(3, 4), (9, 7), (6, 2)])]
    with pytest.raises(GraphError, match="its ends are not both connected"):
        ours.update(add=[seen[0]])
    ours.merge(theirs, loose)
    wide = np.linalg.det(ours.relative(vertex(9), other_vertex(7)).covariance)
    assert ours.innovation(seen[0]) < 13.8
    for edge in seen:
        ours.update(add=[edge])
        assert distance(ours.estimates(), batch_optimum(ours, ours.estimates())) < 1e-4
        error, _ = edge.residual(ours.estimate(edge.tail).between(ours.estimate(edge.head)))
        assert ours.chi2(edge.id) == pytest.approx(error @ np.linalg.solve(edge.covariance, error), rel=1e-9)
    assert np.linalg.det(ours.relative(vertex(9), other_vertex(7)).covariance) < 1e-3 * wide
    with pytest.raises(GraphError, match="would be cut off"):
        ours.update(remove=[loose.id])


def test_innovation_of_sightings_is_chi2_over_honest_worlds() -> None:
    values = []
    for seed in range(200):
        red, (blue, edges, offset) = World(2000 + seed, 6), blue_world(5)
        red.rng = np.random.default_rng(seed)
        joint, theirs = built(red.chain()), JointGraph(other_vertex(0))
        theirs.update(add=edges)
        joint.merge(theirs, fusing(0, red, blue, offset, 3, 2))
        values.append(joint.innovation(sighting(0, red, blue, offset, 5, 2)))
    # Sensor and the fusing edge's noise; the anchors are exact here, and blue's noise is the same each time.
    assert 1.2 < np.mean(values) < 2.4


def test_checkpoint_keeps_sightings(met: Met) -> None:
    red, blue, offset, ours, theirs = met
    ours.merge(theirs, fusing(0, red, blue, offset, 3, 4), [sighting(0, red, blue, offset, 5, 2)])
    back = JointGraph.restore(json.loads(json.dumps(ours.checkpoint())))
    assert [str(e) for e in back.edges()] == [str(e) for e in ours.edges()]
    assert back.chi2(EdgeId("seen", 0)) == pytest.approx(ours.chi2(EdgeId("seen", 0)), abs=1e-4)
    assert distance(back.estimates(), ours.estimates()) < 1e-5
