"""What one robot of a team would tell the others, and when: on small simulated logs whose truth is known."""

from collections import defaultdict
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from frontend import se2
from frontend.records import FloatArray, LaserScan
from mrtm.joint.joint_map import JointMap
from mrtm.robot.poses import array_of
from mrtm.session import map_scans
from mrtm.team.member import GAP, MemberRun, map_member
from mrtm.team.playback import play
from mrtm.team.records import AnchorRecord, EdgeRecord, MapRecord, VertexRecord
from mrtm.team.store import Store
from tests.mrtm.small_logs import office_ring, ring, room, small
from tools.simulation import SimulatedLog

START = 100.0  # team time of the first scan


def team_times(log: SimulatedLog) -> FloatArray:
    return np.asarray(START + log.times - log.times[0])


def scans(log: SimulatedLog) -> list[tuple[float, LaserScan]]:
    return list(zip(team_times(log).tolist(), log.scans(), strict=True))


def anchors(run: MemberRun) -> dict[int, list[AnchorRecord]]:
    """By number, in the order in which they were told."""
    found: defaultdict[int, list[AnchorRecord]] = defaultdict(list)
    for record in run.records:
        if isinstance(record, AnchorRecord):
            found[record.number].append(record)
    return dict(found)


@cache
def furnished() -> tuple[SimulatedLog, MemberRun, list[float]]:
    """Rounds in one room, with a hole of GAP and more in the log; moments of every sort."""
    log = room()
    times = team_times(log)
    hole = len(times) // 2
    kept = [scan for scan in scans(log) if not times[hole] < scan[0] <= times[hole] + GAP + 1.0]
    moments = [
        START - 10.0,  # 0: before the first scan
        START,  # 1: at the first
        0.5 * (times[20] + times[21]),  # 2: between two
        float(times[30]),  # 3: at one
        times[hole] + 2.0,  # 4: in the hole
        0.3 * times[-20] + 0.7 * times[-19],  # 5: after the hole
        float(times[-1]),  # 6: at the last
        times[-1] + 0.1,  # 7: after it
    ]
    return log, map_member("red", kept, small(), moments), moments


@pytest.mark.parametrize(
    ("number", "known"), [(0, False), (1, True), (2, True), (3, True), (4, False), (5, True), (6, True), (7, False)]
)
def test_an_anchor_for_every_moment_at_which_the_robot_had_scans(number: int, known: bool) -> None:
    log, run, moments = furnished()
    assert (number in anchors(run)) == known
    if known:
        at = moments[number] - START + log.times[0]
        truth = np.array([np.interp(at, log.times, column) for column in np.unwrap(log.poses, axis=0).T])
        seen = array_of(anchors(run)[number][-1].pose.pose)
        off = se2.between(se2.between(log.poses[0], truth), seen)
        assert np.hypot(*off[:2]) < 0.08
        assert abs(off[2]) < 0.03


def test_an_anchor_is_rough_at_once_and_refined_when_its_map_closes() -> None:
    _, run, moments = furnished()
    closed = [r.time for r in run.records if isinstance(r, MapRecord)]
    for number, told in anchors(run).items():
        versions = [record.version for record in told]
        if number == 6:  # first told when the log ends, with which the map closes
            assert versions == [1]
            continue
        assert versions == list(range(len(told)))
        assert len(told) >= 2
        assert moments[number] < told[0].time <= moments[number] + 0.5
        assert all(record.time in closed for record in told[1:])
        assert all((np.linalg.eigvalsh(record.pose.covariance) > 0).all() for record in told)


@cache
def twice_round() -> tuple[SimulatedLog, MemberRun, list[float]]:
    """Twice round an office ring, a moment between any two scans."""
    log = office_ring(2)
    times = team_times(log)
    moments = (0.5 * (times[1:] + times[:-1])).tolist()
    return log, map_member("red", scans(log), small(), moments), moments


