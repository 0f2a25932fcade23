"""What robots conclude from what they have recorded and heard: all the same in the end, whatever came when."""

from collections.abc import Iterable
from functools import cache
from itertools import pairwise
from random import Random

import gtsam
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId
from factors.sighting import Sighting
from mrtm.joint.sightings.consistency import Verdict
from mrtm.team.exchange import exchange
from mrtm.team.records import AnchorRecord, EdgeRecord, Key, Kind, Record, SightingRecord, VertexRecord
from mrtm.team.teammate import Peers, Teammate
from mrtm.timing import Stages
from tests.mrtm.sighting_world import STEP, TeamWorld
from tests.mrtm.team_world import (
    NO_MAPS,
    apart,
    chain,
    estimates,
    everything,
    met,
    own_records,
    partition,
    teammate,
)


@cache
def five() -> TeamWorld:
    """Five robots in a chain; one of the pairs has too few sightings, some are false."""
    world = TeamWorld(5, 5)
    for (a, b), count in zip(
        (("r0", "r1"), ("r1", "r2"), ("r2", "r3"), ("r0", "r2"), ("r3", "r4")), (7, 6, 7, 4, 2), strict=True
    ):
        world.sight(a, b, count, 0.15)
    return world


@cache
def all_at_once() -> Teammate:
    """Somebody who got everything in one go."""
    one = teammate(None, everything(five()))
    one.settle()
    return one


def assert_same_maps(one: Teammate, other: Teammate, within: float = 1e-6) -> None:
    """The same components, and poses in them that lie so near."""
    assert partition(one) == partition(other)
    for component in other.joint.components():
        poses = one.joint.component(component.robots[0]).graph.estimates()
        assert apart(poses, component.graph.estimates(), component.graph.root) < within


def writer(record: Record) -> str:
    return record.key.robot


# When to think.


def test_a_robot_thinks_again_when_it_knows_a_tenth_more_or_has_a_fifth_more_sightings() -> None:
    world = five()
    records = everything(world)
    seen = [r for r in records if isinstance(r, SightingRecord)]
    one = teammate("r0", [r for r in records if not isinstance(r, SightingRecord)])
    assert one.is_due()
    one.store.merge(seen[:10])
    one.think()
    assert not one.is_due()
    one.store.merge(seen[10:11])
    assert not one.is_due()
    one.store.merge(seen[11:12])
    assert one.is_due()
    one.think()
    known = len(one.store)
    number = 1000
    while not one.is_due():
        one.store.merge([VertexRecord(VertexId("r5", number), 0, 0.0, 0)])
        number += 1
    assert 1.1 * known <= len(one.store) < 1.1 * known + 1


# Convergence.


@settings(max_examples=8, phases=[Phase.generate])  # a seed need not be small
@given(st.integers(0, 2**32), st.floats(0.0, 0.6))
def test_five_robots_end_with_the_same_joint_map_however_they_met(seed: int, loss: float) -> None:
    """Records come in bits, meetings are of any pairs in any order, messages get lost, doubled and relayed."""
    rng = Random(seed)
    world = five()
    team = {name: teammate(name) for name in world.names}
    told = everything(world)
    rng.shuffle(told)  # even a robot's own: a version that a higher one has overtaken never is heard of

    def link(message: bytes) -> Iterable[bytes]:
        return () if rng.random() < loss else (message,) * rng.choice((1, 1, 2))

    for part in np.array_split(np.arange(len(told)), 6):
        for i in part:
            team[writer(told[i])].store.put(told[i])
        a, b = rng.sample(world.names, 2)
        exchange(team[a].store, team[b].store, link)
        for name in (a, b):
            team[name].think()
    steps = list(pairwise(world.names))  # along the chain and back: news of one end reach the other by relay only
    for a, b in (*steps, *reversed(steps)):
        exchange(team[a].store, team[b].store)
        team[b].think()
    whole = all_at_once()
    for name, one in team.items():
        assert one.store.summary() == whole.store.summary(), name
        one.think()
        one.settle()
        assert_same_maps(one, whole)
        assert {k: j.verdict for k, j in one.judgements.items()} == {k: j.verdict for k, j in whole.judgements.items()}


def test_what_is_known_on_the_way_is_the_settled_map_within_the_noise() -> None:
    rng, told = Random(2), everything(five())
    rng.shuffle(told)
    one = teammate("r2")
    for part in np.array_split(np.arange(len(told)), 10):
        one.store.merge([told[i] for i in part])
        one.think()
    assert_same_maps(one, all_at_once(), within=1e-3)


