"""Robots that saw each other and the same room: what their maps add to the joint map, and lose with it."""

from collections.abc import Sequence
from functools import cache

import gtsam
import numpy as np
import pytest

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId
from factors.sighting import Sighting
from frontend import se2
from frontend.records import FloatArray
from mrtm.config import Config
from mrtm.joint.alignment.surface import Surface
from mrtm.joint.sightings.consistency import Verdict
from mrtm.robot.poses import array_of, pose_of
from mrtm.team.records import AnchorRecord, EdgeRecord, MapRecord, Record, SightingRecord, VertexRecord
from mrtm.team.teammate import Teammate
from tests.mrtm.team_world import apart, estimates, partition, teammate
from tests.mrtm.wall_maps import Wall, made

# A room of 12 m x 8 m that looks alike from nowhere; free space is to the left of each wall.
ROOM: list[Wall] = [
    (0, 0, 12, 0), (12, 0, 12, 8), (12, 8, 7, 8), (7, 8, 7, 6), (7, 6, 5.5, 6), (5.5, 6, 5.5, 8), (5.5, 8, 0, 8),
    (0, 8, 0, 0), (2, 2, 2, 3), (2, 3, 3.2, 3), (3.2, 3, 3.2, 2), (3.2, 2, 2, 2),
]  # fmt: skip
PLACES = {
    VertexId("blue", 0): np.array([4.0, 4.0, 0.3]),
    VertexId("blue", 1): np.array([6.0, 3.0, 1.1]),
    VertexId("red", 0): np.array([5.0, 2.0, 1.5]),
    VertexId("red", 1): np.array([7.0, 4.0, -0.4]),
}
"""Where the vertices lie in the room."""

STEP = np.diag([0.05, 0.05, 0.01]) ** 2
ANCHOR = np.diag([0.02, 0.02, 0.005]) ** 2
ALIGNING = Config()


def mine(robot: str, seed: int = 1, version: int = 1) -> list[Record]:
    """A robot's two vertices, the edge between, and their maps."""
    rng = np.random.default_rng((seed, len(robot)))
    tail, head = VertexId(robot, 0), VertexId(robot, 1)
    off = gtsam.Pose2.Expmap(rng.multivariate_normal(np.zeros(3), STEP))
    pose = pose_of(se2.between(PLACES[tail], PLACES[head])).compose(off)
    records: list[Record] = [EdgeRecord(Edge(EdgeId(robot, 0), 0, EdgeKind.INTER_VERTEX, tail, head, pose, STEP), 1.0)]
    for vertex in (tail, head):
        records.append(VertexRecord(vertex, 0, 1.0, 10))
        drawn = made(ROOM, PLACES[vertex], -1.0, 13.0, seed + vertex.number)
        records.append(MapRecord(vertex, version, 2.0, drawn.grid, drawn.cloud, drawn.normals))
    return records