def test_in_the_end_every_anchor_lies_where_the_scan_before_it_does() -> None:
    """Whatever happened in between: re-entries on trial, accepted or refused, visits resumed."""
    log, run, moments = twice_round()
    found = anchors(run)
    assert sorted(found) == list(range(len(moments)))
    refined = {number: told[-1] for number, told in found.items()}
    assert all(record.version >= 1 for record in refined.values())
    increments = 0.5 * se2.between(log.odometry[:-1], log.odometry[1:])
    for number, record in refined.items():
        lying = run.local_maps[record.vertex]  # at the seam of two visits a scan lies in both maps
        (place,) = np.flatnonzero(lying.scans == number)
        expected = se2.compose(lying.poses[place], increments[number])
        np.testing.assert_allclose(se2.between(expected, array_of(record.pose.pose)), 0.0, atol=1e-6)


def test_while_a_re_entry_is_on_trial_anchors_wait() -> None:
    _, run, moments = twice_round()
    found = anchors(run)
    late = [n for n, told in found.items() if told[0].time > moments[n] + 0.5]
    assert any(event.kind in ("loop closed", "re-entered", "re-entry refused") for event in run.events)
    assert len(late) >= 8  # scans a trial takes at least
    for number in late:
        assert found[number][0].time < moments[number] + 60.0
        assert number in run.local_maps[found[number][0].vertex].scans


def test_an_anchor_comes_after_its_vertex_and_an_edge_after_its_ends() -> None:
    """So that whoever has heard all up to some time can place everything."""
    _, run, _ = twice_round()
    assert [r.time for r in run.records] == sorted(r.time for r in run.records)
    known: dict[object, float] = {}
    for record in run.records:
        if isinstance(record, VertexRecord):
            known.setdefault(record.id, record.time)
    for record in run.records:
        if isinstance(record, AnchorRecord):
            assert known[record.vertex] <= record.time
        if isinstance(record, EdgeRecord):
            assert max(known[record.edge.tail], known[record.edge.head]) <= record.time


def test_versions_count_up_and_the_last_ones_are_what_the_robot_ends_with() -> None:
    _, run, _ = twice_round()
    versions: defaultdict[object, list[int]] = defaultdict(list)
    for record in run.records:
        versions[record.key].append(record.version)
    assert all(b > a for told in versions.values() for a, b in pairwise(told))
    store = Store()
    store.merge(run.records)
    assert {v.id: v.scans for v in store.of(VertexRecord)} == {v: len(m.scans) for v, m in run.local_maps.items()}
    assert {m.vertex for m in store.of(MapRecord)} == run.local_maps.keys()
    joint = JointMap()
    joint.learn([r.edge for r in run.records if isinstance(r, EdgeRecord)], ["red"])
    assert set(joint.robots["red"].vertices()) == set(run.local_maps)


def test_others_do_not_change_what_a_robot_makes_of_its_log() -> None:
    """Moments are only listened to."""
    log, run, _ = twice_round()
    alone = map_member("red", scans(log), small())
    np.testing.assert_array_equal(run.poses, alone.poses)
    told = [r for r in run.records if not isinstance(r, AnchorRecord)]
    assert [(r.key, r.version, r.time) for r in told] == [(r.key, r.version, r.time) for r in alone.records]


def test_a_team_of_one_is_the_single_log() -> None:
    log = ring(1)
    run = map_member("robot", scans(log), small())
    team, single = play([run], (), small()), map_scans(log.scans(), small())
    np.testing.assert_array_equal(team.trajectories["robot"].poses, single.trajectories["robot"].poses)
    assert team.vertex_poses.keys() == single.vertex_poses.keys()
    assert all(pose.equals(single.vertex_poses[v], 0.0) for v, pose in team.vertex_poses.items())
    assert team.team is None
    assert single.team is None


def test_a_log_without_a_scan_leaves_nothing() -> None:
    with pytest.raises(ValueError, match="no scan"):
        map_scans([], small())
    run = map_member("red", [], small(), [1.0])
    assert run.records == []
    assert len(run.times) == 0


def test_a_clock_that_steps_back_does_not_move_team_time() -> None:
    log = room()
    stepped = [(time - 5.0 * (n >= 60), scan) for n, (time, scan) in enumerate(scans(log)[:120])]
    run = map_member(
        "red", stepped, small(), [float(team_times(log)[30]) + 0.01, float(team_times(log)[100]) - 5.0 + 0.01]
    )
    assert [r.time for r in run.records] == sorted(r.time for r in run.records)
    assert sorted(anchors(run)) == [0, 1]
