"""Teams in the simulator: what robots see of each other against truth, and the session that is written."""

import gzip
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from frontend.readers import open_log
from frontend.records import FloatArray
from mrtm.evaluation.trajectory import read_tum
from mrtm.team.session_file import open_session, read_session
from tools.simulate import app
from tools.simulation import (
    LMS200,
    FloorPlan,
    LaserModel,
    SightingModel,
    SimulatedSighting,
    SimulatedTeam,
    SimulationError,
    blocks,
    divided,
    false_sightings,
    robot_names,
    simulate_team,
    true_sightings,
    wings,
    write_plan,
)
from tools.simulation.laser import BODY, measure
from tools.simulation.poses import between, wrapped
from tools.simulation.raycast import cast, shade
from tools.simulation.sightings import in_sight, write_sightings

DEMO = Path(__file__).parents[2] / "data" / "demo"
# Red drives east in the lower half, blue west in the upper half and green stays near; a wall with a gap between them.
HALL = FloorPlan(
    "hall",
    [(0, 0, 24, 0), (24, 0, 24, 10), (24, 10, 0, 10), (0, 10, 0, 0), (0, 5, 8, 5), (16, 5, 24, 5)],
    routes={
        "red": [(1, 3), (22, 3), (20, 1.5)],
        "blue": [(18, 7, 3.0), (2, 7)],
        "green": [(12, 8.5), (12, 8.0, 30.0), (12, 8.4)],
    },
)
SHARP = SightingModel(max_range=9.0, rate=2.0, sigma_range=1e-9, sigma_bearing=1e-9, sigma_heading=1e-9)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def hall_team(seed: int = 1, start_every: float = 2.3) -> SimulatedTeam:
    return simulate_team(HALL, ["red", "blue", "green"], seed=seed, start_every=start_every)


def true_relative(team: SimulatedTeam, sighting: SimulatedSighting) -> FloatArray:
    at = np.array([sighting.time])
    poses = {robot.name: robot.at(at)[0] for robot in team.robots}
    return between(poses[sighting.observer], poses[sighting.observed])


def test_a_disc_has_the_range_of_its_closed_form() -> None:
    pose = np.array([(1.0, 2.0, 0.7)])
    bearings = -np.pi + np.pi / 360 * np.arange(720)
    discs = np.array([[(4.0, 3.0), (-3.0, 2.0), (1.3, 2.1)]])  # ahead, across the seam of the fan, and too near
    ranges = np.full((1, 720), np.inf)
    shade(ranges, discs, 0.25, pose, -np.pi, np.pi / 360)
    expected = np.full(720, np.inf)
    for centre in discs[0, :2]:
        way = centre - pose[0, :2]
        direction = np.column_stack((np.cos(0.7 + bearings), np.sin(0.7 + bearings)))
        along = direction @ way
        inside = 0.25**2 - (way @ way - along**2)
        hit = (inside >= 0) & (along > 0)
        expected[hit] = np.minimum(expected[hit], along[hit] - np.sqrt(inside[hit]))
    assert np.isfinite(expected).sum() > 10
    np.testing.assert_allclose(ranges[0], expected, rtol=1e-9)


def test_a_reach_changes_nothing_within_it() -> None:
    segments = rng(3).uniform(-10, 10, (60, 4))
    poses = rng(4).uniform(-8, 8, (20, 3))
    whole, near = (cast(segments, poses, -np.pi, np.pi / 90, 180, reach) for reach in (np.inf, 3.0))
    assert (whole < 3.0).any()
    assert (whole > 3.0).any()
    np.testing.assert_array_equal(near[whole <= 3.0], whole[whole <= 3.0])
    assert (near >= whole).all()


def test_a_robot_stands_in_the_other_ones_scans_where_it_is_at_that_time() -> None:
    team = replace(hall_team(), laser=LMS200.exact())
    red, others = team.robots[0], team.robots[1:]
    log = next(team.log(red))
    alone = measure(team.laser, HALL.segments, log.poses, rng())
    shaded = (log.ranges < alone - 1e-3).nonzero()
    assert len(shaded[0]) > 100
    team_times = red.start + log.times - log.times[0]
    bearings = team.laser.record().angles[shaded[1]] + log.poses[shaded[0], 2]
    ends = log.poses[shaded[0], :2] + log.ranges[shaded][:, None] * np.column_stack(
        (np.cos(bearings), np.sin(bearings))
    )
    away = [np.hypot(*(ends - other.at(team_times[shaded[0]])[:, :2]).T) for other in others]
    np.testing.assert_allclose(np.min(away, axis=0), BODY, atol=1e-4)
    assert all((distance < BODY + 1e-3).any() for distance in away)