def test_the_joint_map_is_that_of_the_truth_and_of_who_met() -> None:
    world, whole = five(), all_at_once()
    assert partition(whole) == [("r0", "r1", "r2", "r3"), ("r4",)]  # two sightings do not join
    for component in whole.joint.components():
        found, root = component.graph.estimates(), component.graph.root
        off = [found[root].between(found[v]).between(world.truth[root].between(world.truth[v])) for v in found]
        assert max(np.hypot(o.x(), o.y()) for o in off) < 1.0
    accepted = {key for key, j in whole.judgements.items() if j.verdict is Verdict.ACCEPTED}
    joined = {h.id for h in world.hypotheses if "r4" not in h.robots}
    assert accepted <= world.true
    assert len(accepted) >= 0.9 * len(world.true & joined)


def test_robots_that_hold_the_same_share_what_they_settle_for_and_others_do_not() -> None:
    peers, told = Peers(), everything(chain(2, 3))
    a, b, c = (Teammate(name, NO_MAPS, Stages(), peers) for name in ("r0", "r1", "r2"))
    a.store.merge(told)
    b.store.merge(told)
    c.store.merge([r for r in told if writer(r) == "r2"])
    for one in (a, c, b):
        one.settle()
    assert a.joint is b.joint
    assert partition(a) == [("r0", "r1", "r2")]
    assert partition(c) == [("r2",)]


# Late and missing records.


def test_an_edge_may_be_the_last_to_come() -> None:
    """It makes the vertex known in which a sighting was made: no anchor and no sighting comes after it."""
    world = chain(4, 2, sightings=6)
    told = everything(world, 0, 0)
    seen = max(h.observed.number if h.observed.robot == "r1" else h.observer.number for h in world.hypotheses)
    late = [r for r in told if isinstance(r, EdgeRecord) and r.edge.id == EdgeId("r1", seen)]
    one = teammate("r0", [r for r in told if r not in late])
    one.think()
    before = len(one.judgements)
    one.store.merge(late)
    one.think()
    assert len(one.judgements) == len(world.hypotheses) > before
    assert partition(one) == [("r0", "r1")]
    whole = teammate("r0", told)
    whole.think()
    assert apart(estimates(one), estimates(whole), VertexId("r0", 0)) < 1e-3


def test_a_sighting_without_both_anchors_is_not_judged() -> None:
    world = chain(4, 2, sightings=6)
    told = everything(world, 0, 0)
    one = teammate("r0", [r for r in told if not (isinstance(r, AnchorRecord) and r.robot == "r1" and r.number == 2)])
    one.think()
    assert len(one.judgements) == 5
    one.store.merge(told)
    one.think()
    assert len(one.judgements) == 6


def test_the_refined_anchor_replaces_the_rough_one() -> None:
    world = chain(6, 2, sightings=6)
    told = everything(world, 0, 0)
    one = teammate("r0", [r for r in told if not (isinstance(r, AnchorRecord) and r.version == 1)])
    one.think()
    (component,) = one.joint.components()
    rough = {e.id: e.version for e in component.added.values()}
    before = estimates(one)
    one.store.merge(told)
    one.think()
    (component,) = one.joint.components()
    assert {e.id: e.version for e in component.added.values()} == {i: v + 1 for i, v in rough.items()}
    whole = teammate("r0", told)
    whole.think()
    assert 1e-3 < apart(estimates(one), before, VertexId("r0", 0)) < 0.2
    assert apart(estimates(one), estimates(whole), VertexId("r0", 0)) < 1e-3


def test_an_anchor_that_moves_to_another_vertex_moves_the_edge() -> None:
    """A re-entry comes to nothing, and the robot turns out to have been in the vertex before."""
    world = chain(6, 2, sightings=6)
    told = everything(world, 0, 0)
    first = next(
        r for r in told if isinstance(r, AnchorRecord) and r.version == 1 and r.robot == "r1" and r.vertex.number > 0
    )
    other = VertexId("r1", first.vertex.number - 1)
    pose = world.truth[other].between(world.truth[first.vertex]).compose(first.pose.pose)
    moved = AnchorRecord("r1", first.number, 2, 99.0, other, UncertainPose(pose, first.pose.covariance))
    one = teammate("r0", told)
    one.think()
    before = estimates(one)
    one.store.merge([moved])
    one.think()
    (component,) = one.joint.components()
    h = world.hypotheses[first.number]
    mine = h.observer if h.observer.robot == "r0" else h.observed
    assert any({e.tail, e.head} == {mine, other} for e in component.added.values())
    assert apart(estimates(one), before, VertexId("r0", 0)) < 0.5
    whole = teammate("r0", [*told, moved])
    whole.think()
    assert apart(estimates(one), estimates(whole), VertexId("r0", 0)) < 1e-3


