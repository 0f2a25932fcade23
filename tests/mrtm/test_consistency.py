import itertools
import random
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factors import UncertainPose, VertexId, compose, inverse
from mrtm.joint.alignment.agreement import Decision
from mrtm.joint.graph import GraphError, JointGraph
from mrtm.joint.sightings.common_frame import examine, exp, solve
from mrtm.joint.sightings.consistency import SLACKS, Consistency, Verdict, judge
from mrtm.joint.sightings.hypotheses import Hypothesis, HypothesisId, Measurements, OwnMap, RobotGraph, Slack
from mrtm.joint.sightings.innovation import votes
from tests.mrtm.sighting_world import TeamWorld, without_heading


def verdicts(result: Consistency, verdict: Verdict) -> set[HypothesisId]:
    return {key for key, judgement in result.judgements.items() if judgement.verdict is verdict}


def judged(world: TeamWorld) -> Consistency:
    return judge(world.hypotheses, world.graphs)


def error(world: TeamWorld, result: Consistency, a: str, b: str) -> float:
    """Squared Mahalanobis distance of an offset from the truth."""
    offset = result.offsets[a, b]
    off = gtsam.Pose2.Logmap(offset.pose.between(world.offset(a, b)))
    return float(off @ np.linalg.solve(offset.covariance, off))


@pytest.mark.parametrize("robots", [2, 3, 5])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_random_false_sightings_are_refused_and_true_ones_accepted(robots: int, share: float) -> None:
    found = true = wrong = false = 0
    errors = []
    for seed in range(6):
        world = TeamWorld(seed, robots)
        for a, b in itertools.combinations(world.names, 2):
            world.sight(a, b, 30, share)
        result = judged(world)
        accepted = verdicts(result, Verdict.ACCEPTED)
        found, true = found + len(accepted & world.true), true + len(world.true)
        wrong, false = wrong + len(accepted - world.true), false + len(world.hypotheses) - len(world.true)
        assert len(result.offsets) == robots * (robots - 1) // 2
        errors += [error(world, result, a, b) for a, b in result.offsets]
    assert found > 0.97 * true
    assert wrong <= 0.001 * false
    assert max(errors) < 25.0  # no wrong merge


def test_the_covariance_of_an_offset_is_honest() -> None:
    errors = []
    for seed in range(80):
        world = TeamWorld(seed, 2)
        world.sight("r0", "r1", 10)
        errors.append(error(world, judged(world), "r0", "r1"))
    assert 0.75 < np.mean(errors) / 3.0 < 1.3


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_sightings_without_headings(share: float) -> None:
    found = true = 0
    for seed in range(5):
        world = TeamWorld(seed, 2, headings=False)
        world.sight("r0", "r1", 60, share)
        result = judged(world)
        accepted = verdicts(result, Verdict.ACCEPTED)
        found, true = found + len(accepted & world.true), true + len(world.true)
        assert accepted <= world.true
        assert error(world, result, "r0", "r1") < 25.0
    assert found > 0.97 * true


def test_headings_of_some_are_enough() -> None:
    world = TeamWorld(3, 2)
    world.sight("r0", "r1", 30, 0.3)
    mixed = [without_heading(h) if k % 3 else h for k, h in enumerate(world.hypotheses)]
    accepted = verdicts(judge(mixed, world.graphs), Verdict.ACCEPTED)
    assert accepted <= world.true
    assert len(accepted) >= len(world.true) - 1


@given(seed=st.integers(0, 10**6), count=st.integers(1, 40))
@settings(max_examples=60)
def test_false_sightings_alone_never_merge(seed: int, count: int) -> None:
    world = TeamWorld(seed, 2)
    world.sight("r0", "r1", count, false=1.0)
    result = judged(world)
    assert result.components == ()
    assert verdicts(result, Verdict.WAITING) == result.judgements.keys()


def test_a_cluster_of_three_false_ones_waits_and_ten_true_ones_refuse_it() -> None:
    world = TeamWorld(1, 2)
    world.cluster("r0", "r1", 3)
    before = judged(world)
    assert {j.verdict for j in before.judgements.values()} == {Verdict.WAITING}
    assert {j.support for j in before.judgements.values()} == {3}
    assert "at least 4" in next(iter(before.judgements.values())).reason

    cluster = set(before.judgements)
    world.sight("r0", "r1", 10)
    after = judged(world)
    assert verdicts(after, Verdict.REFUSED) >= cluster
    assert len(verdicts(after, Verdict.ACCEPTED)) >= 9


