"""Teams played by one clock: who meets when, what that costs, what comes of it, and what the run says of it."""

import io
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from factors import VertexId, edge_from_dict
from mrtm.evaluation import evaluate_output
from mrtm.joint.sightings.hypotheses import Hypothesis
from mrtm.output.export import export
from mrtm.output.report import run_report
from mrtm.result import RunResult, TeamStory
from mrtm.team import playback
from mrtm.team.exchange import Traffic, exchange
from mrtm.team.member import MemberRun
from mrtm.team.playback import LINGER, play
from mrtm.team.records import AnchorRecord, Kind
from mrtm.team.sightings_file import sighting_times
from mrtm.team.store import Store
from tests.mrtm.sighting_world import TeamWorld
from tests.mrtm.team_world import BETWEEN, NO_MAPS, chain, run_of, timed, told
from tools.simulation import write_tum

Moments = list[tuple[float, Hypothesis]]


def moments(world: TeamWorld) -> Moments:
    """When the sightings were made: each at a time of its own, when both robots have been where they are anchored."""
    found = []
    for place, h in enumerate(world.hypotheses):
        later = max(h.observer.number, h.observed.number)
        found.append((BETWEEN * (1 + later) + 0.1 * place, h))
    return sorted(found, key=lambda m: m[0])


def runs(world: TeamWorld, when: Moments) -> list[MemberRun]:
    return [run_of(world, name, [m for m in when if name in m[1].robots]) for name in world.names]


def played(world: TeamWorld, names: Sequence[str] = ()) -> RunResult:
    when = moments(world)
    made = {run.robot: run for run in runs(world, when)}
    return play([made[name] for name in names or world.names], timed(when), NO_MAPS)


@cache
def three() -> tuple[TeamWorld, RunResult]:
    """r0 and r1, r1 and r2 saw each other often; one sighting is false."""
    world = chain(11, 3, sightings=8)
    world.sight("r0", "r1", 1, false=1.0)
    return world, played(world)


def story(result: RunResult) -> TeamStory:
    assert result.team is not None
    return result.team


# Verdicts.


def test_the_first_meetings_wait_and_later_ones_are_accepted() -> None:
    _, result = three()
    for pair in (("r0", "r1"), ("r1", "r2")):
        verdicts = [m.verdict for m in story(result).meetings if m.robots == pair]
        assert verdicts[0] == "waiting"
        assert verdicts[-1] == "accepted"
        assert verdicts == sorted(verdicts, reverse=True)  # nothing is unlearned
    first = story(result).meetings[0]
    assert "at least 4 must" in first.reason
    assert "sightings of r0 and r1 agree" in next(m for m in story(result).meetings if m.verdict == "accepted").reason


def test_every_sighting_has_its_fate_with_reason_and_numbers() -> None:
    world, result = three()
    fates = story(result).sightings
    assert [(f.observer, f.observed) for f in fates] == [(s.observer, s.observed) for s in timed(moments(world))]
    for (time, h), fate in zip(moments(world), fates, strict=True):
        assert fate.time == time
        assert fate.fate == ("accepted" if h.id in world.true else "refused")
        assert fate.numbers["support"] >= (8 if h.id in world.true else 1)
        assert (fate.numbers["chi2"] < 16.3) == (h.id in world.true)
        assert fate.reason


def test_false_sightings_alone_are_refused_once_the_robots_are_joined_through_others() -> None:
    world = chain(11, 3, sightings=8)
    world.sight("r0", "r2", 3, false=1.0)
    result = played(world)
    between = [m for m in story(result).meetings if m.robots == ("r0", "r2")]
    assert between[-1].verdict in ("refused", "waiting")
    fates = {f.fate for f in story(result).sightings if {f.observer, f.observed} == {"r0", "r2"}}
    assert fates == {"refused"}
    assert len(result.components) == 1


def test_the_common_frame_is_when_somebody_first_had_all_in_it() -> None:
    world, result = three()
    team = story(result)
    assert team.first_meeting == team.meetings[0].time
    last = max(
        min(m.time for m in team.meetings if m.robots == p and m.verdict == "accepted")
        for p in (("r0", "r1"), ("r1", "r2"))
    )
    assert team.common_frame is not None
    assert last <= team.common_frame <= team.meetings[-1].time
    assert team.known["r1"] == dict.fromkeys(world.names, world.vertices)
    assert set(team.known) == set(world.names)