def test_before_its_start_and_after_its_end_a_robot_stands_still() -> None:
    blue = hall_team().robots[1]
    assert blue.start == 2.3
    np.testing.assert_allclose(blue.at(np.array([0.0, blue.start]))[:, :2], [(18, 7), (18, 7)])
    np.testing.assert_allclose(*blue.at(np.array([blue.end + 1.0, blue.end + 99.0])))


def test_sightings_without_noise_are_the_true_relative_poses() -> None:
    team = hall_team()
    sightings = true_sightings(team, SHARP, seed=1)
    assert {(s.observer, s.observed) for s in sightings} >= {("red", "blue"), ("blue", "red"), ("red", "green")}
    assert [s.time for s in sightings] == sorted(s.time for s in sightings)
    for sighting in sightings:
        x, y, theta = true_relative(team, sighting)
        assert sighting.range == pytest.approx(np.hypot(x, y), abs=1e-6)
        assert sighting.bearing == pytest.approx(np.arctan2(y, x), abs=1e-6)
        assert sighting.heading is not None
        assert wrapped(np.array(sighting.heading - theta)) == pytest.approx(0, abs=1e-6)
        assert sighting.range < SHARP.max_range
        assert abs(sighting.bearing) <= np.pi / 2 + 1e-6
        for name in (sighting.observer, sighting.observed):
            robot = next(robot for robot in team.robots if robot.name == name)
            assert robot.start <= sighting.time <= robot.end


def test_sightings_come_at_their_rate() -> None:
    team = hall_team()
    pair = [s.time for s in true_sightings(team, SHARP, 1) if (s.observer, s.observed) == ("red", "blue")]
    slow = [s.time for s in true_sightings(team, replace(SHARP, rate=1.0), 1) if s.observer == "red"]
    assert np.diff(pair).min() == pytest.approx(0.5)
    assert set(slow) <= {s.time for s in true_sightings(team, SHARP, 1) if s.observer == "red"}


def test_walls_and_robots_hide_a_robot() -> None:
    """The wall along y = 5 is open for x from 8 to 16 only: red sees green if the line between passes there."""
    team = hall_team()
    red, blue, green = team.robots
    times = np.arange(5.0, min(robot.end for robot in team.robots), 0.05)
    eyes, others, target = (robot.at(times) for robot in (red, blue, green))
    way, aside = (target - eyes)[:, :2], (others - eyes)[:, :2]
    at_wall = eyes[:, 0] + (5 - eyes[:, 1]) / way[:, 1] * way[:, 0]
    ahead = np.cos(eyes[:, 2]) * way[:, 0] + np.sin(eyes[:, 2]) * way[:, 1]
    offset = np.abs(way[:, 0] * aside[:, 1] - way[:, 1] * aside[:, 0]) / np.hypot(*way.T)
    between_them = (np.hypot(*aside.T) < np.hypot(*way.T)) & ((way * aside).sum(axis=1) > 0)
    walled, robbed, behind = np.abs(at_wall - 12) > 4.2, between_them & (offset < BODY - 0.05), ahead < -0.1
    free = (np.abs(at_wall - 12) < 3.8) & (ahead > 0.1) & ~(between_them & (offset < BODY + 0.05))
    visible = in_sight(team, red, green, times)
    assert min(walled.sum(), (robbed & ~walled & ~behind).sum(), (behind & ~walled).sum(), free.sum()) >= 3
    assert visible[free].all()
    assert not visible[walled | robbed | behind].any()