def test_four_are_accepted_and_taken_back_when_more_contradict_them() -> None:
    world = TeamWorld(2, 2)
    world.cluster("r0", "r1", 4)
    believed = verdicts(judged(world), Verdict.ACCEPTED)
    assert len(believed) == 4  # nothing tells four that agree from the truth

    world.sight("r0", "r1", 5)
    torn = judged(world)
    assert torn.components == ()
    assert any("others agree on something else" in j.reason for j in torn.judgements.values())

    world.sight("r0", "r1", 7)
    mended = judged(world)
    assert verdicts(mended, Verdict.REFUSED) >= believed
    assert error(world, mended, "r0", "r1") < 25.0


def test_one_true_sighting_is_enough_where_a_third_robot_joins_both() -> None:
    accepted = refused = 0
    for seed in range(8):
        world = TeamWorld(seed, 3)
        world.sight("r0", "r1", 12)
        world.sight("r1", "r2", 12)
        world.sight("r0", "r2", 1)
        true = world.hypotheses[-1].id
        world.sight("r0", "r2", 1, false=1.0)
        false = world.hypotheses[-1].id
        result = judged(world)
        accepted += result.judgements[true].verdict is Verdict.ACCEPTED
        refused += result.judgements[false].verdict is Verdict.REFUSED
        assert result.judgements[false].verdict is not Verdict.ACCEPTED
    assert accepted >= 7
    assert refused >= 7


def test_of_a_cycle_that_does_not_close_the_weakest_pair_is_refused() -> None:
    world = TeamWorld(5, 3)
    world.sight("r0", "r1", 12)
    world.sight("r1", "r2", 12)
    world.cluster("r0", "r2", 4)
    result = judged(world)
    assert verdicts(result, Verdict.REFUSED) >= {h.id for h in world.hypotheses[24:]}
    assert result.components == (("r0", "r1", "r2"),)
    assert ("r0", "r2") not in result.offsets


def test_of_a_cycle_that_does_not_close_a_pair_about_as_strong_waits() -> None:
    world = TeamWorld(6, 3)
    world.sight("r0", "r1", 9)
    world.sight("r1", "r2", 9)
    world.cluster("r0", "r2", 6)
    result = judged(world)
    judgements = [result.judgements[h.id] for h in world.hypotheses[18:]]
    assert {j.verdict for j in judgements} == {Verdict.WAITING}
    assert all("way between them through other robots" in j.reason for j in judgements)


@given(seed=st.integers(0, 1000), order=st.randoms(use_true_random=False))
@settings(max_examples=15)
def test_the_outcome_does_not_depend_on_the_order(seed: int, order: random.Random) -> None:
    world = TeamWorld(seed, 3)
    for a, b in itertools.combinations(world.names, 2):
        world.sight(a, b, 12, 0.4)
    shuffled = list(world.hypotheses)
    order.shuffle(shuffled)
    robots = list(world.names)
    order.shuffle(robots)
    straight, other = judged(world), judge(shuffled, {name: world.graphs[name] for name in robots})
    assert list(straight.judgements.items()) == list(other.judgements.items())
    assert straight.components == other.components
    for pair, offset in straight.offsets.items():
        assert offset.pose.equals(other.offsets[pair].pose, 0.0)
        assert np.array_equal(offset.covariance, other.offsets[pair].covariance)


def test_robots_that_share_no_sightings_stay_apart() -> None:
    world = TeamWorld(4, 4)
    world.sight("r0", "r1", 8)
    world.sight("r2", "r3", 8)
    result = judged(world)
    assert result.components == (("r0", "r1"), ("r2", "r3"))
    assert result.offsets.keys() == {("r0", "r1"), ("r2", "r3")}


