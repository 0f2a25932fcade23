"""Whole runs, from a log on disk to what is left behind: complete, the same for the same seed, whatever the scanner."""

import gzip
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gtsam
import numba
import numpy as np
import pytest
import yaml
from PIL import Image

from factors import VertexId
from frontend import se2
from frontend.errors import LogError
from frontend.records import FloatArray
from mrtm.config import Config, load_config
from mrtm.evaluation import evaluate_output, read_tum
from mrtm.joint.crispness import crispness
from mrtm.moving import moved
from mrtm.result import RunResult
from mrtm.session import run_session
from tests.mrtm.small_logs import edge_errors, errors, false_edges, mapped, office_ring, poses, ring, room, small
from tools.simulation import LMS200, LMS200_HALF_DEGREE, LaserModel, SimulatedLog, write_carmen, write_tum

DEMO = Path(__file__).parents[2] / "data" / "demo"

Write = Callable[[SimulatedLog], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a simulated log as CARMEN."""

    def to_disk(log: SimulatedLog) -> Path:
        path = tmp_path / "robot.clf.gz"
        write_carmen(log, path)
        return path

    return to_disk


def run(path: Path, out: Path, config: Config | None = None) -> RunResult:
    return run_session(path, out, config or small(), lambda fraction, doing: None)


def contents(out: Path) -> dict[str, bytes]:
    """Every file by its path below ``out``; run.json without what is allowed to differ."""
    files = {str(path.relative_to(out)): path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}
    record = json.loads(files["run.json"])
    times = [key for key in record if key in ("timings", "longest", "latencies")]
    assert "timings" in times
    files["run.json"] = json.dumps({key: value for key, value in record.items() if key not in times}).encode()
    return files


def check_output(out: Path, result: RunResult) -> None:
    """All that the design promises, and that the files agree with each other."""
    record = json.loads((out / "run.json").read_text())
    assert record["seed"] == result.seed
    assert record["config"]["frontend"]["particles"] == result.config["frontend"]["particles"]
    assert set(record["versions"]) >= {"mrtm", "python", "gtsam", "numpy", "numba"}
    assert record["counts"] == result.counts
    assert record["timings"]
    assert all(seconds >= 0.0 for seconds in record["timings"].values())
    assert [[tuple(v) for v in c] for c in record["components"]] == [
        [(v.robot, v.number) for v in c] for c in result.components
    ]
    assert [(e["fate"], e["version"], e["reason"]) for e in record["edges"]] == [
        (f.fate, f.edge.version, f.reason) for f in result.edges
    ]
    assert [event["kind"] for event in record["events"]] == [event.kind for event in result.events]

    for robot, trajectory in result.trajectories.items():
        written = read_tum(out / "trajectory" / f"{robot}.tum")
        np.testing.assert_allclose(written.times, trajectory.times, atol=1e-6)
        np.testing.assert_allclose(written.poses[:, :2], trajectory.poses[:, :2], atol=1e-6)

    image = np.asarray(Image.open(out / "map.pgm"))
    meta = yaml.safe_load((out / "map.yaml").read_text())
    assert meta["image"] == "map.pgm"
    assert {205, 254} <= set(np.unique(image).tolist())
    positions = np.concatenate([trajectory.poses[:, :2] for trajectory in result.trajectories.values()])
    column, row = ((positions - np.array(meta["origin"][:2])) / meta["resolution"]).astype(int).T
    assert (image[image.shape[0] - 1 - row, column] == 254).mean() > 0.98  # the robot drove where the map is free
    assert Image.open(out / "map.png").size[0] > 300

    graph, values = gtsam.readG2o(str(out / "graph.g2o"), False)
    assert values.size() == len(result.vertex_poses)
    assert graph.nrFactors() == sum(f.fate == "accepted" for f in result.edges)
    for key, pose in enumerate(result.vertex_poses.values()):
        assert values.atPose2(key).equals(pose, 1e-6)
    assert len(list((out / "local_maps").iterdir())) == len(result.local_maps)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunResult]:
    """The committed team, few particles, else as it comes; what ``make demo`` does with all of them."""
    out = tmp_path_factory.mktemp("demo")
    return out, run(DEMO / "team.yaml", out, load_config(options=["frontend.particles=10"]))


def test_the_committed_demo_team_comes_into_one_map(demo: tuple[Path, RunResult]) -> None:
    out, result = demo
    check_output(out, result)
    assert list(result.trajectories) == ["red", "blue", "green"]
    (component,) = result.components
    assert {vertex.robot for vertex in component} == {"red", "blue", "green"}
    kinds = {str(fate.edge.kind) for fate in result.edges if fate.fate == "accepted"}
    assert kinds >= {"inter_vertex", "loop", "fusing"}
    evaluation = evaluate_output(out, truth={robot: DEMO / "truth" / f"{robot}.tum" for robot in result.trajectories})
    (ate,) = evaluation.ate
    assert ate.translation.rmse < 0.1
    assert ate.translation.max < 0.5


def jumps(result: RunResult) -> FloatArray:
    """(n,) metres by which the step from one vertex into the next differs from what the map that is left measured."""
    found = []
    for robot, trajectory in result.trajectories.items():
        for scan in np.flatnonzero(np.diff(trajectory.vertices)):
            left = result.local_maps[VertexId(robot, int(trajectory.vertices[scan]))]
            places = np.searchsorted(left.scans, (scan, scan + 1))
            if left.scans[-1] > scan and (left.scans[places] == (scan, scan + 1)).all():
                found.append(se2.between(se2.between(*left.poses[places]), se2.between(*trajectory.poses[scan:][:2])))
    return np.asarray(np.hypot(*np.array(found)[:, :2].T))


def test_trajectories_do_not_jump_where_robots_go_from_map_to_map(demo: tuple[Path, RunResult]) -> None:
    """Rigid maps would; and where they overlap they are drawn where they lie best as a whole."""
    _, result = demo
    rigid = moved(result, result.vertex_poses)
    assert len(jumps(result)) > 8
    assert jumps(result).mean() < 0.6 * jumps(rigid).mean()
    (component,) = result.components
    assert crispness(result.placed_maps(component)).entropy <= crispness(rigid.placed_maps(component)).entropy + 1e-3


def test_the_story_of_the_demo_team_is_told(demo: tuple[Path, RunResult]) -> None:
    _, result = demo
    team = result.team
    assert team is not None
    assert team.first_meeting is not None
    assert team.common_frame is not None
    assert team.first_meeting <= team.common_frame < team.first_meeting + 60
    assert [meeting.time for meeting in team.meetings] == sorted(meeting.time for meeting in team.meetings)
    assert all(meeting.reason and sum(meeting.bytes.values()) > 0 for meeting in team.meetings)
    assert {meeting.verdict for meeting in team.meetings} >= {"accepted"}
    lines = len((DEMO / "sightings.csv").read_text().splitlines()) - 1
    assert len(team.sightings) == lines
    assert all(sighting.fate == "accepted" for sighting in team.sightings)  # none of them is false
    own = {robot: sum(v.robot == robot for v in result.vertex_poses) for robot in result.trajectories}
    for robot, known in team.known.items():
        assert known[robot] == own[robot]
        assert all(known[other] <= own[other] for other in known)
    assert any(len(known) == 3 for known in team.known.values())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_demo_team_is_mapped_well_with_every_seed(tmp_path: Path, seed: int) -> None:
    run(DEMO / "team.yaml", tmp_path, load_config(options=[f"seed={seed}"]))
    truth = {robot: DEMO / "truth" / f"{robot}.tum" for robot in ("red", "blue", "green")}
    (ate,) = evaluate_output(tmp_path, truth=truth).ate
    assert ate.translation.rmse < 0.1


@pytest.mark.slow
def test_the_same_seed_leaves_the_same_bytes_with_any_number_of_threads(write: Write, tmp_path: Path) -> None:
    path = write(ring(2))
    outputs = []
    threads = numba.get_num_threads()
    try:
        for number, count in enumerate((1, threads, 1)):
            numba.set_num_threads(count)
            run(path, tmp_path / str(number))
            outputs.append(contents(tmp_path / str(number)))
    finally:
        numba.set_num_threads(threads)
    names = set(outputs[0])
    assert {"run.json", "map.pgm", "map.yaml", "map.png", "graph.g2o", "trajectory/robot.tum"} <= names
    for other in outputs[1:]:
        assert set(other) == names
        assert [name for name in sorted(names) if other[name] != outputs[0][name]] == []


@pytest.mark.slow
def test_the_demo_team_leaves_the_same_bytes_on_any_number_of_cores(tmp_path: Path) -> None:
    for name, cores in (("a", 1), ("b", 3)):
        run_session(DEMO / "team.yaml", tmp_path / name, small(), lambda fraction, doing: None, cores)
    first, second = contents(tmp_path / "a"), contents(tmp_path / "b")
    assert set(first) == set(second)
    assert [name for name in first if first[name] != second[name]] == []


def test_another_seed_gives_another_run() -> None:
    """Else the seed would not be used."""
    first, second = mapped(room()), mapped(room(), small("seed=7"))
    assert not np.array_equal(poses(first), poses(second))
    apart = se2.between(poses(first), poses(second))
    np.testing.assert_allclose(apart, 0.0, atol=0.1)  # but of the same place


def test_a_run_from_disk_is_the_run_from_memory(write: Write, tmp_path: Path) -> None:
    from_disk = run(write(room()), tmp_path / "out")
    np.testing.assert_allclose(poses(from_disk), poses(mapped(room())), atol=1e-3)
    check_output(tmp_path / "out", from_disk)


def test_a_log_of_one_scan_is_a_map(write: Write, tmp_path: Path) -> None:
    log = room()
    one = SimulatedLog(log.times[:1], log.odometry[:1], log.poses[:1], log.ranges[:1], log.laser)
    result = run(write(one), tmp_path / "out")
    assert result.counts == {"scans": 1, "vertices": 1, "edges": 0}
    check_output(tmp_path / "out", result)
    np.testing.assert_allclose(poses(result), [[0.0, 0.0, 0.0]], atol=1e-9)


def test_a_robot_that_stands_still_leaves_one_map(write: Write, tmp_path: Path) -> None:
    log = room()
    count = len(log.times)
    still = replace(
        log,
        odometry=np.zeros((count, 3)),
        poses=np.tile(log.poses[0], (count, 1)),
        ranges=log.ranges[0] + np.random.default_rng(0).normal(0.0, 0.01, log.ranges.shape).astype(np.float32),
    )
    result = run(write(still), tmp_path / "out")
    assert result.counts == {"scans": count, "vertices": 1, "edges": 0}
    check_output(tmp_path / "out", result)
    assert np.abs(poses(result)[:, :2]).max() < 0.02


def test_a_truncated_log_gives_the_map_of_what_it_holds(write: Write, tmp_path: Path) -> None:
    log = ring(2)
    whole = write(log)
    cut = tmp_path / "cut.clf.gz"
    cut.write_bytes(whole.read_bytes()[: int(0.6 * whole.stat().st_size)])
    with pytest.raises(EOFError):
        gzip.decompress(cut.read_bytes())
    result = run(cut, tmp_path / "out")
    held = result.counts["scans"]
    assert 0.4 * len(log.times) < held < 0.8 * len(log.times)
    assert any("cut" in line and str(cut) in line for line in result.blemishes)
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["blemishes"] == result.blemishes
    check_output(tmp_path / "out", result)
    assert errors(log, result).rmse < 0.1

    middle = tmp_path / "middle.clf"
    text = gzip.decompress(whole.read_bytes())
    middle.write_bytes(text[: len(text) // 2])  # in the middle of a line
    half = run(middle, tmp_path / "half")
    assert abs(half.counts["scans"] - len(log.times) // 2) < 20
    assert errors(log, half).rmse < 0.1


def test_lines_that_cannot_be_read_are_passed_over_and_told(write: Write, tmp_path: Path) -> None:
    lines = gzip.decompress(write(room()).read_bytes()).decode().splitlines(keepends=True)
    lines[40:40] = ["FLASER 180 1.0 nonsense\n", "\x00\x01\x02\n"]
    path = tmp_path / "bad.clf"
    path.write_text("".join(lines))
    result = run(path, tmp_path / "out")
    assert result.counts["scans"] == len(room().times)
    assert any(f"{path}:41" in line for line in result.blemishes)


def test_nothing_usable_is_an_error_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "empty.clf"
    path.write_text("# nothing\nODOM 0 0 0 0 0 0 1.0 host 0.0\n")
    with pytest.raises(LogError, match=r"empty\.clf") as error:
        run(path, tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out" / "run.json").exists()


SCANNERS = {
    "361 beams": LMS200_HALF_DEGREE,
    "1080 beams": LaserModel.spanning(math.radians(270), 1080, 30.0),
    "360 degrees": LaserModel.spanning(2.0 * math.pi, 360, 25.0),
    "sees 8 m": replace(LMS200, max_range=8.0, no_return=8.0),
    "looks back": replace(LMS200, mount=(-0.2, 0.0, math.pi)),
    "ahead and aside": replace(LMS200, mount=(0.25, -0.1, 0.3)),
    "10 scans a second": replace(LMS200, rate=10.0),
    "1 scan in 1.5 seconds": replace(LMS200, rate=1.0 / 1.5),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCANNERS)
def test_every_scanner_maps_the_room(name: str, write: Write, tmp_path: Path) -> None:
    """From disk, so that what the log says of the scanner is used."""
    log = room(SCANNERS[name])
    result = run(write(log), tmp_path / "out")
    assert result.counts["scans"] == len(log.times)
    check_output(tmp_path / "out", result)
    assert errors(log, result).rmse < 0.05
    assert errors(log, result).max < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SCANNERS))
def test_every_scanner_closes_the_loop(name: str) -> None:
    log = office_ring(2, laser=SCANNERS[name])
    result = mapped(log)
    assert any(event.kind == "loop closed" for event in result.events)
    assert false_edges(log, result) == []
    assert all(sample.distance < 0.3 for sample in edge_errors(log, result))
    assert errors(log, result).rmse < 0.1


def test_the_evaluation_reads_what_a_run_left(write: Write, tmp_path: Path) -> None:
    log = ring(2)
    run(write(log), tmp_path / "out")
    write_tum(log.times, log.poses, tmp_path / "truth.tum")
    (ate,) = evaluate_output(tmp_path / "out", truth=tmp_path / "truth.tum").ate
    assert ate.count == len(log.times)
    assert ate.translation.rmse < 0.05