def test_noise_of_sightings_is_as_configured() -> None:
    team = hall_team()
    model = SightingModel(max_range=9.0, rate=10.0)
    errors = []
    for seed in range(4):
        for s in true_sightings(team, model, seed):
            x, y, theta = true_relative(team, s)
            assert s.heading is not None
            errors.append((s.range - np.hypot(x, y), s.bearing - np.arctan2(y, x), s.heading - theta))
    error = wrapped(np.array(errors)) / (0.05, 0.02, 0.05)
    count = len(error)
    assert count > 500
    assert (np.abs(error.mean(axis=0)) < 4 / np.sqrt(count)).all()
    assert (np.abs(error.std(axis=0) - 1) < 4 / np.sqrt(2 * count)).all()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_false_sightings_are_the_share_asked_for_and_everywhere(share: float) -> None:
    spans = {"red": (0.0, 100.0), "blue": (50.0, 150.0), "green": (120.0, 130.0)}
    model = SightingModel(false_share=share)
    false = false_sightings(spans, model, 700, rng())
    assert len(false) / (700 + len(false)) == pytest.approx(share, abs=1e-3)
    for s in false:
        assert all(spans[name][0] <= s.time <= spans[name][1] for name in (s.observer, s.observed))
    if false:
        values = np.array([(s.range / 8, s.bearing / np.pi + 0.5, (s.heading or 0) / np.pi / 2 + 0.5) for s in false])
        assert (values >= 0).all()
        assert (values <= 1).all()
        assert {(s.observer, s.observed) for s in false} == {
            ("red", "blue"), ("blue", "red"), ("blue", "green"), ("green", "blue")
        }  # fmt: skip
        spread = np.histogram2d(values[:, 1], values[:, 2], bins=4, range=[[0, 1], [0, 1]])[0]
        assert spread.min() > len(false) / 16 / 3


def test_false_sightings_that_cannot_be_made_are_refused() -> None:
    with pytest.raises(SimulationError, match="share of false sightings 1: must be"):
        false_sightings({"a": (0, 1), "b": (0, 1)}, SightingModel(false_share=1.0), 5, rng())
    with pytest.raises(SimulationError, match="no two robots run at the same time"):
        false_sightings({"a": (0, 1), "b": (2, 3)}, SightingModel(false_share=0.5), 5, rng())


def test_a_sensor_without_heading_leaves_it_blank(tmp_path: Path) -> None:
    blind = true_sightings(hall_team(), SightingModel(sigma_heading=None), 1)
    assert blind
    assert all(s.heading is None and s.sigmas[2] is None for s in blind)
    write_sightings(blind, tmp_path / "sightings.csv")
    assert re.fullmatch(
        r"[\d.]+,\w+,\w+,[\d.]+,-?[\d.]+,,0\.05,0\.02,", (tmp_path / "sightings.csv").read_text().split()[1]
    )


def test_a_route_is_dealt_out_with_overlap_and_every_second_part_in_reverse() -> None:
    ring = FloorPlan("ring", HALL.walls, routes={"ring": [(0, 0), (12, 0), (12, 12, 2.0), (0, 12), (0, 0)]})
    parts = divided(ring, "ring", ["red", "blue", "green"], overlap=0.5).routes
    assert list(parts) == ["red", "blue", "green"]
    assert parts["red"] == [(0, 0), (12, 0), (12, 12)]  # 16 m and half as much again
    assert parts["blue"] == [(0, 8), (0, 12), (12, 12, 2.0), (12, 4)]
    assert parts["green"] == [(4, 12), (0, 12), (0, 0), (8, 0)]
    assert robot_names(10)[7:] == ["olive", "robot09", "robot10"]


def test_two_robots_on_one_route_are_refused() -> None:
    with pytest.raises(SimulationError, match="two robots on one route"):
        simulate_team(HALL, ["red", "red"])


def run(*arguments: str | Path) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def test_the_command_writes_a_session_that_opens_with_its_truth(tmp_path: Path) -> None:
    write_plan(HALL, tmp_path / "hall.json")
    options = ("--robots", "3", "--start-every", "2.5", "--false-rate", "0.4", "--minutes", "0.5", "--rate", "4")
    run(tmp_path / "hall.json", *options, "--out", tmp_path / "out", "--picture")
    session = open_session(tmp_path / "out" / "team.yaml")
    assert [(member.name, member.start) for member in session.members] == [("red", 0), ("blue", 2.5), ("green", 5)]
    lines = (tmp_path / "out" / "sightings.csv").read_text().splitlines()
    false = (tmp_path / "out" / "truth" / "false.csv").read_text().splitlines()
    assert false[0] == lines[0]
    assert set(false) < set(lines)
    assert len(false) - 1 == pytest.approx(0.4 * (len(lines) - 1), abs=0.5)
    assert len(session.sightings) == len(lines) - 1
    starts = set()
    for member in session.members:
        scans = list(open_log(member.log).scans())
        truth = read_tum(session.truth[member.name])
        np.testing.assert_allclose(truth.times, [scan.time for scan in scans], atol=1e-6)
        assert scans[-1].time - scans[0].time <= 30
        starts.add(round(scans[0].time))
        np.testing.assert_allclose(truth.poses[0, :2], HALL.route(member.name)[0, :2], atol=1e-6)
        np.testing.assert_array_equal(scans[0].odometry, 0)
    assert len(starts) == 3  # three clocks
    # By the session's own files: team time of a true sighting to both logs' times, and from there to the truth.
    first = next(s for s, line in zip(session.sightings, lines[1:], strict=True) if line not in false)
    at = {}
    for member in session.members:
        truth = read_tum(session.truth[member.name])
        nearest = int(np.argmin(np.abs(truth.times - truth.times[0] + member.start - first.time)))
        at[member.name] = truth.poses[nearest]
    x, y, _ = between(at[first.observer], at[first.observed])
    assert first.measurement.range == pytest.approx(np.hypot(x, y), abs=0.5)
    assert json.loads((tmp_path / "out" / "truth" / "plan.json").read_text())["name"] == "hall"
    assert (tmp_path / "out" / "hall.png").read_bytes().startswith(b"\x89PNG")