def test_noise_that_was_understated_is_noticed() -> None:
    """As sightings between clocks that differ by a few tenths of a second have it."""
    world = TeamWorld(7, 2)
    world.sight("r0", "r1", 60)
    rng = np.random.default_rng(7)
    scattered = [
        replace(
            h,
            tail_T_observer=UncertainPose(
                h.tail_T_observer.pose.compose(gtsam.Pose2(*rng.normal(0.0, [0.08, 0.08, 0.08]))),
                h.tail_T_observer.covariance,
            ),
        )
        for h in world.hypotheses
    ]
    assert judged(world).slack == Slack(0.0, 0.0)
    result = judge(scattered, world.graphs)
    assert result.slack in SLACKS[1:]
    assert len(verdicts(result, Verdict.ACCEPTED)) > 0.9 * len(scattered)


class TestEvidence:
    """What local maps add, with a made-up word of theirs."""

    @staticmethod
    def right(world: TeamWorld, tail: VertexId, head: VertexId, seen: UncertainPose) -> bool:
        off = gtsam.Pose2.Logmap(seen.pose.between(world.truth[tail].between(world.truth[head])))
        return bool(np.hypot(off[0], off[1]) < 1.5 and abs(off[2]) < 0.5)

    def test_they_lift_a_single_sighting(self) -> None:
        world = TeamWorld(8, 2)
        world.sight("r0", "r1", 1)
        world.sight("r0", "r1", 2, false=1.0)

        def word(tail: VertexId, head: VertexId, seen: UncertainPose, veto: bool) -> Decision:
            return Decision.AGREES if self.right(world, tail, head, seen) else Decision.UNDECIDED

        result = judge(world.hypotheses, world.graphs, word)
        assert verdicts(result, Verdict.ACCEPTED) == world.true
        assert "local maps agree" in result.judgements[world.hypotheses[0].id].reason

    def test_they_lift_nothing_where_they_agree_with_two_offsets(self) -> None:
        world = TeamWorld(8, 2)
        world.sight("r0", "r1", 1)
        world.sight("r0", "r1", 2, false=1.0)
        result = judge(world.hypotheses, world.graphs, lambda *_: Decision.AGREES)
        assert result.components == ()

    def test_they_veto_a_large_set_and_the_next_is_taken(self) -> None:
        world = TeamWorld(9, 2)
        world.cluster("r0", "r1", 12)
        world.sight("r0", "r1", 5)

        def word(tail: VertexId, head: VertexId, seen: UncertainPose, veto: bool) -> Decision:
            return Decision.UNDECIDED if self.right(world, tail, head, seen) else Decision.CONTRADICTS

        assert verdicts(judged(world), Verdict.ACCEPTED) & world.true == set()
        result = judge(world.hypotheses, world.graphs, word)
        assert verdicts(result, Verdict.ACCEPTED) == world.true

    def test_a_vetoed_set_alone_is_refused(self) -> None:
        world = TeamWorld(9, 2)
        world.cluster("r0", "r1", 6)
        result = judge(world.hypotheses, world.graphs, lambda *_: Decision.CONTRADICTS)
        assert result.components == ()
        assert {j.verdict for j in result.judgements.values()} == {Verdict.REFUSED}
        assert all("contradict" in j.reason for j in result.judgements.values())


class TestInputs:
    def test_nothing(self) -> None:
        result = judge([], {})
        assert (result.judgements, result.offsets, result.components) == ({}, {}, ())

    def test_a_robot_without_a_map_is_waited_for(self) -> None:
        world = TeamWorld(0, 3)
        world.sight("r0", "r1", 6)
        world.sight("r1", "r2", 6)
        known: dict[str, RobotGraph] = {name: world.graphs[name] for name in ("r0", "r1")}
        result = judge(world.hypotheses, known)
        waiting = {h.id for h in world.hypotheses if "r2" in h.robots}
        assert verdicts(result, Verdict.WAITING) == waiting
        assert all("map of r2" in result.judgements[key].reason for key in waiting)

    def test_two_of_one_id_are_refused(self) -> None:
        world = TeamWorld(0, 2)
        world.sight("r0", "r1", 1)
        with pytest.raises(ValueError, match="is there twice"):
            judge(world.hypotheses * 2, world.graphs)

    def test_a_robot_cannot_sight_itself(self) -> None:
        world = TeamWorld(0, 2)
        world.sight("r0", "r1", 1)
        one = world.hypotheses[0]
        with pytest.raises(ValueError, match="cannot sight itself"):
            replace(one, observed=VertexId(one.observer.robot, 3))

    def test_a_vertex_the_graph_lacks_is_named(self) -> None:
        world = TeamWorld(0, 2)
        world.sight("r0", "r1", 1)
        lacking: dict[str, RobotGraph] = {"r0": world.graphs["r0"], "r1": JointGraph(VertexId("r1", 0))}
        strange = replace(world.hypotheses[0], observer=VertexId("r0", 1), observed=VertexId("r1", 2))
        with pytest.raises(GraphError, match="r1:2"):
            judge([strange], lacking)


