"""From records of sightings to the edges between robots."""

from collections.abc import Mapping

import gtsam
import numpy as np
import pytest

from factors import AnchoredSighting, Edge, EdgeId, EdgeKind, SightingEdge, UncertainPose, VertexId
from mrtm.joint.graph import JointGraph
from mrtm.joint.joint_map import JointMap
from mrtm.joint.sightings.hypotheses import Slack
from mrtm.team.meeting import WEAK, anchored, bridges, fusing_edges, sightings
from mrtm.team.records import AnchorRecord, EdgeRecord, SightingRecord
from mrtm.team.store import Store
from tests.mrtm.sighting_world import ANCHOR, TeamWorld
from tests.mrtm.team_world import chain, everything

NO_SLACK = Slack(0.0, 0.0)


def known(world: TeamWorld, leave_out: object = None) -> tuple[Store, JointMap]:
    """Everything, but what ``leave_out`` (a class and a robot) names."""
    kind, robot = leave_out if isinstance(leave_out, tuple) else (type(None), "")
    records = [r for r in everything(world, 0, 0) if not (isinstance(r, kind) and r.key.robot == robot)]
    store, joint = Store(), JointMap()
    store.merge(records)
    joint.learn([r.edge for r in store.of(EdgeRecord)], world.names)
    return store, joint


def between(world: TeamWorld) -> list[AnchoredSighting]:
    return [anchored(h, NO_SLACK) for h in world.hypotheses]


def test_a_sighting_comes_with_the_newest_place_of_both() -> None:
    world = chain(3, 2, sightings=5)
    found = {h.id: h for h in sightings(*_graphs(known(world)))}
    assert found.keys() == {h.id for h in world.hypotheses}
    for h in world.hypotheses:
        mine = found[h.id]
        assert (mine.observer, mine.observed, mine.sighting.range) == (h.observer, h.observed, h.sighting.range)
        assert mine.tail_T_observer.pose.equals(
            h.tail_T_observer.pose, 1e-6
        )  # version 1: without the rough one's centimetre
        assert mine.head_T_observed.pose.equals(h.head_T_observed.pose, 1e-6)


@pytest.mark.parametrize(
    "lost", [(AnchorRecord, "r0"), (AnchorRecord, "r1"), (SightingRecord, "r0"), (EdgeRecord, "r1")]
)
def test_what_lacks_an_end_waits(lost: object) -> None:
    world = chain(3, 2, sightings=6)
    found = sightings(*_graphs(known(world, lost)))
    expected = [
        h for h in world.hypotheses
        if (lost == (SightingRecord, "r0") and h.observer.robot == "r1")
        or (lost == (EdgeRecord, "r1") and 0 in {v.number for v in (h.observer, h.observed) if v.robot == "r1"})
    ]  # fmt: skip
    assert [h.id for h in found] == [h.id for h in sorted(expected, key=lambda h: h.id)]
    assert len(found) < 6


def _graphs(made: tuple[Store, JointMap]) -> tuple[Store, Mapping[str, JointGraph]]:
    store, joint = made
    return store, joint.robots


def test_one_edge_for_each_pair_of_vertices_whoever_saw_whom() -> None:
    world = TeamWorld(4, 2)
    world.sight("r0", "r1", 12)
    edges = fusing_edges(between(world))
    ends = {tuple(sorted((h.observer, h.observed))) for h in world.hypotheses}
    assert len(ends) > 2
    assert {(e.tail, e.head) for e in edges} == ends
    assert len(edges) == len({e.id for e in edges}) == len(ends)
    for edge in edges:
        assert isinstance(edge, Edge)
        assert edge.kind is EdgeKind.FUSING
        off = gtsam.Pose2.Logmap(edge.measurement.between(world.truth[edge.tail].between(world.truth[edge.head])))
        assert off @ np.linalg.solve(edge.covariance, off) < 25.0


def test_the_edges_do_not_depend_on_the_order_of_the_vertices() -> None:
    world = TeamWorld(4, 2)
    world.sight("r0", "r1", 8)
    one, other = (
        fusing_edges(between(world)),
        fusing_edges(sorted(between(world), key=lambda a: str(a.observed_vertex))),
    )
    assert [e.id for e in one] == [e.id for e in other]
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6)


def test_sightings_that_do_not_fix_the_pose_become_an_edge_each() -> None:
    world = TeamWorld(4, 2, headings=False)
    world.sight("r0", "r1", 1)
    (edge,) = fusing_edges(between(world))
    assert isinstance(edge, SightingEdge)
    assert (edge.tail, edge.head) == (world.hypotheses[0].observer, world.hypotheses[0].observed)


def test_slack_widens_both_ends() -> None:
    world = chain(3, 2, sightings=1)
    (h,) = world.hypotheses
    tight, loose = anchored(h, NO_SLACK), anchored(h, Slack(0.1, 0.2))
    np.testing.assert_allclose(tight.observer.covariance, ANCHOR, rtol=1e-6)
    for end in (loose.observer, loose.observed):
        np.testing.assert_allclose(end.covariance, ANCHOR + np.diag([0.1, 0.1, 0.2]) ** 2, rtol=1e-6)


def test_a_bridge_only_where_no_edge_fixes_a_pose() -> None:
    offset = UncertainPose(gtsam.Pose2(1.0, 2.0, 0.3), ANCHOR)
    offsets = {("a", "b"): offset, ("a-b", "c"): offset, ("a", "b-c"): offset}
    direct = Edge(EdgeId("x", 0), 0, EdgeKind.FUSING, VertexId("b", 3), VertexId("a", 1), offset.pose, ANCHOR)
    assert [(e.tail.robot, e.head.robot) for e in bridges(offsets, [direct])] == [("a-b", "c"), ("a", "b-c")]
    made = bridges(offsets, [])
    assert len({e.id for e in made}) == 3
    for edge in made:
        assert edge.tail.number == edge.head.number == 0
        assert edge.measurement.equals(offset.pose, 1e-12)
        np.testing.assert_allclose(edge.covariance, WEAK * ANCHOR)