def test_the_same_command_writes_the_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    write_plan(HALL, tmp_path / "hall.json")
    common = (tmp_path / "hall.json", "--robots", "3", "--minutes", "0.3", "--false-rate", "0.5")
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        run(*common, "--seed", seed, "--out", tmp_path / name)
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file()]
    assert len(files) == 10
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    for name in ("red.clf.gz", "sightings.csv", "truth/blue.tum", "truth/false.csv"):
        assert (tmp_path / "a" / name).read_bytes() != (tmp_path / "c" / name).read_bytes(), name


def test_any_building_has_a_team_and_robots_inside_each_other_are_told(tmp_path: Path) -> None:
    output = run("loop", "--robots", "2", "--rate", "1", "--out", tmp_path)
    assert [member.name for member in open_session(tmp_path / "team.yaml").members] == ["red", "blue"]
    assert "robots do not dodge" in output  # they meet head-on on one line


def test_laps_of_a_team_are_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["wings", "--robots", "3", "--laps", "2", "--out", str(tmp_path)])
    assert result.exit_code == 1
    assert result.output.strip() == "error: --laps and --hours are for one robot; limit a team with --minutes"


def test_every_robot_of_the_blocks_can_be_driven_and_they_meet() -> None:
    plan = blocks(2, columns=4, rows=3, robots=8, length=120.0)
    coarse = LaserModel.spanning(np.pi, 91, 20.0)
    team = simulate_team(plan, robot_names(8), coarse, seed=2)
    assert all(robot.end > 150 for robot in team.robots)
    assert len({tuple(robot.at(np.zeros(1))[0]) for robot in team.robots}) == 8
    met = {frozenset((s.observer, s.observed)) for s in true_sightings(team, SightingModel(), 2)}
    assert len(met) >= 8


def test_the_demo_is_what_its_command_writes(tmp_path: Path) -> None:
    command = re.search(r"python -m tools\.simulate (wings.*)", (DEMO / "README.md").read_text(encoding="utf-8"))
    assert command is not None
    run(*shlex.split(command[1].replace("data/demo", str(tmp_path))))
    files = [path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()]
    assert len(files) == 10
    for file in files:
        made, committed = ((folder / file).read_bytes() for folder in (tmp_path, DEMO))
        if file.suffix == ".gz":  # the compressed bytes also depend on the machine's zlib
            made, committed = gzip.decompress(made), gzip.decompress(committed)
        assert made == committed, file


def test_the_demo_is_small_and_its_robots_meet_two_by_two() -> None:
    session = read_session(DEMO / "team.yaml")
    files = [DEMO / "team.yaml", DEMO / "sightings.csv", *(DEMO / "truth").iterdir(), *(m.log for m in session.members)]
    assert sum(file.stat().st_size for file in files) < 750_000
    assert {frozenset((s.observer, s.observed)) for s in session.sightings} == {
        frozenset(pair) for pair in (("red", "blue"), ("red", "green"), ("blue", "green"))
    }
    truth = {name: read_tum(path).poses[:, :2] for name, path in session.truth.items()}
    for name, path in truth.items():
        others = np.vstack([other for robot, other in truth.items() if robot != name])
        shared = (np.hypot(*(path[:, None] - others[None, ::4]).T) < 3.0).any(axis=0).mean()
        assert 0.02 < shared < 0.35, name  # of its path is near another's: limited overlap


def test_the_wings_differ_by_seed_in_furniture_only() -> None:
    one, other = wings(0), wings(1)
    assert one.walls == other.walls
    assert one.boxes != other.boxes
    simulate_team(other, ["red", "blue", "green"])  # drives through
