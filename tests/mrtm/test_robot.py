"""Steps M1 to M8 on small simulated logs whose truth is known, and on logs that lie."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId
from frontend import se2
from frontend.records import LaserScan
from mrtm.joint.graph import JointGraph
from mrtm.result import Event, RunResult
from mrtm.robot.robot import Robot, fuse
from mrtm.timing import Stages
from tests.mrtm.small_logs import (
    SIDE,
    edge_errors,
    errors,
    false_edges,
    hotel_visit,
    jumped,
    kidnapped,
    mapped,
    office_ring,
    poses,
    ring,
    room,
    small,
    there_and_back,
)
from tools.simulation import LMS200, OdometryNoise, SimulatedLog

JUMP = 150  # the scan at which something goes wrong


class Recorder(JointGraph):
    """A joint graph that keeps what it is told."""

    told: list[Edge]
    last: "Recorder"

    def __init__(self, root: VertexId) -> None:
        super().__init__(root)
        self.told = []
        Recorder.last = self

    def update(self, *, add: Iterable[Edge] = (), replace: Iterable[Edge] = (), **rest: Iterable[EdgeId]) -> None:  # type: ignore[override]
        added, replaced = list(add), list(replace)
        self.told += [*added, *replaced]
        super().update(add=added, replace=replaced)
        assert not rest


class Liar(JointGraph):
    """A joint graph that is sure of the wrong thing: it has every other vertex 4 m from where it is."""

    def relatives(self, pairs: Sequence[tuple[VertexId, VertexId]]) -> list[UncertainPose]:
        found = []
        for (a, _), true in zip(pairs, super().relatives(pairs), strict=True):
            here = self.estimate(a)
            pose = here.between(gtsam.Pose2(0.0, 4.0, 0.0)).compose(here).compose(true.pose)
            found.append(UncertainPose(pose, true.covariance + np.diag([0.3, 0.3, 0.1]) ** 2))
        return found


def kinds(result: RunResult) -> Counter[str]:
    return Counter(event.kind for event in result.events)


def own_edges(result: RunResult) -> list[Edge]:
    """Every version of every edge that the robot made; alignments come later and are not its."""
    return [f.edge for f in result.edges if isinstance(f.edge, Edge) and f.edge.kind is not EdgeKind.ALIGNMENT]


def accepted(result: RunResult) -> list[Edge]:
    last = {fate.edge.id: fate.edge.version for fate in result.edges if fate.fate == "accepted"}
    return [edge for edge in own_edges(result) if last.get(edge.id) == edge.version]


@pytest.fixture(scope="module")
def one_lap() -> RunResult:
    return mapped(office_ring(1))


@pytest.fixture(scope="module", params=["joint", "dijkstra"])
def laps(request: pytest.FixtureRequest) -> RunResult:
    """Two laps and a bit, with each of the two projections of M6."""
    return mapped(office_ring(2), small(f"topology.projection={request.param}"))


def check_complete(log: SimulatedLog, result: RunResult) -> None:
    """What holds after every run, however bad the log: a pose and a vertex for every scan, and a sound account."""
    (trajectory,) = result.trajectories.values()
    assert trajectory.poses.shape == (len(log.times), 3)
    assert np.isfinite(trajectory.poses).all()
    assert np.abs(trajectory.poses[:, 2]).max() <= np.pi + 1e-9
    np.testing.assert_allclose(trajectory.poses[0], 0.0, atol=1e-6)  # the joint frame is the first vertex's
    assert set(trajectory.vertices) <= {v.number for v in result.vertex_poses}
    assert result.counts["scans"] == len(log.times)
    assert result.counts["vertices"] == len(result.vertex_poses) == len(result.local_maps)

    taken: set[int] = set()
    for vertex, local in result.local_maps.items():
        assert len(local.scans) == len(local.poses) == len(local.times) > 0
        assert (np.diff(local.scans) >= 0).all()
        taken |= set(local.scans.tolist())
        own = trajectory.vertices[local.scans] == vertex.number
        joint = result.map_poses[vertex]
        found = se2.compose(np.array([joint.x(), joint.y(), joint.theta()]), local.poses)
        once = own & np.isin(local.scans, np.flatnonzero(np.bincount(local.scans) == 1))
        # Scans lie about where their map is drawn; it gives way a little.
        offsets = np.hypot(*(trajectory.poses[local.scans][once] - found[once])[:, :2].T)
        assert offsets.max(initial=0.0) < 0.15
    assert taken == set(range(len(log.times)))

    for fate in result.edges:
        assert fate.fate in ("accepted", "replaced", "refused")
        assert fate.reason or fate.fate == "accepted"
        assert np.isfinite(fate.chi2) or fate.fate != "accepted"
    present = Counter(edge.id for edge in accepted(result))
    assert set(present.values()) <= {1}
    assert {VertexId(v.robot, v.number) for e in accepted(result) for v in (e.tail, e.head)} <= set(result.vertex_poses)
    for event in result.events:
        assert event.detail, event
        if event.kind == "re-entry refused":
            assert event.detail["reason"]
            assert event.detail["vertex"] in {str(v) for v in result.vertex_poses}
    for covariance in result.vertex_covariances.values():
        assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_m1_the_robot_begins_with_one_vertex_at_its_own_pose() -> None:
    roots: list[VertexId] = []

    def make_joint(root: VertexId) -> JointGraph:
        roots.append(root)
        return JointGraph(root)

    events: list[Event] = []
    robot = Robot("red", small(), make_joint, events.append, lambda *visit: None, Stages())
    assert roots == [VertexId("red", 0)]
    assert [v.id for v in robot.topology.vertices] == roots
    robot.process(next(room().scans()))
    robot.finish()
    (vertex,) = robot.topology.vertices
    assert vertex.scans == [0]
    np.testing.assert_allclose(vertex.poses[0], 0.0, atol=1e-9)
    assert vertex.maps is not None
    assert robot.topology.edges == {}
    assert events[-1].robot == "red"


def test_a_robot_that_saw_nothing_ends_without_complaint() -> None:
    robot = Robot("red", small(), JointGraph, lambda event: None, lambda *visit: None, Stages())
    robot.finish()
    assert robot.times == []


def test_m4_a_robot_inside_the_square_stays_in_its_vertex() -> None:
    result = mapped(room())
    check_complete(room(), result)
    assert result.counts["vertices"] == 1
    assert result.edges == []
    assert errors(room(), result).rmse < 0.05


def test_m7_a_vertex_is_made_where_the_robot_leaves_the_square(one_lap: RunResult) -> None:
    check_complete(office_ring(1), one_lap)
    edges = [e for e in accepted(one_lap) if e.kind is EdgeKind.INTER_VERTEX and e.version == 0]
    assert len(edges) >= 4
    for edge in edges:
        assert edge.head.number == edge.tail.number + 1
        reached = max(abs(edge.measurement.x()), abs(edge.measurement.y()))
        assert SIDE / 2 < reached < SIDE / 2 + 0.5
        local = one_lap.local_maps[edge.head]
        np.testing.assert_allclose(local.poses[0], 0.0, atol=0.05)  # the robot is at the origin when it makes it
        assert local.scans[0] in one_lap.local_maps[edge.tail].scans  # one scan belongs to both
    assert kinds(one_lap)["new vertex"] == one_lap.counts["vertices"] - 1


def test_m7_the_edges_agree_with_the_truth_as_well_as_they_claim(one_lap: RunResult) -> None:
    samples = edge_errors(office_ring(1), one_lap)
    assert samples
    for sample in samples:
        assert sample.distance < 0.08, sample.name
        assert abs(sample.error[2]) < np.radians(1.5), sample.name
        assert sample.nees < 16.27 / 3.0, sample.name  # chi2 of 3 degrees of freedom, 99.9 %
        assert np.sqrt(np.diag(sample.covariance))[:2].max() < 0.3, sample.name  # not honest by claiming nothing


def test_a_smaller_square_makes_more_vertices() -> None:
    log = ring(1)
    counts = [mapped(log, small(f"frontend.travel_square={side}")).counts["vertices"] for side in (6, 8, 40)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1] == 1


def test_m8_coming_back_closes_the_loop(laps: RunResult) -> None:
    log = office_ring(2)
    check_complete(log, laps)
    closed = [event for event in laps.events if event.kind == "loop closed"]
    assert closed
    made = {str(fate.edge): fate.edge for fate in laps.edges}
    for event in closed:
        edge = made[event.detail["edge"]]
        assert edge.kind is EdgeKind.LOOP
        assert edge.version == 0
        assert event.detail["vertex"] in (str(edge.tail), str(edge.head))
        assert event.detail["reason"]
    assert laps.counts["edges"] >= laps.counts["vertices"]  # a tree has one less
    assert false_edges(log, laps) == []
    assert errors(log, laps).rmse < 0.05
    assert errors(log, laps).max < 0.25


def test_m3_the_second_lap_is_driven_in_known_vertices(laps: RunResult) -> None:
    """Nearly all of it: no second map of the same place."""
    first = laps.local_maps.values()
    half = len(office_ring(2).times) // 2
    begun_late = [local for local in first if local.scans[0] > half + 60]
    assert begun_late == []
    assert kinds(laps)["re-entered"] >= 3
    visited_again = [local for local in first if local.scans[0] < half < local.scans[-1]]
    assert len(visited_again) >= 4


def test_m5_an_edge_that_is_travelled_again_gets_a_new_version(laps: RunResult) -> None:
    log = office_ring(2)
    updates = [event for event in laps.events if event.kind == "edge updated"]
    assert len(updates) == kinds(laps)["re-entered"] + kinds(laps)["loop closed"]
    fused = [edge for edge in accepted(laps) if edge.kind is EdgeKind.COVARIANCE_INTERSECTION]
    assert len(fused) >= 3
    history: dict[EdgeId, list[Edge]] = {}
    for edge in own_edges(laps):
        history.setdefault(edge.id, []).append(edge)
    for versions in history.values():
        versions.sort(key=lambda edge: edge.version)
        assert [edge.version for edge in versions] == list(range(len(versions)))
        assert {(edge.tail, edge.head) for edge in versions} == {(versions[0].tail, versions[0].head)}
    for fate in laps.edges:
        if fate.edge.id not in history:
            continue
        newest = len(history[fate.edge.id]) - 1
        assert fate.fate == ("accepted" if fate.edge.version == newest else "replaced")
    for sample in edge_errors(log, laps):
        assert sample.distance < 0.15, sample.name


def test_m5_an_edge_may_be_travelled_against_its_direction() -> None:
    log = there_and_back()
    result = mapped(log)
    check_complete(log, result)
    entered = [event.detail["vertex"] for event in result.events if event.kind == "re-entered"]
    fused = [edge for edge in accepted(result) if edge.kind is EdgeKind.COVARIANCE_INTERSECTION]
    assert any(str(edge.tail) in entered for edge in fused)
    for sample in edge_errors(log, result):
        assert sample.distance < 0.15, sample.name
    assert errors(log, result).rmse < 0.05


def test_m8_a_loop_edge_is_measured_again_when_the_visit_it_began_is_over(laps: RunResult) -> None:
    versions = {(edge.id, edge.version): edge for edge in own_edges(laps)}
    loops = [edge for edge in versions.values() if edge.kind is EdgeKind.LOOP and edge.version == 1]
    assert loops
    for edge in loops:
        assert not edge.measurement.equals(versions[edge.id, 0].measurement, 1e-12)


def test_m5_a_loop_that_is_travelled_again_may_still_be_false() -> None:
    log = ring(3, 1)
    loops = [edge for edge in own_edges(mapped(log)) if edge.kind is EdgeKind.LOOP]
    assert {(edge.id, edge.version) for edge in loops} == {(loops[0].id, version) for version in range(3)}


def test_m5_the_weight_of_the_new_estimate_is_omega() -> None:
    """With 0 an edge stays what it was; with 1 it becomes what was measured last."""
    log = ring(2)
    for omega, moves in ((0, False), (1, True)):
        result = mapped(log, small(f"topology.omega={omega}"))
        versions = {(edge.id, edge.version): edge for edge in own_edges(result)}
        fused = [edge for edge in versions.values() if edge.kind is EdgeKind.COVARIANCE_INTERSECTION]
        assert fused
        for edge in fused:
            old = versions[edge.id, edge.version - 1]
            assert old.measurement.equals(edge.measurement, 1e-9) is not moves
            assert np.allclose(old.covariance, edge.covariance, rtol=1e-6) is not moves


def test_m5_two_estimates_that_contradict_each_other_are_less_sure_than_either() -> None:
    covariance = np.diag([0.03, 0.03, 0.005]) ** 2
    old = UncertainPose(gtsam.Pose2(5.0, 0.0, 0.0), covariance)
    for offset, contradicts in ((0.1, False), (0.2, True)):
        new = UncertainPose(gtsam.Pose2(5.0 + offset, 0.0, 0.0), 1.1 * covariance)
        fused = fuse(old, new, "optimal")
        assert (np.linalg.det(fused.covariance) > np.linalg.det(new.covariance)) == contradicts


def test_the_joint_map_is_told_every_version_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mrtm.team.member.JointGraph", Recorder)
    result = mapped(office_ring(2), small("joint.alignments=0"))
    graph = Recorder.last
    told: dict[EdgeId, list[Edge]] = {}
    for edge in graph.told:
        told.setdefault(edge.id, []).append(edge)
    for versions in told.values():
        assert [edge.version for edge in versions] == list(range(len(versions)))
    last = {versions[-1].id: versions[-1] for versions in told.values()}
    assert {edge.id: edge.version for edge in accepted(result)} == {i: edge.version for i, edge in last.items()}
    for vertex, pose in result.vertex_poses.items():
        assert pose.equals(graph.estimate(vertex), 1e-4)  # the result is settled to the last digit


def test_a_loop_bends_the_trajectory_into_shape() -> None:
    """Odometry far out of true: without the loop the ends of the ring lie apart."""
    log = ring(2)
    drift = se2.compose(log.poses[0], log.odometry[-1])[:2] - log.poses[-1][:2]
    assert np.hypot(*drift) > 0.3
    result = mapped(log)
    true = se2.between(log.poses[0], log.poses[-1])
    np.testing.assert_allclose(poses(result)[-1][:2], true[:2], atol=0.05)


@pytest.mark.parametrize("slips", [0.0, 6.0])
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_rooms_that_look_alike_are_not_taken_for_each_other(seed: int, slips: float) -> None:
    log = hotel_visit(seed, slips)
    result = mapped(log)
    check_complete(log, result)
    assert result.counts["vertices"] >= 3
    assert kinds(result)["re-entered"] + kinds(result)["loop closed"] >= 2  # it does come back, where it is right
    assert false_edges(log, result) == []
    assert errors(log, result).rmse < 0.1


@pytest.mark.parametrize("attraction", [0.5, 1.0])
def test_a_reentry_that_does_not_fit_is_undone_and_reported(monkeypatch: pytest.MonkeyPatch, attraction: float) -> None:
    """A joint map 4 m off sends the robot into wrong vertices, and every first scan is good enough for a trial.

    With an attraction of 1 the robot only looks for other vertices at the border: an undone trial makes a vertex. Else
    it also looks before: an undone trial goes on where it was.
    """
    monkeypatch.setattr("mrtm.team.member.JointGraph", Liar)
    log = office_ring(1)
    result = mapped(log, small("topology.entry_score=0.01", f"topology.attraction={attraction}"))
    refused = [event for event in result.events if event.kind == "re-entry refused"]
    undone = [event for event in refused if "the scan does not fit" not in event.detail["reason"]]
    made = [b.kind == "new vertex" for a, b in pairwise(result.events) if a in undone]
    assert all(made) if attraction == 1.0 else not all(made)
    assert made
    check_complete(log, result)
    assert false_edges(log, result) == []
    assert errors(log, result).rmse < 0.05


def test_the_log_may_end_in_the_middle_of_a_trial() -> None:
    """Cut everywhere in the stretch in which the robot re-enters its first vertices."""
    log = ring(2)
    undone = 0
    for scans in range(185, 230, 8):
        part = SimulatedLog(log.times[:scans], log.odometry[:scans], log.poses[:scans], log.ranges[:scans], log.laser)
        result = mapped(part)
        check_complete(part, result)
        assert errors(part, result).rmse < 0.05, scans
        undone += result.events[-1].kind == "left vertex" and kinds(result)["re-entry refused"] > 0
    assert undone


def test_a_long_visit_is_closed_and_goes_on() -> None:
    """A robot that stays in one room for long: the map is closed on the way, and nothing is lost by it."""
    log = room(laps=5)
    result = mapped(log, small("topology.longest_visit=100"))
    assert kinds(result)["left vertex"] >= 3
    check_complete(log, result)
    assert result.counts["vertices"] == 1
    assert errors(log, result).rmse < 0.05


def test_closing_a_map_on_the_way_makes_nobody_surer() -> None:
    log = office_ring(1, laser=replace(LMS200, rate=15.0))
    results = [mapped(log, small("frontend.travel_square=14", f"topology.longest_visit={n}")) for n in (100, 1500)]
    assert kinds(results[0])["left vertex"] > kinds(results[1])["left vertex"]
    closed, whole = (np.sqrt(np.linalg.det(accepted(result)[0].covariance)) for result in results)
    assert closed > 0.6 * whole


def test_a_robot_that_stands_still_stays_where_it_is() -> None:
    log = room()
    scans = [replace(scan, odometry=np.zeros(3)) for scan in log.scans()]
    still = [replace(scans[0], time=scan.time) for scan in scans]
    result = mapped(log, scans=still)
    check_complete(log, result)
    assert np.abs(poses(result)).max() < 0.02
    assert kinds(result) == {"left vertex": 1}


def test_wheel_slips_are_survived() -> None:
    log = ring(2, 2, OdometryNoise(slips_per_minute=6))
    result = mapped(log)
    check_complete(log, result)
    assert errors(log, result).rmse < 0.1


@pytest.mark.parametrize("seed", [2, 3])
def test_stretches_of_odometry_with_the_wrong_sign_do_not_stop_the_run(seed: int) -> None:
    log = ring(2, seed, OdometryNoise(reversals_per_minute=3))
    check_complete(log, mapped(log))


@pytest.mark.parametrize("seed", [1, 4, 5])
def test_stretches_of_odometry_with_the_wrong_sign_are_corrected(seed: int) -> None:
    """Where the scans tell: those of the other seeds are also of walls that look the same all the way."""
    log = ring(2, seed, OdometryNoise(reversals_per_minute=3))
    result = mapped(log)
    assert kinds(result)["odometry reversed"] > 4
    assert errors(log, result).rmse < 0.05


@pytest.mark.parametrize("jump", [(1.0, 0.5, 0.2), (0.0, 0.0, 1.0), (-1.5, 0.0, 0.0)])
def test_a_jump_of_the_odometry_is_noticed_and_undone(jump: tuple[float, float, float]) -> None:
    log = jumped(office_ring(2), JUMP, jump)
    result = mapped(log)
    check_complete(log, result)
    noticed = [event for event in result.events if event.kind == "searched wider"]
    assert any(abs(event.time - log.times[JUMP]) < 1.0 for event in noticed)
    assert false_edges(log, result) == []
    assert errors(log, result).rmse < 0.05


def test_after_a_jump_out_of_the_building_both_parts_are_sound() -> None:
    log = jumped(office_ring(2), JUMP, (300.0, -100.0, 2.0))
    result = mapped(log)
    check_complete(log, result)
    assert errors(log, result, slice(0, JUMP)).rmse < 0.05
    assert errors(log, result, slice(JUMP + 60, None)).rmse < 0.1


def test_a_kidnapped_robot_maps_on() -> None:
    """Nothing tells that it was carried, 9 m away: the maps before and well after are sound."""
    log = kidnapped(office_ring(2), JUMP, JUMP + 60)
    assert np.hypot(*(log.poses[JUMP] - log.poses[JUMP - 1])[:2]) > 5.0
    result = mapped(log)
    check_complete(log, result)
    assert errors(log, result, slice(0, JUMP)).rmse < 0.1
    assert errors(log, result, slice(JUMP + 60, None)).rmse < 0.3


def changed(log: SimulatedLog, change: Callable[[int, LaserScan], LaserScan]) -> Iterator[LaserScan]:
    for index, scan in enumerate(log.scans()):
        yield change(index, scan)


def test_a_clock_that_steps_back_changes_nothing_but_the_times() -> None:
    log = ring(2)
    steady = mapped(log)
    stepping = mapped(log, scans=changed(log, lambda i, s: replace(s, time=s.time - 100.0 * (i % 50 >= 25))))
    (trajectory,) = stepping.trajectories.values()
    np.testing.assert_array_equal(trajectory.poses, poses(steady))
    assert (np.diff(trajectory.times) < 0).any()
    assert [e.kind for e in stepping.events] == [e.kind for e in steady.events]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_blinded_laser_is_carried_by_odometry(value: float) -> None:
    """Four seconds without a single echo, then a whole log."""
    log = ring(2)

    def blind(index: int, scan: LaserScan) -> LaserScan:
        return replace(scan, ranges=np.full_like(scan.ranges, value)) if 150 <= index < 170 else scan

    result = mapped(log, scans=changed(log, blind))
    check_complete(log, result)
    assert errors(log, result).rmse < 0.3

    nothing = mapped(log, scans=changed(log, lambda i, s: replace(s, ranges=np.full_like(s.ranges, value))))
    check_complete(log, nothing)
    assert kinds(nothing)["loop closed"] == 0  # what shows nothing proves nothing
    np.testing.assert_allclose(poses(nothing)[:, :2], log.odometry[:, :2], atol=0.5)


def test_events_come_in_the_order_of_the_log_except_where_a_trial_was_undone(laps: RunResult) -> None:
    times = set(office_ring(2).times.tolist())
    assert all(event.time in times for event in laps.events)
    backward = [b for a, b in pairwise(laps.events) if b.time < a.time]
    assert len(backward) <= kinds(laps)["re-entry refused"]
