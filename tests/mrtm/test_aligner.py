"""When maps are aligned, when again, and when an alignment is given up."""

from functools import cache

import gtsam
import numpy as np
import pytest

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId
from frontend import se2
from frontend.records import FloatArray
from mrtm.joint.alignment import aligner as module
from mrtm.joint.alignment.align import Alignment, align
from mrtm.joint.alignment.aligner import Aligner
from mrtm.joint.alignment.surface import Surface
from mrtm.joint.graph import JointGraph
from mrtm.robot.poses import array_of, pose_of
from tests.mrtm.wall_maps import Wall, seen

# A room of 12 m x 8 m that looks alike from nowhere; free space is to the left of each wall.
ROOM: list[Wall] = [
    (0, 0, 12, 0), (12, 0, 12, 8), (12, 8, 7, 8), (7, 8, 7, 6), (7, 6, 5.5, 6), (5.5, 6, 5.5, 8), (5.5, 8, 0, 8),
    (0, 8, 0, 0), (2, 2, 2, 3), (2, 3, 3.2, 3), (3.2, 3, 3.2, 2), (3.2, 2, 2, 2),
]  # fmt: skip
OTHER: list[Wall] = [(0, 0, 12, 0), (12, 0, 12, 8), (12, 8, 0, 8), (0, 8, 0, 0), (6, 1, 6, 5), (6, 5, 9, 5)]
A = np.array([4.0, 4.0, 0.3])
B = se2.compose(A, np.array([1.5, -2.0, 0.8]))
RED, BLUE = VertexId("red", 0), VertexId("blue", 0)
PAIR = BLUE, RED  # in the order of their names
TRUE = pose_of(se2.between(B, A))
WIDE, SURE = np.diag([0.3, 0.3, 0.06]) ** 2, np.diag([0.02, 0.02, 0.005]) ** 2


@cache
def surface(name: str, seed: int = 1) -> Surface:
    """One of the maps; another seed is the same room seen again."""
    return {"blue": lambda: seen(ROOM, B, 1.0, 13.0, seed), "red": lambda: seen(ROOM, A, -1.0, 10.0, seed),
            "other": lambda: seen(OTHER, A, -1.0, 10.0, seed)}[name]()  # fmt: skip


def graph(off: tuple[float, float, float] = (0.2, -0.15, 0.04), covariance: FloatArray = WIDE) -> JointGraph:
    """Red and blue, joined by an edge that is ``off`` the truth."""
    found = JointGraph(BLUE)
    pose = TRUE.compose(gtsam.Pose2(*off))
    found.update(add=[Edge(EdgeId("blue:0-red:0", 0), 0, EdgeKind.FUSING, BLUE, RED, pose, covariance)])
    return found


def maps(red: str = "red", seed: int = 1) -> dict[VertexId, Surface]:
    return {BLUE: surface("blue"), RED: surface(red, seed)}


def error(edge: Edge) -> FloatArray:
    return np.abs(se2.between(array_of(TRUE), array_of(edge.measurement)))


@pytest.fixture
def tries(monkeypatch: pytest.MonkeyPatch) -> list[None]:
    """One entry for every alignment that is tried."""
    counted: list[None] = []

    def counting(a: Surface, b: Surface, guess: UncertainPose) -> Alignment | None:
        counted.append(None)
        return align(a, b, guess)

    monkeypatch.setattr(module, "align", counting)
    return counted


def test_maps_that_overlap_are_aligned_once(tries: list[None]) -> None:
    joint, one = graph(), Aligner()
    assert one.look(joint, maps(), 12)
    (edge,) = one.edges()
    assert (edge.kind, edge.tail, edge.head, edge.version) == (EdgeKind.ALIGNMENT, BLUE, RED, 0)
    assert (error(edge) < (0.03, 0.03, 0.005)).all()
    assert one.joins("red", "blue")
    assert not one.joins("red", "green")
    joint.update(add=one.edges())
    assert not one.look(joint, maps(), 12)
    assert not one.take_back(joint)
    assert len(tries) == 1
    assert one.edges() == [edge]


def test_an_alignment_is_made_anew_when_a_map_has_changed(tries: list[None]) -> None:
    joint, one = graph(), Aligner()
    one.look(joint, maps(), 12)
    joint.update(add=one.edges())
    assert one.look(joint, maps(seed=5), 12)
    assert len(tries) == 2
    (edge,) = one.edges()
    assert edge.version == 1
    joint.update(replace=one.edges())
    assert not one.look(joint, maps(seed=5), 12)


def test_an_alignment_is_dropped_when_the_map_turns_out_another() -> None:
    joint, one = graph(), Aligner()
    one.look(joint, maps(), 12)
    one.look(joint, maps("other"), 12)
    assert one.edges() == []
    assert one.attempts[PAIR].refusal
    one.look(joint, maps(seed=5), 12)
    (edge,) = one.edges()
    assert edge.version == 1  # the number of the one that was dropped is not used again