# Meetings.


def test_robots_exchange_when_they_see_each_other_every_interval_and_at_the_end() -> None:
    world = chain(3, 2, sightings=1)
    seen = timed([(0.0, world.hypotheses[0])])[0]
    mutual = replace(seen, observer=seen.observed, observed=seen.observer)
    times = [10.0, 11.0, 12.0, 15.5, 18.0, 21.0, 30.0]
    sightings = [replace(seen, time=t) for t in times] + [replace(mutual, time=11.5)]
    result = play(runs(world, []), sightings, NO_MAPS)
    assert [m.time - LINGER for m in story(result).meetings] == [10.0, 15.5, 21.0, 30.0]
    assert {m.robots for m in story(result).meetings} == {("r0", "r1")}


def test_bytes_by_kind_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Traffic] = []

    def listening(a: Store, b: Store) -> Traffic:
        told.append(exchange(a, b))
        return told[-1]

    monkeypatch.setattr(playback, "exchange", listening)
    world = chain(11, 3, sightings=8)
    meetings = story(played(world)).meetings
    assert [sum(m.bytes.values()) for m in meetings] == [t.total for t in told]
    assert all(set(m.bytes) <= {"digest", *Kind} for m in meetings)
    assert meetings[0].bytes["edge"] > 0


def test_nothing_is_known_before_it_happens() -> None:
    """What a robot records after a meeting does not travel with it."""
    world = chain(11, 2, sightings=8)
    when = moments(world)
    early = [m for m in when if m[0] < 45.0]
    until = early[-1][0] + LINGER
    made = runs(world, when)
    later = [
        replace(r, told=told(x if x.time <= until else replace(x, time=x.time + 999.0) for x in r.records))
        for r in made
    ]
    expected, found = (story(play(some, timed(when), NO_MAPS)).meetings for some in (made, later))
    count = sum(m.time <= until for m in expected)
    assert count > 1
    assert [(m.time, m.verdict, m.reason) for m in found[:count]] == [
        (m.time, m.verdict, m.reason) for m in expected[:count]
    ]
    assert all(f.bytes.keys() == e.bytes.keys() for f, e in zip(found[:count], expected, strict=False))
    assert found[count:] != expected[count:]


@pytest.mark.parametrize("names", [("r2", "r0", "r1"), ("r1", "r2", "r0")])
def test_the_order_of_the_robots_in_the_session_does_not_matter(names: tuple[str, ...]) -> None:
    world, result = three()
    other = played(world, names)
    assert list(other.trajectories) == list(names)
    assert other.components == result.components
    for vertex, pose in result.vertex_poses.items():
        assert other.vertex_poses[vertex].equals(pose, 0.0)
    for name in names:
        np.testing.assert_array_equal(other.trajectories[name].poses, result.trajectories[name].poses)
    mine, others = story(result), story(other)
    assert (mine.meetings, mine.sightings, mine.common_frame, mine.known) == (
        others.meetings,
        others.sightings,
        others.common_frame,
        others.known,
    )


def test_the_same_team_played_twice_in_one_process_is_the_same() -> None:
    """Nothing is left behind of what an earlier run concluded."""
    world, result = three()
    again = played(world)
    assert story(again) == story(result)
    assert all(again.vertex_poses[v].equals(pose, 0.0) for v, pose in result.vertex_poses.items())


# Robots that do not meet, or hardly.


@cache
def apart() -> tuple[TeamWorld, RunResult]:
    """r2 met nobody, r3 only r1, which met r0."""
    world = TeamWorld(7, 4)
    world.sight("r0", "r1", 7)
    world.sight("r1", "r3", 7)
    return world, played(world)


