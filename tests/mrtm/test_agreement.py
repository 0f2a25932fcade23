from dataclasses import dataclass

import gtsam
import numpy as np
import pytest

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId
from frontend import se2
from frontend.local_map import Grid
from frontend.records import FloatArray
from mrtm.joint.alignment.agreement import Decision, Lookup, agreement, known, overlap, scores
from mrtm.joint.graph import JointGraph
from mrtm.joint.sightings.map_evidence import MapEvidence, fit

RESOLUTION = 0.05
HALF = np.array([0.4, 0.4, 0.06])

Wall = tuple[float, float, float, float]
CORRIDOR: list[Wall] = [(-40.0, 0.0, 40.0, 0.0), (-40.0, 2.5, 40.0, 2.5)]
NICHES: list[Wall] = [(1.0, 0.0, 1.0, 0.6), (1.6, 0.0, 1.6, 0.6), (5.5, 1.8, 5.5, 2.5), (7.0, 1.8, 7.0, 2.5)]
OFFICE: list[Wall] = [
    (0.0, 0.0, 12.0, 0.0), (12.0, 0.0, 12.0, 9.0), (0.0, 9.0, 12.0, 9.0), (0.0, 0.0, 0.0, 9.0),
    (4.0, 0.0, 4.0, 3.5), (4.0, 5.0, 7.5, 5.0), (9.0, 5.0, 9.0, 9.0), (2.0, 6.0, 2.9, 7.1),
]  # fmt: skip


@dataclass(frozen=True)
class Made:
    grid: Grid
    cloud: FloatArray
    normals: FloatArray


def made(walls: list[Wall], at: tuple[float, float, float], reach: float, low: float, high: float) -> Lookup:
    """The map from a frame at ``at`` in the plan: walls within ``reach`` of it, free space between y low and high."""
    frame = np.array(at)
    x, y = np.meshgrid(np.arange(-reach, reach, 0.02) + at[0], np.arange(low + 0.06, high - 0.05, 0.02))
    free = np.column_stack([x.ravel(), y.ravel()])
    points, normals = [], []
    for x0, y0, x1, y1 in walls:
        along = np.linspace(0.0, 1.0, int(np.hypot(x1 - x0, y1 - y0) / 0.04) + 1)[:, None]
        points.append(np.array([x0, y0]) + along * np.array([x1 - x0, y1 - y0]))
        normal = np.array([y0 - y1, x1 - x0]) / np.hypot(x1 - x0, y1 - y0)
        normals.append(np.tile(normal, (len(along), 1)))
    cloud, facing = np.concatenate(points), np.concatenate(normals)
    near = np.abs(cloud[:, 0] - at[0]) < reach
    cloud, facing = into(frame, cloud[near]), into(np.array([0.0, 0.0, at[2]]), facing[near])
    seen = into(frame, free)
    origin = np.minimum(seen.min(axis=0), cloud.min(axis=0)) - 0.5
    size = np.ceil((np.maximum(seen.max(axis=0), cloud.max(axis=0)) + 0.5 - origin) / RESOLUTION).astype(int)
    log_odds = np.zeros((size[1], size[0]), np.float32)
    for where, value in ((seen, -4.0), (cloud, 3.0)):
        column, row = np.floor((where - origin) / RESOLUTION).astype(int).T
        log_odds[row, column] = value
    return Lookup.of(Made(Grid(log_odds, RESOLUTION, origin), cloud, facing))


def into(frame: FloatArray, points: FloatArray) -> FloatArray:
    return se2.between(frame, np.column_stack([points, np.zeros(len(points))]))[:, :2]


def office(at: tuple[float, float, float]) -> Lookup:
    return made(OFFICE, at, 20.0, 0.0, 9.0)


def corridor(at: tuple[float, float, float], walls: list[Wall] = CORRIDOR) -> Lookup:
    return made(walls, at, 9.0, 0.0, 2.5)


A, B = (2.0, 2.0, 0.4), (8.0, 4.0, -1.1)
A_T_B = se2.between(np.array(A), np.array(B))


class TestAgreement:
    def test_maps_of_one_place_agree_at_the_true_pose(self) -> None:
        found = agreement(office(A), office(B), A_T_B)
        assert found.hits > 0.95
        assert found.conflicts < 0.01
        assert found.points > 500

    def test_the_overlap_is_the_area_known_in_both(self) -> None:
        a, b = corridor((0.0, 1.0, 0.3)), corridor((10.0, 1.5, 0.0))
        true = se2.between(np.array([0.0, 1.0, 0.3]), np.array([10.0, 1.5, 0.0]))
        assert overlap(a, b, true) == pytest.approx(8.0 * 2.5, rel=0.1)
        assert overlap(a, b, true + np.array([0.0, 50.0, 0.0])) == 0.0

    def test_a_wall_in_free_space_is_a_conflict(self) -> None:
        found = agreement(office(A), office(B), se2.compose(A_T_B, np.array([1.0, 0.5, 0.0])))
        assert found.hits < 0.4
        assert found.conflicts > 0.4

    def test_it_is_the_same_seen_from_either_map(self) -> None:
        pose = se2.compose(A_T_B, np.array([0.3, 0.0, 0.02]))
        one, other = agreement(office(A), office(B), pose), agreement(office(B), office(A), se2.inverse(pose))
        assert (one.points, one.hits, one.conflicts) == (other.points, other.hits, other.conflicts)

    def test_what_does_not_touch_scores_nothing(self) -> None:
        far = np.array([100.0, 0.0, 0.0])
        found = agreement(office(A), office(B), far)
        assert (found.points, found.hits, found.conflicts, found.overlap) == (0, 0.0, 0.0, 0.0)
        assert scores(office(A), office(B), far[None])[0] == -1.0

    def test_known_space_is_that_of_the_grid(self) -> None:
        a = office((2.0, 2.0, 0.0))
        points = np.array([[1.0, 1.0], [0.0, -5.0], [9.0, 6.0], [1e6, 0.0]])
        assert known(a, points, np.zeros(3)).tolist() == [True, False, True, False]