def test_whoever_holds_an_alignment_is_told_when_a_map_has_become_too_small_for_it() -> None:
    joint, one = graph(), Aligner()
    one.look(joint, maps(), 12)
    assert one.edges()
    assert one.look(joint, {BLUE: surface("blue"), RED: seen(ROOM, A, -1.0, 1.2, 5)}, 12)
    assert one.edges() == []
    assert one.attempts[PAIR].refusal == "they hardly overlap"


def test_pairs_that_hardly_overlap_come_in_the_order_of_their_names() -> None:
    """What is looked at next follows from it."""
    row = [VertexId("red", number) for number in range(8)]
    joint = JointGraph(row[0])
    joint.update(
        add=[
            Edge(EdgeId("red", i), 0, EdgeKind.INTER_VERTEX, row[i], row[i + 1], gtsam.Pose2(11.0, 0.0, 0.0), SURE)
            for i in range(7)
        ]
    )
    known = {v: seen(OTHER, np.array([6.0, 4.0, 0.0]), -1.0, 13.0, v.number) for v in row}
    one = Aligner()
    one.look(joint, known, 12)
    apart = [pair for pair, attempt in one.attempts.items() if attempt.refusal == "they hardly overlap"]
    assert len(apart) > 3
    assert apart == sorted(apart)


def test_a_refused_pair_is_tried_again_only_when_the_guess_is_another(tries: list[None]) -> None:
    one = Aligner()
    assert one.look(graph(), maps("other"), 12)
    assert one.edges() == []
    for same in (graph(), graph((0.25, -0.1, 0.05)), graph(covariance=0.5 * WIDE)):
        assert not one.look(same, maps("other"), 12)
    assert len(tries) == 1
    assert one.look(graph((-0.8, -0.15, 0.04)), maps("other"), 12)  # elsewhere
    assert one.look(graph((-0.8, -0.15, 0.04), SURE), maps("other"), 12)  # surer
    assert not one.look(graph((-0.8, -0.15, 0.04), SURE), maps("other"), 12)
    assert len(tries) == 3


def test_an_alignment_that_the_estimate_contradicts_is_taken_back() -> None:
    joint, one = graph(), Aligner()
    one.look(joint, maps(), 12)
    (edge,) = one.edges()
    assert one.overlaps().keys() == {edge.id}
    joint.update(add=[edge])
    assert one.take_back(joint) == []
    first = next(e for e in joint.edges() if e.kind is EdgeKind.FUSING)
    wrong = TRUE.compose(gtsam.Pose2(3.0, 1.0, 0.5))
    joint.update(replace=[Edge(first.id, 1, EdgeKind.FUSING, BLUE, RED, wrong, 1e-2 * SURE)])
    more = [Edge(EdgeId("more", n), 0, EdgeKind.INTER_VERTEX, BLUE, RED, wrong, 1e-2 * SURE) for n in range(3)]
    joint.update(add=more)
    assert one.take_back(joint) == [edge.id]
    assert one.edges() == []
    assert one.overlaps() == {}
    assert not one.joins("red", "blue")
    assert "chi2" in one.attempts[PAIR].refusal
    assert one.take_back(joint) == []


def test_an_alignment_that_is_not_in_the_graph_is_not_taken_back() -> None:
    joint, one = graph(), Aligner()
    one.look(joint, maps(), 12)
    assert one.take_back(graph((3.0, 1.0, 0.5), SURE)) == []
    assert len(one.edges()) == 1


def test_alignments_between_robots_that_fell_apart_are_forgotten(tries: list[None]) -> None:
    """If the robots come together again, the maps are looked at from there."""
    joint, one = graph(), Aligner()
    one.look(joint, maps(), 12)
    one.keep_within([("blue", "red"), ("green",)])
    assert len(one.edges()) == 1
    one.keep_within([("blue",), ("red",), ("green",)])
    assert one.edges() == []
    assert one.look(joint, maps(), 12)
    assert len(tries) == 2
    assert [edge.version for edge in one.edges()] == [1]


def test_at_most_so_many_at_a_time() -> None:
    joint = graph()
    far = VertexId("red", 1)
    joint.update(
        add=[Edge(EdgeId("red", 1), 0, EdgeKind.INTER_VERTEX, RED, far, gtsam.Pose2(0.1, 0.0, 0.0), 0.01 * SURE)]
    )
    known = {**maps(), far: surface("red", 7)}
    one = Aligner()
    looks = 0
    while one.look(joint, known, 1):
        looks += 1
        assert len(one.attempts) == looks
    assert looks == 3


def test_a_vertex_without_a_map_is_left_alone(tries: list[None]) -> None:
    one = Aligner()
    assert not one.look(graph(), {RED: surface("red")}, 12)
    assert not one.look(graph(), {}, 12)
    assert tries == []