def test_a_robot_that_met_nobody_stays_a_component_and_the_run_says_so(tmp_path: Path) -> None:
    world, result = apart()
    assert [{v.robot for v in c} for c in result.components] == [{"r0", "r1", "r3"}, {"r2"}]
    assert result.components[1][0] == VertexId("r2", 0)
    assert story(result).known["r2"] == {"r2": world.vertices}
    console = Console(width=120, record=True, file=io.StringIO())
    for part in run_report(result):
        console.print(part)
    text = console.export_text()
    assert "2 maps: these robots never came into one" in text
    assert "6 vertices in one map: r2" in text
    export(result, tmp_path)
    run = json.loads((tmp_path / "run.json").read_text())
    assert [sorted({robot for robot, _ in c}) for c in run["components"]] == [["r0", "r1", "r3"], ["r2"]]
    assert {name: robot["component"] for name, robot in run["robots"].items()} == {"r0": 0, "r1": 0, "r3": 0, "r2": 1}
    assert {"map.png", "map-1.png"} <= {path.name for path in tmp_path.iterdir()}


def test_who_met_one_robot_hears_of_all_that_this_one_met() -> None:
    world, result = apart()
    assert {m.robots for m in story(result).meetings} == {("r0", "r1"), ("r1", "r3")}
    known = story(result).known["r1"]
    assert known == dict.fromkeys(("r0", "r1", "r3"), world.vertices)
    last = {name: max(m.time for m in story(result).meetings if name in m.robots) for name in ("r0", "r3")}
    later = max(last, key=lambda name: last[name])
    assert set(story(result).known[later]) == {"r0", "r1", "r3"}


def test_a_team_without_sightings() -> None:
    world = TeamWorld(7, 2)
    result = played(world)
    team = story(result)
    assert (team.meetings, team.sightings, team.first_meeting, team.common_frame) == ([], [], None, None)
    assert team.known == {name: {name: world.vertices} for name in world.names}
    assert len(result.components) == 2


def test_a_robot_alone_is_no_team() -> None:
    result = play([run_of(TeamWorld(7, 1), "r0")], (), NO_MAPS)
    assert result.team is None
    assert len(result.components) == 1


# Sightings that nobody has a place for.


@pytest.mark.parametrize("when", [0.0, 0.2, 5.0, 3000.0])
def test_a_sighting_of_a_robot_that_does_not_run_is_refused_and_nothing_else_suffers(when: float) -> None:
    """Before its first scan, after its last, or at a time when it has none; r0 starts late."""
    world = chain(11, 3, sightings=8)
    times = moments(world)
    made = runs(world, times)
    made[0] = replace(made[0], told=told(r for r in made[0].records if r.time >= 10.0 or r.kind is not Kind.VERTEX))
    first = timed([(when, h) for _, h in times if h.robots == ("r0", "r1")])[0]
    sightings = [first, *timed(times)]
    sightings.sort(key=lambda s: s.time)
    numbers = {name: {t: n for n, t in enumerate(sighting_times(sightings, name))} for name in world.names}
    for run in made:  # the anchors keep their times, and so have other numbers
        run.told = told(
            replace(r, number=numbers[run.robot][r.time]) if isinstance(r, AnchorRecord) else r for r in run.records
        )
    result = play(made, sightings, NO_MAPS)
    fates = {f.time: f for f in story(result).sightings}
    assert fates[when].fate == "refused"
    assert "no scan at that time" in fates[when].reason
    assert {f.fate for t, f in fates.items() if t != when} == {"accepted"}
    assert len(result.components) == 1
    meeting = next(m for m in story(result).meetings if m.time == when + LINGER)
    if when < 10.0:
        assert (meeting.verdict, meeting.reason) == ("waiting", "where the robots were is not known yet")


def test_progress_is_told_and_stays_within_bounds() -> None:
    told: list[float] = []
    world = chain(11, 2, sightings=8)
    when = moments(world)
    play(runs(world, when), timed(when), NO_MAPS, told.append)
    assert told == sorted(told)
    assert all(0.0 <= fraction <= 1.0 for fraction in told)
    assert told


# What run.json says.