# Taking back.


@pytest.mark.parametrize("seed", range(4))
def test_a_merge_on_false_sightings_is_undone_and_the_map_recovers(seed: int) -> None:
    world = TeamWorld(seed, 3)
    world.sight("r0", "r1", 6)
    world.cluster("r1", "r2", 5)
    false = [h.id for h in world.hypotheses if h.id not in world.true]
    count = len(world.hypotheses)
    own = [r for name in world.names for r in own_records(world, name)]
    one = teammate("r0", [*own, *(r for records in met(world.hypotheses) for r in records)])
    one.think()
    assert partition(one) == [("r0", "r1", "r2")]  # who could know
    world.sight("r1", "r2", 14)
    meetings = met(world.hypotheses)
    one.store.merge([r for records in meetings[count:] for r in records])
    one.think()
    assert all(one.judgements[key].verdict is Verdict.REFUSED for key in false)
    assert partition(one) == [("r0", "r1", "r2")]
    innocent = teammate(
        "r0",
        [
            *own,
            *(r for h, records in zip(world.hypotheses, meetings, strict=True) if h.id in world.true for r in records),
        ],
    )
    innocent.think()
    assert apart(estimates(one), estimates(innocent), VertexId("r0", 0)) < 0.05
    one.settle()
    innocent.settle()
    assert apart(estimates(one), estimates(innocent), VertexId("r0", 0)) < 0.05


def test_a_merge_is_undone_when_as_many_say_otherwise() -> None:
    """Nobody knows which: the robots fall apart, and their own maps are as they were."""
    world = TeamWorld(1, 2)
    world.cluster("r0", "r1", 5)
    one = teammate("r0", everything(world))
    one.think()
    assert partition(one) == [("r0", "r1")]
    world.sight("r0", "r1", 5)
    one.store.merge(everything(world))
    one.think()
    assert partition(one) == [("r0",), ("r1",)]
    assert {j.verdict for j in one.judgements.values()} == {Verdict.WAITING}
    alone = teammate("r0", [r for name in world.names for r in own_records(world, name, 2, 1)])
    alone.think()
    for name in world.names:
        mine, expected = one.joint.seen_from(name), alone.joint.seen_from(name)
        assert apart(mine, expected, VertexId(name, 0)) == 0.0


# Hostile records.


def hostile() -> dict[str, Record]:
    far = gtsam.Pose2(9e5, -9e5, 3.0)
    sharp, blunt = 1e-12 * np.eye(3), 1e9 * np.eye(3)

    def edge(
        number: int, version: int, tail: VertexId, head: VertexId, pose: gtsam.Pose2, covariance: object
    ) -> Record:
        return EdgeRecord(
            Edge(EdgeId("r1", number), version, EdgeKind.LOOP, tail, head, pose, np.asarray(covariance)), 1.0
        )

    a, b = VertexId("r1", 1), VertexId("r1", 4)
    return {
        "other ends than before": edge(2, 9, a, b, far, STEP),
        "an edge into another robot's map": edge(70, 0, a, VertexId("r0", 0), far, STEP),
        "an edge between two vertices of another robot": edge(70, 0, VertexId("r0", 2), VertexId("r0", 1), far, STEP),
        "a loop that is far off and sure": edge(70, 0, a, b, far, sharp),
        "a loop that says nothing": edge(70, 0, a, b, far, blunt),
        "an anchor far off and sure": AnchorRecord("r1", 0, 9, 1.0, a, UncertainPose(far, sharp)),
        "an anchor in a vertex nobody knows": AnchorRecord(
            "r1", 0, 9, 1.0, VertexId("r1", 4000), UncertainPose(far, STEP)
        ),
        "a sighting of a robot nobody knows": SightingRecord(
            "r1", 900, 0, 1.0, "zed", Sighting(3.0, 0.1, 0.2, 0.1, 0.1, 0.1), ("r1", 0), ("zed", 0)
        ),
        "a sighting from far off": SightingRecord(
            "r1", 900, 0, 1.0, "r0", Sighting(9e5, 0.1, 0.2, 1e-6, 9e3, 1e-6), ("r1", 0), ("r0", 0)
        ),
    }


