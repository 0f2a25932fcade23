"""The simulator: laser against closed form, odometry against truth, logs against their reader."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from typer.testing import CliRunner

from frontend.readers import open_log
from frontend.records import FloatArray
from tools.simulate import app
from tools.simulation import (
    BUILDINGS,
    LMS200,
    LMS200_HALF_DEGREE,
    PERFECT,
    Driving,
    FloorPlan,
    LaserModel,
    OdometryNoise,
    SimulatedLog,
    SimulationError,
    read_plan,
    simulate,
    stream,
    write_carmen,
    write_plan,
    write_tum,
)
from tools.simulation.laser import measure
from tools.simulation.odometry import dead_reckon
from tools.simulation.poses import between
from tools.simulation.raycast import cast, clearances

SIZE = 20.0
SQUARE = FloorPlan(
    "square",
    [(0, 0, SIZE, 0), (SIZE, 0, SIZE, SIZE), (SIZE, SIZE, 0, SIZE), (0, SIZE, 0, 0)],
    routes={"u": [(3, 3), (15, 3), (15, 9, 2.5), (4, 9)], "wall": [(3, 3), (19.9, 3)]},
)
ROUND = LaserModel.spanning(2 * np.pi, 720, max_range=12.0)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def to_square(pose: FloatArray, angles: FloatArray) -> FloatArray:
    """Distances to the walls of the square along the bearings, by the nearer of the two lines ahead."""
    c, s = np.cos(pose[2] + angles), np.sin(pose[2] + angles)
    with np.errstate(divide="ignore"):
        along_x = np.where(c > 0, SIZE - pose[0], -pose[0]) / c
        along_y = np.where(s > 0, SIZE - pose[1], -pose[1]) / s
    return np.asarray(np.minimum(along_x, along_y))


@pytest.mark.parametrize(
    "laser", [LMS200, LMS200_HALF_DEGREE, replace(ROUND, max_range=80.0)], ids=["180", "361", "full"]
)
def test_ranges_in_a_square_room_have_their_closed_form(laser: LaserModel) -> None:
    poses = np.array([(7.3, 4.1, 0.4), (1.0, 19.0, -3.1), (10.0, 10.0, 1.6)])
    expected = np.array([to_square(pose, laser.record().angles) for pose in poses])
    np.testing.assert_allclose(measure(laser.exact(), SQUARE.segments, poses, rng()), expected, rtol=1e-6)


def test_mount_moves_the_laser_on_the_robot() -> None:
    laser = replace(LMS200.exact(), mount=(0.2, -0.1, 0.3))
    expected = to_square(np.array([7.0 + 0.1, 4.0 + 0.2, np.pi / 2 + 0.3]), laser.record().angles)
    measured = measure(laser, SQUARE.segments, np.array([(7.0, 4.0, np.pi / 2)]), rng())
    np.testing.assert_allclose(measured[0], expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("first", "step", "beams"), [(-np.pi / 2, np.pi / 180, 180), (-np.pi, np.pi / 360, 720), (2.0, 0.01, 500)]
)
def test_kernel_agrees_with_every_beam_against_every_segment(first: float, step: float, beams: int) -> None:
    random = rng(3)
    segments = random.uniform(-10, 10, (60, 4))
    poses = np.column_stack((random.uniform(-10, 10, (20, 2)), random.uniform(-np.pi, np.pi, 20)))
    a, e = segments[:, :2], segments[:, 2:] - segments[:, :2]
    for pose, ranges in zip(poses, cast(segments, poses, first, step, beams), strict=True):
        heading = pose[2] + first + step * np.arange(beams)
        u = np.column_stack((np.cos(heading), np.sin(heading)))[:, None]
        to = a - pose[:2]
        across = u[..., 0] * e[:, 1] - u[..., 1] * e[:, 0]
        distance = (to[:, 0] * e[:, 1] - to[:, 1] * e[:, 0]) / across
        along = (to[:, 0] * u[..., 1] - to[:, 1] * u[..., 0]) / across
        hit = (distance >= 0) & (along >= 0) & (along <= 1)
        np.testing.assert_allclose(ranges, np.where(hit, distance, np.inf).min(axis=1), rtol=1e-9)


def test_edge_on_wall_is_not_seen_all_around() -> None:
    poses = np.array([(0.1 * i, 0.7 * 0.1 * i, theta) for i in range(1, 30) for theta in (0.0, 0.61, 2.3)])
    wall = np.array([(4.0, 2.8, 6.0, 4.2)])  # points at the robot, wherever on its line
    assert np.isinf(cast(wall, poses, -np.pi, np.pi / 180, 360)).mean(axis=1).min() > 0.99


def test_clearance_is_the_distance_to_the_nearest_segment() -> None:
    points = np.array([(1.0, 5.0), (-3.0, -4.0), (12.0, 19.5)])
    np.testing.assert_allclose(clearances(SQUARE.segments, points), [1.0, 5.0, 0.5])


def test_range_noise_rounding_and_drop_outs_are_as_configured() -> None:
    laser = replace(LMS200, sigma=0.03, drop_outs=0.05)
    poses = np.tile((7.3, 4.1, 0.4), (400, 1))
    ranges = measure(laser, SQUARE.segments, poses, rng(1)).astype(np.float64)
    count = ranges.size
    assert abs(np.isinf(ranges).mean() - 0.05) < 4 * np.sqrt(0.05 * 0.95 / count)
    error = (ranges - to_square(poses[0], laser.record().angles))[np.isfinite(ranges)]
    sigma = np.sqrt(0.03**2 + 0.01**2 / 12)  # rounding to a centimetre adds its own
    assert abs(error.mean()) < 4 * sigma / np.sqrt(count)
    assert abs(error.std() / sigma - 1) < 4 / np.sqrt(2 * count)
    seen = ranges[np.isfinite(ranges)] * 100
    np.testing.assert_allclose(seen, np.round(seen), atol=1e-3)


def test_beams_at_an_edge_mix_near_and_far() -> None:
    post = replace(SQUARE, circles=[(10.0, 5.0, 0.5)])
    poses = np.tile((5.0, 5.0, 0.0), (2000, 1))
    laser = replace(LMS200.exact(), mixed_pixels=0.2, divergence=np.radians(1.0), edge=3.0)
    ranges = measure(laser, post.segments, poses, rng(1))
    clean = measure(laser.exact(), post.segments, poses[:1], rng())[0]
    changed = np.abs(ranges - clean) > 1e-4
    # The post spans 5.7 degrees to either side, so the beams of 6 degrees, half a degree wide on each side, straddle.
    assert set(np.flatnonzero(changed.any(axis=0))) == {90 - 6, 90 + 6}
    for beam in (90 - 6, 90 + 6):
        assert abs(changed[:, beam].mean() - 0.2) < 4 * np.sqrt(0.2 * 0.8 / len(poses))
        mixed = ranges[changed[:, beam], beam]
        assert mixed.min() >= 4.5
        assert mixed.max() <= 15.2
        assert mixed.mean() == pytest.approx((5.0 + 15.1) / 2, rel=0.1)


def test_nothing_is_seen_beyond_max_range() -> None:
    laser = replace(ROUND.exact(), max_range=8.0)
    ranges = measure(laser, SQUARE.segments, np.array([(5.0, 5.0, 0.1)]), rng())[0]
    expected = to_square(np.array([5.0, 5.0, 0.1]), laser.record().angles)
    np.testing.assert_array_equal(np.isinf(ranges), expected >= 8.0)


def test_drive_keeps_its_limits_and_passes_its_waypoints() -> None:
    driving = Driving(wander=0.0)
    log = simulate(SQUARE, "u", replace(LMS200, rate=50.0), driving=driving)
    steps = between(log.poses[:-1], log.poses[1:]) * 50.0
    speed, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    assert speed.max() == pytest.approx(driving.speed, rel=1e-6)
    assert turn.max() == pytest.approx(driving.turn_rate, rel=1e-6)
    assert np.abs(np.diff(speed)).max() * 50 < 1.01 * driving.acceleration
    np.testing.assert_allclose(log.poses[0], (3.0, 3.0, 0.0))
    np.testing.assert_allclose(log.poses[-1, :2], (4.0, 9.0), atol=0.02)
    stop = np.hypot(*(log.poses[:, :2] - (15, 9)).T) < 1e-6
    still = np.flatnonzero(stop[:-1] & (turn < 1e-9)).size / 50
    assert still == pytest.approx(2.5, abs=0.1)
    # The corner at (15, 3) is cut by an arc, no more.
    assert np.hypot(*(log.poses[:, :2] - (15, 3)).T).min() == pytest.approx(0.6 * (np.sqrt(2) - 1), abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("building", BUILDINGS)
@pytest.mark.parametrize("seed", range(4))
def test_every_route_of_every_building_can_be_driven(building: str, seed: int) -> None:
    plan = BUILDINGS[building](seed)
    for route in plan.routes:
        log = simulate(plan, route, replace(LMS200, rate=10.0), seed=seed)
        assert clearances(plan.segments, log.poses[:, :2]).min() >= Driving().radius
        assert np.isfinite(log.ranges).mean() > 0.98


def test_seeds_give_different_buildings() -> None:
    for name, build in BUILDINGS.items():
        assert not np.array_equal(build(0).segments, build(1).segments), name
        assert np.array_equal(build(1).segments, build(1).segments), name


def test_perfect_odometry_is_the_truth_seen_from_the_start() -> None:
    log = simulate(SQUARE, "u", noise=PERFECT)
    np.testing.assert_allclose(between(log.poses[0], log.poses), log.odometry, atol=1e-9)
    np.testing.assert_array_equal(log.odometry[0], (0, 0, 0))


def many_odometries(poses: FloatArray, noise: OdometryNoise, rate: float) -> FloatArray:
    """(400, 3) what odometry says at the end, over seeds."""
    times = np.arange(len(poses)) / rate
    return np.array([dead_reckon(times, poses, noise, rng(seed))[-1] for seed in range(400)])


@pytest.mark.parametrize("rate", [20.0, 100.0])
def test_odometry_noise_grows_with_the_root_of_the_motion(rate: float) -> None:
    x = np.linspace(0, 16, int(16 * rate))
    straight = np.column_stack((x, np.zeros((len(x), 2))))
    noise = replace(PERFECT, translation_from_translation=0.02, rotation_from_translation=0.01)
    ends = many_odometries(straight, noise, rate)
    assert ends[:, 0].mean() == pytest.approx(16, abs=0.05)
    assert ends[:, 0].std() == pytest.approx(0.02 * 4, rel=0.15)
    assert ends[:, 2].std() == pytest.approx(0.01 * 4, rel=0.15)
    turning = np.column_stack((np.zeros((len(x), 2)), x / 8))
    ends = many_odometries(turning, replace(PERFECT, rotation_from_rotation=0.05), rate)
    assert ends[:, 2].std() == pytest.approx(0.05 * np.sqrt(2), rel=0.15)


def test_systematic_errors_have_their_size() -> None:
    x = np.linspace(0, 10, 400)
    straight = np.column_stack((x, np.zeros((400, 2))))
    ends = many_odometries(straight, replace(PERFECT, wheel_mismatch=0.002), 20.0)
    assert ends[:, 2].std() == pytest.approx(10 * 0.002 / 0.38, rel=0.15)
    ends = many_odometries(straight, replace(PERFECT, scale=0.01), 20.0)
    assert ends[:, 0].std() == pytest.approx(0.1, rel=0.15)
    turning = np.column_stack((np.zeros((400, 2)), x / 4))
    ends = many_odometries(turning, replace(PERFECT, wheelbase_scale=0.02), 20.0)
    assert ends[:, 2].std() == pytest.approx(2.5 * 0.02, rel=0.15)


def test_slips_and_reversals_happen_as_often_as_told() -> None:
    x = np.linspace(0, 120, 20 * 240)
    straight, times = np.column_stack((x, np.zeros((len(x), 2)))), np.arange(len(x)) / 20
    backwards, turned = [], []
    for seed in range(300):
        noise = replace(PERFECT, reversals_per_minute=1.0, reversal_length=1.5)
        backwards.append((np.diff(dead_reckon(times, straight, noise, rng(seed))[:, 0]) < 0).sum() * 120 / len(x))
        noise = replace(PERFECT, slips_per_minute=2.0, slip_rotation=0.1)
        turned.append(dead_reckon(times, straight, noise, rng(seed))[-1, 2])
    assert np.mean(backwards) == pytest.approx(4 * 1.5, rel=0.15)
    assert np.std(turned) == pytest.approx(0.1 * np.sqrt(8), rel=0.15)


def equal(a: SimulatedLog, b: SimulatedLog, *fields: str) -> bool:
    return all(np.array_equal(getattr(a, field), getattr(b, field)) for field in fields)


def test_a_seed_gives_one_log_and_another_seed_another() -> None:
    plan = BUILDINGS["cluttered"](0)
    log, again, other = (simulate(plan, "tour", seed=seed) for seed in (5, 5, 6))
    assert equal(log, again, "times", "odometry", "poses", "ranges")
    assert not any(equal(log, other, field) for field in ("odometry", "poses", "ranges"))


def test_another_laser_or_noise_sees_the_same_drive() -> None:
    log = simulate(SQUARE, "u", seed=2)
    assert equal(log, simulate(SQUARE, "u", replace(ROUND, rate=5.0), seed=2), "times", "odometry", "poses")
    assert equal(log, simulate(SQUARE, "u", noise=PERFECT, seed=2), "times", "poses", "ranges")


@pytest.mark.slow
def test_pieces_of_a_long_drive_write_the_same_bytes_as_the_whole(tmp_path: Path) -> None:
    plan = BUILDINGS["cluttered"](0)
    parts = list(stream(plan, "tour", seed=1, laps=4))
    assert len(parts) > 1
    write_carmen(parts, tmp_path / "parts.clf.gz")
    write_carmen(simulate(plan, "tour", seed=1, laps=4), tmp_path / "whole.clf.gz")
    assert (tmp_path / "parts.clf.gz").read_bytes() == (tmp_path / "whole.clf.gz").read_bytes()


def test_laps_and_hours_repeat_the_route() -> None:
    plan = BUILDINGS["cluttered"](0)
    one, three, hour = (simulate(plan, "tour", **more) for more in ({}, {"laps": 3}, {"hours": 0.1}))
    assert len(three.times) == pytest.approx(3 * len(one.times), rel=0.05)
    assert hour.times[-1] - hour.times[0] >= 360 * 0.99
    start = one.poses[0, :2]
    passes = np.hypot(*(three.poses[:, :2] - start).T) < 0.5
    assert np.count_nonzero(np.diff(passes.astype(int)) == 1) == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("laser", "message"),
    [
        (replace(LMS200, mount=(0.2, 0.0, 0.0)), "FLASER"),
        (LMS200_HALF_DEGREE, "FLASER"),
        (replace(ROUND, mount=(0.1, -0.05, 0.5)), "ROBOTLASER1"),
        (LaserModel.spanning(np.radians(270), 1080, 30.0), "ROBOTLASER1"),
    ],
    ids=["lms", "half-degree", "full-circle", "wide"],
)
@pytest.mark.parametrize("suffix", ["", ".gz", ".bz2", ".xz"])
def test_the_reader_gives_back_what_was_simulated(laser: LaserModel, message: str, suffix: str, tmp_path: Path) -> None:
    log = simulate(SQUARE, "u", laser, seed=1)
    path = tmp_path / f"log.clf{suffix}"
    write_carmen(log, path)
    opened = open_log(path)
    scans = list(opened.scans())
    assert opened.report.lines[message] == opened.report.lines["ODOM"] == len(scans) == len(log.times)
    assert not opened.report.skipped_examples
    for read, made in zip(scans, log.scans(), strict=True):
        assert read.time == made.time
        np.testing.assert_array_equal(np.isinf(read.ranges), np.isinf(made.ranges))
        np.testing.assert_allclose(read.ranges, made.ranges, atol=1e-5)
        np.testing.assert_allclose(read.odometry, made.odometry, atol=1e-6)
    np.testing.assert_allclose(scans[0].laser.angles, laser.record().angles, atol=1e-5)
    np.testing.assert_allclose(scans[0].laser.mount, laser.mount, atol=1e-5)


def test_carmen_lines_are_as_other_programs_expect_them(tmp_path: Path) -> None:
    log = simulate(SQUARE, "u", seed=1)
    write_carmen(log, tmp_path / "log.clf")
    number = r"-?\d+\.\d+"
    stamp = rf"\d+\.\d{{6}} \S+ {number}"
    lines = (tmp_path / "log.clf").read_text(encoding="ascii").splitlines()
    odoms = [line for line in lines if re.fullmatch(rf"ODOM( {number}){{6}} {stamp}", line)]
    flasers = [line for line in lines if re.fullmatch(rf"FLASER 180( \d+\.\d\d){{180}}( {number}){{6}} {stamp}", line)]
    params = [
        line for line in lines if re.fullmatch(r"PARAM robot_\w+ [\d.]+ \S+ 0|PARAM laser_\w+ [\d.]+ \S+ 0", line)
    ]
    assert len(odoms) == len(flasers) == len(log.times)
    assert len(lines) == 1 + len(params) + len(odoms) + len(flasers)
    assert len(params) == 3
    lost = np.argwhere(np.isinf(log.ranges))[0]
    assert flasers[lost[0]].split()[2 + lost[1]] == "81.91"


def test_tum_holds_times_and_poses(tmp_path: Path) -> None:
    log = simulate(SQUARE, "u", seed=1)
    write_tum(log.times, log.poses, tmp_path / "truth.tum")
    columns: npt.NDArray[np.float64] = np.loadtxt(tmp_path / "truth.tum")
    np.testing.assert_array_equal(columns[:, 0], log.times)
    np.testing.assert_allclose(columns[:, 1:3], log.poses[:, :2], atol=1e-6)
    heading = 2 * np.arctan2(columns[:, 6], columns[:, 7])
    np.testing.assert_allclose(np.cos(heading - log.poses[:, 2]), 1.0, atol=1e-9)
    assert not columns[:, 3:6].any()


def test_a_plan_survives_its_file(tmp_path: Path) -> None:
    plan = BUILDINGS["office"](3)
    write_plan(plan, tmp_path / "plan.json")
    read = read_plan(tmp_path / "plan.json")
    np.testing.assert_allclose(read.segments, plan.segments, atol=2e-3)
    np.testing.assert_allclose(read.route("tour"), plan.route("tour"), atol=1e-3)
    write_plan(read, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "plan.json").read_bytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not a JSON file"),
        ("[]", "JSON object"),
        ('{"name": "a"}', "walls: must be a list"),
        ('{"walls": []}', "walls is empty"),
        ('{"walls": [[0, 0, 1]]}', r"walls\[0\]: must be 4 finite numbers, not \[0, 0, 1\]"),
        ('{"walls": [[0, 0, 1, NaN]]}', r"walls\[0\]: must be 4"),
        ('{"walls": [[0, 0, 1, true]]}', r"walls\[0\]: must be 4"),
        ('{"walls": [[0, 0, 1, 1]], "circles": [[0, 0]]}', r"circles\[0\]: must be 3"),
        ('{"walls": [[0, 0, 1, 1]], "routes": {"a": [[0]]}}', r"routes: a\[0\]: must be 2 or 3"),
        ('{"walls": [[0, 0, 1, 1]], "routes": []}', "routes must be an object"),
        ('{"walls": [[0, 0, 1, 1]], "doors": []}', "unknown entry 'doors'"),
    ],
)
def test_a_bad_plan_is_refused_in_one_line(content: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(SimulationError, match=message) as error:
        read_plan(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([(3, 3), (19.9, 3)], r"at \(19\.\d\d, 3\.0\d\) something is 0\.\d\d m"),
        ([(3, 3)], "two waypoints"),
        ([(3, 3), (4, 4), (4, 4)], r"waypoint \(4, 4\) comes twice"),
        ([(3, 3), (4, 4, -1)], "stop of -1"),
    ],
)
def test_a_route_that_cannot_be_driven_is_refused(points: list[tuple[float, ...]], message: str) -> None:
    with pytest.raises(SimulationError, match=message):
        simulate(replace(SQUARE, routes={"a": points}), "a")


def test_an_unknown_route_is_refused_with_the_known_ones() -> None:
    with pytest.raises(SimulationError, match="no route 'b'; its routes: u, wall"):
        simulate(SQUARE, "b")


def test_the_command_writes_log_truth_plan_and_picture(tmp_path: Path) -> None:
    write_plan(SQUARE, tmp_path / "square.json")
    out = tmp_path / "out"
    command = [str(tmp_path / "square.json"), "--route", "u", "--out", str(out), "--seed", "3", "--picture"]
    result = CliRunner().invoke(app, [*command, "--field-of-view", "270", "--beams", "541", "--offset", "0.1"])
    assert result.exit_code == 0, result.output
    scans = list(open_log(out / "square.clf.gz").scans())
    assert len(scans) == len((out / "truth.tum").read_text().splitlines())
    assert np.degrees(np.ptp(scans[0].laser.angles)) == pytest.approx(270, abs=1e-3)
    assert scans[0].laser.mount[0] == pytest.approx(0.1)
    assert json.loads((out / "plan.json").read_text())["name"] == "square"
    assert (out / "square.png").read_bytes().startswith(b"\x89PNG")


def test_a_failed_run_leaves_an_older_log_alone(tmp_path: Path) -> None:
    write_plan(SQUARE, tmp_path / "square.json")
    (tmp_path / "square.clf.gz").write_bytes(b"precious")
    result = CliRunner().invoke(app, [str(tmp_path / "square.json"), "--route", "wall", "--out", str(tmp_path)])
    assert result.exit_code == 1
    assert "something is 0." in result.output
    assert (tmp_path / "square.clf.gz").read_bytes() == b"precious"


def test_the_command_says_what_is_wrong_in_one_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, [str(tmp_path / "none.json"), "--out", str(tmp_path)])
    assert result.exit_code == 1
    assert (
        result.output.strip()
        == f"error: {tmp_path / 'none.json'}: cannot read the floor plan: No such file or directory"
    )