def test_a_team_without_headings_is_exported_evaluated_and_told(tmp_path: Path) -> None:
    """Its edges of single ranges and bearings have no pose and no 3 x 3 covariance."""
    world = chain(2, 3, sightings=9, headings=False)
    result = played(world)
    assert len(result.components) == 1
    kinds = [str(fate.edge.kind) for fate in result.edges if fate.fate == "accepted"]
    assert "sighting" in kinds
    export(result, tmp_path)
    entries = json.loads((tmp_path / "run.json").read_text())["edges"]
    assert [e["kind"] for e in entries if e["fate"] == "accepted"] == kinds
    seen = next(e for e in entries if e["kind"] == "sighting")
    assert edge_from_dict(seen).to_dict()["range_bearing"] == seen["range_bearing"]
    for name, trajectory in result.trajectories.items():
        root = world.truth[VertexId(name, 0)]
        true = [root.compose(root.between(world.truth[VertexId(name, int(i))])) for i in trajectory.vertices]
        write_tum(trajectory.times, np.array([[p.x(), p.y(), p.theta()] for p in true]), tmp_path / f"{name}.tum")
    evaluation = evaluate_output(tmp_path, truth={name: tmp_path / f"{name}.tum" for name in world.names})
    (ate,) = evaluation.ate
    assert ate.translation.rmse < 1.0
    assert evaluation.edges is not None
    assert set(evaluation.edges) == set(kinds) - {"sighting"}
    console = Console(width=120, record=True, file=io.StringIO())
    for part in run_report(result):
        console.print(part)
    assert "sighting" in console.export_text()


def test_every_update_of_a_joint_map_has_its_latency_by_stage(tmp_path: Path) -> None:
    world, result = three()
    *updates, at_the_end = result.latencies
    assert {latency.robot for latency in updates} == set(world.names)
    times = [m.time for m in story(result).meetings]
    for latency in updates:
        met = [m for m in story(result).meetings if m.time == latency.time and latency.robot in m.robots]
        assert len(met) == 1
        assert set(latency.seconds) <= {"exchange", "judging", "joint map", "alignment"}
        assert all(seconds > 0.0 for seconds in latency.seconds.values())
        assert "exchange" in latency.seconds
        assert 0 < latency.vertices <= len(result.vertex_poses)
    assert (at_the_end.robot, at_the_end.time) == (None, times[-1])
    assert at_the_end.vertices == len(result.vertex_poses)
    stages = {stage for latency in result.latencies for stage in latency.seconds}
    for stage in stages:
        assert sum(latency.seconds.get(stage, 0.0) for latency in (*updates[::2], at_the_end)) <= result.timings[stage]
    export(result, tmp_path)
    written = json.loads((tmp_path / "run.json").read_text())["latencies"]
    assert [entry["robot"] for entry in written] == [latency.robot for latency in result.latencies]
    console = Console(width=120, record=True, file=io.StringIO())
    for part in run_report(result):
        console.print(part)
    _, _, table = console.export_text().partition("from a meeting to the joint estimate, ms")
    row = next(line for line in table.splitlines() if "together" in line)
    worst = 1e3 * max(sum(latency.seconds.values()) for latency in updates)
    assert [cell.strip() for cell in row.split("│")[-3:-1]] == [f"{worst:.1f}", str(len(updates))]


def test_run_json_tells_meetings_and_fates(tmp_path: Path) -> None:
    _, result = three()
    export(result, tmp_path)
    team = json.loads((tmp_path / "run.json").read_text())["team"]
    expected = story(result)
    assert set(team) == {"meetings", "sightings", "first_meeting", "common_frame", "known"}
    for entry, meeting in zip(team["meetings"], expected.meetings, strict=True):
        assert entry == {
            "time": pytest.approx(meeting.time),
            "robots": list(meeting.robots),
            "bytes": meeting.bytes,
            "verdict": meeting.verdict,
            "reason": meeting.reason,
        }
    for entry, fate in zip(team["sightings"], expected.sightings, strict=True):
        assert (entry["observer"], entry["observed"], entry["fate"]) == (fate.observer, fate.observed, fate.fate)
        assert entry["reason"] == fate.reason
        assert entry["numbers"] == pytest.approx(fate.numbers)
    assert [entry["fate"] for entry in team["sightings"]].count("refused") == 1
    assert team["known"] == expected.known
    assert team["first_meeting"] == pytest.approx(expected.first_meeting)