class TestFit:
    def test_it_finds_the_true_pose_and_agrees(self) -> None:
        found = fit(office(A), office(B), se2.compose(A_T_B, np.array([0.3, -0.2, 0.04])), HALF)
        off = se2.between(A_T_B, found.pose)
        assert np.hypot(off[0], off[1]) < 0.1
        assert abs(off[2]) < 0.015
        assert found.decision is Decision.AGREES

    @pytest.mark.parametrize("off", [(2.5, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 0.8), (-1.5, 2.0, 2.0)])
    def test_a_wrong_pose_is_contradicted(self, off: tuple[float, float, float]) -> None:
        assert fit(office(A), office(B), se2.compose(A_T_B, np.array(off)), HALF).decision is Decision.CONTRADICTS

    def test_a_bare_corridor_agrees_with_itself_moved_along_and_says_nothing(self) -> None:
        at_a, at_b = (0.0, 1.0, 0.3), (3.0, 1.5, -0.2)
        true = se2.between(np.array(at_a), np.array(at_b))
        found = fit(corridor(at_a), corridor(at_b), true, HALF)
        assert found.agreement.hits > 0.95
        assert found.lead() < 0.02
        assert found.decision is Decision.UNDECIDED

    def test_niches_tell_where_along_a_corridor(self) -> None:
        at_a, at_b = (0.0, 1.0, 0.3), (3.0, 1.5, -0.2)
        walls = CORRIDOR + [(x, y0, x, y1) for x, y0, _, y1 in NICHES for x in np.arange(x, x + 0.3, 0.04)]
        found = fit(corridor(at_a, walls), corridor(at_b, walls), se2.between(np.array(at_a), np.array(at_b)), HALF)
        assert found.lead() > 0.1

    def test_a_small_overlap_says_nothing(self) -> None:
        at_a, at_b = (0.0, 1.0, 0.0), (14.0, 1.0, 0.0)
        assert fit(corridor(at_a), corridor(at_b), np.array([14.0, 0.0, 0.0]), HALF).decision is Decision.UNDECIDED


class TestMapEvidence:
    """Two robots with two local maps each in the same office; sightings say where vertex blue:0 lies from red:0."""

    STEP = UncertainPose(gtsam.Pose2(2.0, 1.0, 0.5), np.diag([0.02, 0.02, 0.004]) ** 2)

    def evidence(self) -> MapEvidence:
        maps, graphs = {}, {}
        for name, at in (("red", A), ("blue", B)):
            first, second = VertexId(name, 0), VertexId(name, 1)
            graphs[name] = JointGraph(first)
            step = self.STEP
            edge = Edge(EdgeId(name, 0), 0, EdgeKind.INTER_VERTEX, first, second, step.pose, step.covariance)
            graphs[name].update(add=[edge])
            maps[first] = office(at)
            there = gtsam.Pose2(*at).compose(step.pose)
            maps[second] = office((there.x(), there.y(), there.theta()))
        return MapEvidence(maps, graphs)

    def asked(self, off: tuple[float, float, float], sigma: float = 0.1) -> Decision:
        seen = gtsam.Pose2(*A_T_B).compose(gtsam.Pose2(*off))
        covariance = np.diag([sigma, sigma, 0.2 * sigma]) ** 2
        return self.evidence()(VertexId("red", 0), VertexId("blue", 0), UncertainPose(seen, covariance))

    def test_it_agrees_with_the_truth_give_or_take_its_uncertainty(self) -> None:
        assert self.asked((0.15, -0.1, 0.02)) is Decision.AGREES

    def test_it_contradicts_what_is_wrong(self) -> None:
        assert self.asked((2.0, 1.0, 0.6)) is Decision.CONTRADICTS

    @pytest.mark.parametrize(("off", "contradicted"), [((0.15, -0.1, 0.02), False), ((2.0, 1.0, 0.6), True)])
    def test_a_veto_alone_is_the_same_contradiction(self, off: tuple[float, float, float], contradicted: bool) -> None:
        seen = UncertainPose(gtsam.Pose2(*A_T_B).compose(gtsam.Pose2(*off)), np.diag([0.1, 0.1, 0.02]) ** 2)
        said = self.evidence()(VertexId("red", 0), VertexId("blue", 0), seen, veto=True)
        assert (said is Decision.CONTRADICTS) is contradicted

    def test_it_says_nothing_where_the_pose_is_too_uncertain(self) -> None:
        assert self.asked((2.0, 1.0, 0.6), sigma=1.0) is Decision.UNDECIDED

    def test_it_says_nothing_of_maps_apart(self) -> None:
        assert self.asked((60.0, 0.0, 0.0)) is Decision.UNDECIDED

    def test_it_says_nothing_without_maps(self) -> None:
        graphs = {name: JointGraph(VertexId(name, 0)) for name in ("red", "blue")}
        seen = UncertainPose(gtsam.Pose2(), np.eye(3) * 1e-4)
        assert MapEvidence({}, graphs)(VertexId("red", 0), VertexId("blue", 0), seen) is Decision.UNDECIDED