@pytest.mark.parametrize("name", hostile())
def test_a_hostile_record_ends_nothing_and_leaves_other_robots_alone(name: str) -> None:
    world = chain(9, 3, sightings=7)
    told = everything(world)
    one = teammate("r0", told)
    one.think()
    before = estimates(one)
    one.store.merge([hostile()[name]])
    one.think()
    refused = one.joint.refused
    one.settle()
    now = estimates(one)
    assert before.keys() == now.keys()
    assert all(np.isfinite([p.x(), p.y(), p.theta()]).all() for p in now.values())
    for robot in ("r0", "r2"):  # what they know of themselves is as good as before
        mine = {v: pose for v, pose in now.items() if v.robot == robot}
        assert apart(mine, {v: before[v] for v in mine}, VertexId(robot, 0)) < 0.1
    if name.startswith("an edge"):
        (line,) = refused.values()
        assert line.startswith("edge r1#")


@pytest.mark.parametrize("name", hostile())
def test_what_hostile_records_come_to_in_the_end_does_not_depend_on_when_they_come(name: str) -> None:
    told, bad = everything(chain(9, 3, sightings=7)), hostile()[name]
    late = teammate("r0", told)
    late.think()
    late.store.merge([bad])
    early = teammate("r0", [bad, *told])
    for one in (late, early):
        one.think()
        one.settle()
    assert_same_maps(early, late)


# Sightings without headings.


@pytest.mark.parametrize("seed", range(3))
def test_a_team_that_sees_no_headings_comes_into_one_frame(seed: int) -> None:
    world = chain(seed, 4, sightings=9, headings=False)
    one = teammate("r1", everything(world))
    one.think()
    assert partition(one) == [("r0", "r1", "r2", "r3")]
    kinds = {e.kind for c in one.joint.components() for e in c.added.values()}
    assert EdgeKind.SIGHTING in kinds
    found, root = estimates(one), VertexId("r0", 0)
    off = [found[root].between(found[v]).between(world.truth[root].between(world.truth[v])) for v in found]
    assert max(np.hypot(o.x(), o.y()) for o in off) < 1.5


def test_mutual_bearings_may_come_in_any_order() -> None:
    """Edges of single sightings change their numbers, and with them who is tail and head, when more come."""
    world = TeamWorld(2, 2, headings=False)
    world.sight("r0", "r1", 16, at=2)
    meetings, own = met(world.hypotheses), [r for name in world.names for r in own_records(world, name)]
    whole = teammate("r0", [*own, *(r for records in meetings for r in records)])
    whole.think()
    for seed in range(3):
        order = Random(seed).sample(meetings, len(meetings))
        one = teammate("r0", own)
        for part in np.array_split(np.arange(len(order)), 5):
            one.store.merge([r for i in part for r in order[i]])
            one.think()
        assert one.joint.refused == {}
        assert partition(one) == partition(whole) == [("r0", "r1")]
        assert apart(estimates(one), estimates(whole), VertexId("r0", 0)) < 1e-3


def test_names_that_together_make_another_name_are_no_trouble() -> None:
    """The bridge of a and b is not the edge of a robot called a-b."""
    world = TeamWorld(2, 3, headings=False)
    world.sight("r0", "r1", 14)
    rename = {"r0": "a", "r1": "b", "r2": "a-b"}
    one = teammate("a", renamed(everything(world), rename))
    one.think()
    assert partition(one) == [("a", "b"), ("a-b",)]
    assert Key(Kind.EDGE, "a-b", 1) in one.store


def renamed(records: Iterable[Record], names: dict[str, str]) -> list[Record]:
    """The same told by robots of other names."""

    def vertex(v: VertexId) -> VertexId:
        return VertexId(names[v.robot], v.number)

    found: list[Record] = []
    for r in records:
        if isinstance(r, EdgeRecord):
            e = r.edge
            ends = vertex(e.tail), vertex(e.head)
            e = Edge(EdgeId(names[e.id.robot], e.id.number), e.version, e.kind, *ends, e.measurement, e.covariance)
            found.append(EdgeRecord(e, r.time))
        elif isinstance(r, AnchorRecord):
            found.append(AnchorRecord(names[r.robot], r.number, r.version, r.time, vertex(r.vertex), r.pose))
        elif isinstance(r, SightingRecord):
            (a, i), (b, k) = r.observer_anchor, r.observed_anchor
            found.append(
                SightingRecord(
                    names[r.observer],
                    r.number,
                    0,
                    r.time,
                    names[r.observed],
                    r.measurement,
                    (names[a], i),
                    (names[b], k),
                )
            )
    return found