def seen(first: int, count: int, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[Record]:
    """Sightings of red by blue, numbers from ``first``; as if red's map lay off by ``shift`` in its own frame."""
    rng = np.random.default_rng(first)
    records: list[Record] = []
    for number in range(first, first + count):
        blue, red = VertexId("blue", number % 2), VertexId("red", (number // 2) % 2)
        at_blue, at_red = rng.uniform([-1, -1, -3], [1, 1, 3]), rng.uniform([-1, -1, -3], [1, 1, 3])
        origin = PLACES[VertexId("red", 0)]
        stands = se2.compose(PLACES[red], at_red)
        appears = se2.compose(se2.compose(origin, np.array(shift)), se2.between(origin, stands))
        x, y, theta = se2.between(se2.compose(PLACES[blue], at_blue), appears)
        sighting = Sighting(
            float(np.hypot(x, y) + rng.normal(0.0, 0.05)), float(np.arctan2(y, x) + rng.normal(0.0, 0.02)),
            float(theta + rng.normal(0.0, 0.05)), 0.05, 0.02, 0.05,
        )  # fmt: skip
        records.append(SightingRecord("blue", number, 0, 3.0, "red", sighting, ("blue", number), ("red", number)))
        for vertex, where in ((blue, at_blue), (red, at_red)):
            records.append(AnchorRecord(vertex.robot, number, 1, 3.0, vertex, UncertainPose(pose_of(where), ANCHOR)))
    return records


@cache
def walk() -> list[Record]:
    return [*mine("blue"), *mine("red")]


def thought(records: Sequence[Record], config: Config = ALIGNING) -> Teammate:
    one = teammate("blue", records, config)
    one.think()
    one.align(5)
    return one


def across(one: Teammate) -> set[EdgeId]:
    """Alignments between the two robots that are in the joint map."""
    found = {
        e.id
        for c in one.joint.components()
        for e in c.graph.edges()
        if e.kind is EdgeKind.ALIGNMENT and e.tail.robot != e.head.robot
    }
    assert found == {e.id for e in one.aligner.edges() if e.tail.robot != e.head.robot}
    return found


def errors(one: Teammate) -> FloatArray:
    """Metres that vertices lie off as blue's first sees them."""
    found, root = estimates(one), VertexId("blue", 0)
    true = {v: se2.between(PLACES[root], place) for v, place in PLACES.items()}
    return np.array([np.hypot(*(array_of(found[root].between(found[v])) - true[v])[:2]) for v in found])


def test_free_space_stays_free_when_a_map_has_travelled() -> None:
    """A map in a store has few levels of log-odds; on free cells a wall of another map must be a conflict still."""
    one = teammate("blue", walk())
    for record in one.store.of(MapRecord):
        fresh = Surface.of(made(ROOM, PLACES[record.vertex], -1.0, 13.0, 1 + record.vertex.number))
        kept = Surface.of(record)
        for kind in (1, 2, 3):  # surface, clearly free, other
            counts = [int(np.count_nonzero(s.lookup.kinds == kind)) for s in (kept, fresh)]
            assert counts[0] == pytest.approx(counts[1], rel=0.02)
            assert counts[0] > 1000


def test_maps_make_what_sightings_began_exact() -> None:
    records = [*walk(), *seen(0, 6)]
    with_maps = thought(records)
    without = thought(records, Config.model_validate({"joint": {"alignments": 0}}))
    assert partition(with_maps) == partition(without) == [("blue", "red")]
    assert len(across(with_maps)) == 4
    assert errors(with_maps).max() < 0.03 < errors(without).max()


def test_alignments_between_robots_go_with_the_last_edge_that_joins_them() -> None:
    """A cluster of false sightings by which the maps fit, as many true ones that the maps cannot tell from them: both
    doubted, nothing is left of the alignments, and blue's and red's own maps are as good as if they had not met."""
    one = thought([*walk(), *seen(0, 5)])
    assert across(one)
    own = [e for e in one.aligner.edges() if e.tail.robot == e.head.robot]
    assert len(own) == 2
    one.aligner.keep_within([("blue",), ("red",)])
    one.joint.join(one.aligner.edges())
    assert partition(one) == [("blue",), ("red",)]
    assert across(one) == set()
    assert {e.id for c in one.joint.components() for e in c.added.values()} == {e.id for e in own}


def test_false_sightings_that_the_maps_contradict_do_not_join() -> None:
    one = thought([*walk(), *seen(0, 6, (3.0, 1.0, 0.6))])
    assert partition(one) == [("blue",), ("red",)]
    assert across(one) == set()
    assert {j.verdict for j in one.judgements.values()} == {Verdict.REFUSED}
    assert all("contradict" in j.reason for j in one.judgements.values())


def test_a_merge_made_without_maps_is_undone_when_they_come() -> None:
    """The vertices are known, their maps not yet closed: five false sightings join the robots for a while."""
    maps = [r for r in walk() if isinstance(r, MapRecord)]
    one = thought([*(r for r in walk() if r not in maps), *seen(0, 5, (3.0, 1.0, 0.6))])
    assert partition(one) == [("blue", "red")]
    one.store.merge(maps)
    one.think()
    one.align(5)
    assert partition(one) == [("blue",), ("red",)]
    assert across(one) == set()
    one.store.merge(seen(20, 6))
    one.think()
    one.align(5)
    assert partition(one) == [("blue", "red")]
    assert len(across(one)) == 4
    assert errors(one).max() < 0.03
    fates = {key: j.verdict for key, j in one.judgements.items()}
    assert all((verdict is Verdict.ACCEPTED) == (number >= 20) for (_, number), verdict in fates.items())


@pytest.mark.parametrize("seed", range(3))
def test_settled_maps_are_the_same_whatever_came_when(seed: int) -> None:
    rng = np.random.default_rng(seed)
    records = [*walk(), *mine("red", 5, version=2)[2::2], *seen(0, 8)]
    whole = teammate(None, records, ALIGNING)
    whole.settle()
    one = teammate("red", (), ALIGNING)
    for part in np.array_split(rng.permutation(len(records)), 5):
        one.store.merge([records[i] for i in part])
        one.think()
        one.align()
    assert one.store.summary() == whole.store.summary()
    one.settle()
    assert partition(one) == partition(whole) == [("blue", "red")]
    assert across(one) == across(whole) != set()
    assert apart(estimates(one), estimates(whole), VertexId("blue", 0)) < 1e-6