def arrays(world: TeamWorld, hypotheses: list[Hypothesis]) -> tuple[list[OwnMap], Measurements]:
    maps = [OwnMap.of(graph, [VertexId(name, k) for k in range(6)]) for name, graph in world.graphs.items()]
    rows = {vertex: row for row, vertex in enumerate(v for own in maps for v in own.vertices)}
    return maps, Measurements.of(hypotheses, rows, Slack(0.0, 0.0))


def test_the_tree_of_a_chain_is_the_chain() -> None:
    world = TeamWorld(0, 1)
    own = OwnMap.of(world.graphs["r0"], world.truth)
    assert {tuple(sorted(edge)) for edge in own.tree.tolist()} == {(k, k + 1) for k in range(5)}


@pytest.mark.parametrize("headings", [True, False])
def test_a_believed_sighting_is_examined_as_if_it_had_been_left_out(headings: bool) -> None:
    world = TeamWorld(11, 2, headings=headings)
    world.sight("r0", "r1", 12)
    maps, sightings = arrays(world, world.hypotheses)
    start = np.array([[p.x(), p.y(), p.theta()] for p in world.truth.values()])
    everyone = np.ones(12, np.bool_)
    with_all = examine(solve(maps, sightings, everyone, start), sightings, everyone)
    for k in range(12):
        others = everyone.copy()
        others[k] = False
        without = examine(solve(maps, sightings, others, start), sightings, others)
        assert with_all.chi2[k] == pytest.approx(without.chi2[k], rel=0.15, abs=0.02)  # apart from curvature
        assert with_all.spread[k] == pytest.approx(without.spread[k], rel=0.1)


def test_votes_are_the_chi2_of_a_loop_through_both_maps() -> None:
    """Against the same written with poses and covariances of factors, one at a time."""
    world = TeamWorld(12, 2)
    world.sight("r0", "r1", 8)
    maps, s = arrays(world, world.hypotheses)
    m = len(maps[0].vertices)
    relative, covariances = np.zeros((2 * m, 2 * m, 3)), np.zeros((2 * m, 2 * m, 3, 3))
    for k, own in enumerate(maps):
        relative[k * m : k * m + m, k * m : k * m + m] = own.relative
        covariances[k * m : k * m + m, k * m : k * m + m] = own.covariances
    table = [v for own in maps for v in own.vertices]
    chi2 = votes(s, s.tail, s.head, s.measured, s.noise, relative, covariances, m)
    compared = 0
    for i, k in itertools.product(range(8), repeat=2):
        offset = UncertainPose(gtsam.Pose2(*s.measured[i]), s.noise[i])
        near, far = table[s.tail[i]], table[s.head[i]]
        tail, head = table[s.tail[k]], table[s.head[k]]
        if near.robot != tail.robot:
            near, far, offset = far, near, inverse(offset)

        def moved(a: VertexId, b: VertexId) -> UncertainPose:
            return world.graphs[a.robot].relatives([(a, b)])[0]

        seen = compose(compose(moved(tail, near), offset), moved(far, head))
        residual = gtsam.Pose2.Logmap(seen.pose.between(gtsam.Pose2(*s.measured[k])))
        expected = float(residual @ np.linalg.solve(seen.covariance + s.noise[k], residual))
        if np.isfinite(chi2[i, k]):
            assert chi2[i, k] == pytest.approx(expected, rel=1e-4, abs=1e-4)
            compared += 1
        else:
            assert expected > 16.266
    assert compared > 50


def test_exp_is_that_of_the_group() -> None:
    rng = np.random.default_rng(0)
    for tangent in [*rng.uniform(-2.0, 2.0, (20, 3)), np.array([1.0, 2.0, 0.0])]:
        pose = gtsam.Pose2.Expmap(tangent)
        found = np.empty(3)
        exp(tangent, found)
        assert np.allclose(found, [pose.x(), pose.y(), pose.theta()])
