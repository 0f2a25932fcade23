"""The metrics against worked examples, scipy and GTSAM, and their files against mistakes."""

import io
import json
import re
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
import pytest
from rich.console import Console

from factors import Edge
from frontend import se2
from mrtm.evaluation import (
    Evaluation,
    EvaluationError,
    Relations,
    TimedPoses,
    align,
    evaluate_ate,
    evaluate_output,
    evaluate_relations,
    interpolate,
    nees,
    read_relations,
    read_tum,
    relation_errors,
)
from mrtm.output.export import export
from mrtm.output.report import evaluation_report
from tests.mrtm.sample_run import sample_run
from tools.fuzzing.seeds import RUNS, TRAJECTORIES

Array = npt.NDArray[np.float64]


def gtsam_poses(poses: Array) -> list[gtsam.Pose2]:
    return [gtsam.Pose2(*pose) for pose in poses]


def as_array(poses: list[gtsam.Pose2]) -> Array:
    return np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def random_poses(rng: np.random.Generator, n: int) -> Array:
    return np.column_stack([rng.normal(0, 5, (n, 2)), rng.uniform(-np.pi, np.pi, n)])


def test_interpolation_agrees_with_gtsam(rng: np.random.Generator) -> None:
    poses = random_poses(rng, 51)
    poses[1], poses[2, 2] = poses[0], poses[1, 2]  # one step stands still, one does not turn
    times, query = np.linspace(0, 10, 51), rng.uniform(0, 10, 200)
    query[:2] = 0.05, 0.3
    got, found = interpolate(TimedPoses(times, poses), query)
    assert found.all()
    known = gtsam_poses(poses)
    for t, pose in zip(query, got, strict=True):
        i = int(t / 0.2)
        step = gtsam.Pose2.Logmap(known[i].between(known[i + 1]))
        expected = known[i].compose(gtsam.Pose2.Expmap((t / 0.2 - i) * step))
        assert gtsam.Pose2(*pose).equals(expected, 1e-9)


def test_interpolation_follows_an_arc() -> None:
    quarter = TimedPoses(np.array([0.0, 0.2]), np.array([[1.0, 0.0, np.pi / 2], [0.0, 1.0, np.pi]]))
    poses, found = interpolate(quarter, np.array([0.1]))
    assert found.all()
    np.testing.assert_allclose(poses[0], [np.sqrt(0.5), np.sqrt(0.5), 3 * np.pi / 4], atol=1e-12)


def test_interpolation_survives_a_clock_that_steps_back() -> None:
    times = np.array([1.0, 1.2, 1.1, 1.3, 1.2])  # out of order, and 1.2 twice: the first counts
    poses = np.column_stack([[0.0, 2.0, 1.0, 3.0, 99.0], np.zeros(5), np.zeros(5)])
    got, found = interpolate(TimedPoses(times, poses), np.array([1.05, 1.15, 1.2, 1.25]))
    assert found.all()
    np.testing.assert_allclose(got[:, 0], [0.5, 1.5, 2.0, 2.5])


def test_no_pose_beside_a_gap_or_beyond_the_ends() -> None:
    times = np.array([0.0, 0.2, 2.0, 2.2])
    poses = np.column_stack([times, 0 * times, 0 * times])
    query = np.array([-0.01, 0.1, 0.2, 0.3, 1.9, 2.0, 2.21])
    got, found = interpolate(TimedPoses(times, poses), query)
    assert found.tolist() == [False, True, True, False, False, True, False]
    np.testing.assert_allclose(got[found, 0], query[found])
    assert np.isnan(got[~found]).all()


def test_an_empty_trajectory_has_no_pose() -> None:
    _, found = interpolate(TimedPoses(np.empty(0), np.empty((0, 3))), np.array([1.0]))
    assert not found.any()


def test_relation_error_is_the_true_pose_inverted_times_the_estimate() -> None:
    true = np.array([[1.0, 2.0, np.pi / 2], [0.0, 0.0, 3.1]])
    estimated = np.array([[1.3, 1.6, np.pi / 2 + 0.1], [0.0, 0.0, -3.1]])
    metres, degrees = relation_errors(true, estimated)
    np.testing.assert_allclose(metres, [0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(degrees, np.degrees([0.1, 2 * np.pi - 6.2]))


def test_relations_do_not_depend_on_the_joint_frame_but_on_errors_in_it(rng: np.random.Generator) -> None:
    times = np.linspace(0.0, 29.9, 300)
    poses = np.column_stack([np.cos(times), np.sin(times), se2.wrap(times)])
    stamps = rng.uniform(0, 29.8, (100, 2))
    where = [interpolate(TimedPoses(times, poses), column)[0] for column in stamps.T]
    relations = Relations(stamps, se2.between(where[0], where[1]))
    moved = TimedPoses(times, se2.compose(np.array([3.0, -7.0, 2.0]), poses))
    errors, across = evaluate_relations(relations, {"r": moved})
    assert across is None
    assert (errors.count, errors.no_scan, errors.unconnected) == (100, 0, 0)
    assert errors.translation.max < 1e-9
    stretched = TimedPoses(times, poses * np.array([1.1, 1.1, 1.0]))
    wrong, _ = evaluate_relations(relations, {"r": stretched})
    expected = 0.1 * np.linalg.norm(where[0][:, :2] - where[1][:, :2], axis=1)
    assert wrong.translation.mean == pytest.approx(expected.mean())
    assert wrong.translation.median == pytest.approx(np.median(expected))
    assert wrong.translation.std == pytest.approx(expected.std())
    assert wrong.rotation.max < 1e-9


def test_a_team_is_measured_across_robots_too() -> None:
    red = TimedPoses(np.array([0.0, 0.2]), np.zeros((2, 3)))
    blue = TimedPoses(np.array([10.0, 10.2]), np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    green = TimedPoses(np.array([20.0, 20.2]), np.zeros((2, 3)))
    times = np.array([[0.0, 0.1], [0.0, 10.1], [10.0, 5.0], [0.1, 20.0]])
    relations = Relations(times, np.array([[0.0, 0, 0], [1.5, 0, 0], [0, 0, 0], [0, 0, 0]]))
    team = {"red": red, "blue": blue, "green": green}
    errors, across = evaluate_relations(relations, team, {"red": 0, "blue": 0, "green": 1})
    assert (errors.count, errors.no_scan, errors.unconnected) == (2, 1, 1)
    assert across is not None
    assert (across.count, across.no_scan, across.unconnected) == (1, 0, 1)
    assert errors.translation.mean == pytest.approx(0.25)
    assert across.translation.mean == pytest.approx(0.5)


def test_where_logs_overlap_the_robot_with_the_closest_scan_answers() -> None:
    red = TimedPoses(np.array([0.0, 0.2]), np.zeros((2, 3)))
    blue = TimedPoses(np.array([0.05, 0.15]), np.full((2, 3), [5.0, 0.0, 0.0]))
    relations = Relations(np.array([[0.2, 0.15]]), np.array([[5.0, 0.0, 0.0]]))
    errors, across = evaluate_relations(relations, {"red": red, "blue": blue})
    assert across is not None
    assert across.count == 1
    assert errors.translation.max == pytest.approx(0.0)


def test_alignment_undoes_a_rigid_motion_and_is_the_best(rng: np.random.Generator) -> None:
    points = rng.normal(0, 4, (60, 2))
    motion = np.array([2.0, -3.0, 2.6])
    turned = se2.compose(motion, np.column_stack([points, np.zeros(60)]))[:, :2]
    np.testing.assert_allclose(align(turned, points), motion, atol=1e-9)
    noisy = turned + rng.normal(0, 0.3, turned.shape)
    best = align(noisy, points)

    def cost(pose: Array) -> float:
        return float(((se2.compose(pose, np.column_stack([points, np.zeros(60)]))[:, :2] - noisy) ** 2).sum())

    for step in 1e-3 * np.vstack([np.eye(3), -np.eye(3)]):
        assert cost(best) < cost(best + step)


def test_ate_aligns_the_team_as_one() -> None:
    times = np.linspace(0.0, 4.9, 50)
    line = np.column_stack([times, np.zeros(50), np.zeros(50)])
    truth = {"red": TimedPoses(times, line), "blue": TimedPoses(times, line + np.array([0.0, 2.0, 0.0]))}
    frame = np.array([5.0, 5.0, 1.0])
    exact = {name: TimedPoses(t.times, se2.compose(frame, t.poses)) for name, t in truth.items()}
    errors = evaluate_ate(truth, exact)
    assert errors.translation.max < 1e-9
    assert errors.rotation.max < 1e-6
    np.testing.assert_allclose(errors.alignment, se2.inverse(frame))
    # Each robot alone fits its truth; between them there are 0.4 m too many, which one alignment spreads evenly.
    off = truth["blue"].poses + np.array([0.0, 0.4, 0.0])
    apart = dict(exact, blue=TimedPoses(times, se2.compose(frame, off)))
    assert evaluate_ate(truth, apart).translation.rmse == pytest.approx(0.2)


def test_nees_of_honest_and_of_overconfident_estimates(rng: np.random.Generator) -> None:
    n = 20000
    root = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [0.0, 0.05, 0.1]])
    covariance = root @ root.T
    estimated = random_poses(rng, n)
    noise = [gtsam.Pose2.Expmap(xi) for xi in rng.normal(size=(n, 3)) @ root.T]
    true = se2.compose(estimated, as_array(noise))
    honest = nees(true, estimated, np.broadcast_to(covariance, (n, 3, 3)))
    assert honest.mean() == pytest.approx(1.0, abs=0.02)
    assert nees(true, estimated, np.broadcast_to(covariance / 4, (n, 3, 3))).mean() == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("1 2 3\n", ":1: expected the 8 numbers"),
        ("# comment\n\n1 2 0 0 0 0 0 0\n1 2 x 0 0 0 0 0\n", ":4: expected the 8 numbers"),
        ("1 2 nan 0 0 0 0 0\n", ":1:"),
        ("# nothing\n", ": no line"),
        ("1 2 1e300 0 0 0 0 0\n", ":1: x is 1e+300; must be within plus and minus 1e+06"),
        ("1 1e13 0 0 0 0 0 0\n", ":1: t2 is 1e+13"),
        ("1 2 0 0 0 0 0 1\n2 3 0 0 0 0 0.6 0.8\n", ": no relations: quaternions"),
    ],
)
def test_a_bad_relations_file_is_one_clear_line(tmp_path: Path, text: str, where: str) -> None:
    path = tmp_path / "bad.relations"
    path.write_text(text)
    with pytest.raises(EvaluationError) as error:
        read_relations(path)
    assert str(error.value).startswith(f"{path}{where}")
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match=r"none\.tum: cannot be read"):
        read_tum(tmp_path / "none.tum")
    with pytest.raises(EvaluationError, match=r"run\.json: cannot be read"):
        evaluate_output(tmp_path)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(EvaluationError, match=r"run\.json: not what a run writes"):
        evaluate_output(tmp_path)


def test_tum_headings_are_read_from_quaternions(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("1.5 1 2 0 0 0 1 1\n2.5 1 2 0 0 0 -0.9044122 0.4266598\n")
    poses = read_tum(path)
    np.testing.assert_allclose(poses.times, [1.5, 2.5])
    np.testing.assert_allclose(poses.poses[:, 2], [np.pi / 2, 2 * np.arctan2(-0.9044122, 0.4266598)], atol=1e-6)


def test_relations_are_no_trajectory(tmp_path: Path) -> None:
    path = tmp_path / "a.relations"
    path.write_text("1.5 1 2 0 0 0 0 1\n2.5 1 2 0 0 0 0 -0.3\n")
    with pytest.raises(EvaluationError, match=r"a\.relations: no trajectory"):
        read_tum(path)
    path.write_text("1.5 1 2 0 0 0 0 1\n2.5 1 2 0 0 0 0 -1\n")
    assert len(read_tum(path).times) == 2


def test_what_has_no_time_of_the_run_is_named_and_nothing_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    export(sample_run(), out)
    (tmp_path / "a.relations").write_text("1 2 0 0 0 0 0 0.5\n")
    with pytest.raises(
        EvaluationError, match=r"a\.relations: not of this run: .* 1\.0 to 2\.0 s; .* 100\.0 to 901\.8 s"
    ):
        evaluate_output(out, tmp_path / "a.relations")
    truth = write_truth(out, tmp_path, np.zeros(3))
    (tmp_path / "b.tum").write_text("1 0 0 0 0 0 0 1\n")
    with pytest.raises(EvaluationError, match=r"b\.tum: not of this run"):
        evaluate_output(out, truth=truth | {"blue": tmp_path / "b.tum"})
    assert not (out / "evaluation.json").exists()


def write_truth(run_dir: Path, out: Path, frame: Array) -> dict[str, Path]:
    """The run's own trajectories, seen from another frame, as the truth."""
    truth = {}
    for path in sorted((run_dir / "trajectory").glob("*.tum")):
        poses = read_tum(path)
        seen = se2.compose(frame, poses.poses)
        half = seen[:, 2] / 2
        lines = [
            f"{t:.6f} {x:.9f} {y:.9f} 0 0 0 {s:.12f} {c:.12f}\n"
            for t, (x, y, _), s, c in zip(poses.times, seen, np.sin(half), np.cos(half), strict=True)
        ]
        truth[path.stem] = out / f"true-{path.name}"
        truth[path.stem].write_text("".join(lines))
    return truth


def test_a_run_directory_is_evaluated(tmp_path: Path) -> None:
    out = tmp_path / "out"
    export(sample_run(), out)
    truth = write_truth(out, tmp_path, np.array([4.0, 1.0, 0.7]))
    relations = tmp_path / "relations"
    # red's first scan to blue's first, 0.1 m off; red to itself; red to green, who met nobody; nobody.
    seen = gtsam.Pose2(1.0, 2.0, 0.3).between(gtsam.Pose2(9.0, 3.0, 1.2))
    relations.write_text(
        f"100.0 500.0 {seen.x() + 0.1} {seen.y()} 0 0 0 {seen.theta()}\n"
        "100.0 100.0 0 0 0 0 0 0\n100.0 900.0 0 0 0 0 0 0\n1.0 2.0 0 0 0 0 0 0\n"
    )
    evaluation = evaluate_output(out, relations, truth)
    everywhere, across = evaluation.relations, evaluation.relations_across
    assert everywhere is not None
    assert across is not None
    assert (everywhere.count, everywhere.no_scan, everywhere.unconnected) == (2, 1, 1)
    assert across.translation.mean == pytest.approx(0.1, abs=1e-6)
    assert [ate.robots for ate in evaluation.ate] == [("red", "blue"), ("green",)]
    assert max(ate.translation.max for ate in evaluation.ate) < 1e-6
    assert evaluation.vertices is not None
    assert evaluation.vertices.count == 3  # all but the two roots
    assert evaluation.vertices.nees.max < 1e-6
    assert evaluation.edges is not None
    assert {kind: honesty.count for kind, honesty in evaluation.edges.items()} == {
        "covariance_intersection": 1,
        "inter_vertex": 1,
        "loop": 1,
    }
    fates = [fate for fate in sample_run().edges if fate.edge.kind == "loop" and fate.fate == "accepted"]
    poses = sample_run().vertex_poses
    edge = fates[0].edge
    assert isinstance(edge, Edge)
    error = gtsam.Pose2.Logmap(poses[edge.tail].between(poses[edge.head]).between(edge.measurement))
    expected = error @ np.linalg.inv(edge.covariance) @ error / 3
    assert evaluation.edges["loop"].nees.mean == pytest.approx(expected, rel=1e-4)
    written = json.loads((out / "evaluation.json").read_text())
    assert written["relations"]["count"] == 2
    report = evaluation_report(evaluation)
    assert len([part for part in report if not isinstance(part, str)]) == 3
    said = [part for part in report if isinstance(part, str)]
    assert "all: 1 left out, no scan at that time" in said[0]
    assert "all: 1 left out, their robots never came into one map" in said[1]


TEAM: dict[str, Any] = {
    "first_meeting": 94.0,
    "common_frame": 101.5,
    "meetings": [
        {"time": 94.0, "robots": ["red", "blue"], "bytes": {"edge": 100, "map": 2000}, "verdict": "waiting"},
        {"time": 101.5, "robots": ["blue", "red"], "bytes": {"edge": 40}, "verdict": "accepted"},
        {"time": 102.5, "robots": ["red", "green"], "bytes": {"digest": 60, "map": 0}, "verdict": "accepted"},
    ],
}


def write_team(out: Path, **changes: object) -> None:
    """A run with meetings; their reasons are not what is measured."""
    content = json.loads(RUNS[0]) | {"team": TEAM | changes}
    for meeting in content["team"]["meetings"]:
        meeting["reason"] = ""
    (out / "trajectory").mkdir(exist_ok=True)
    (out / "trajectory" / "robot.tum").write_bytes(TRAJECTORIES[0])
    (out / "run.json").write_text(json.dumps(content))


def printed(evaluation: Evaluation) -> str:
    console = Console(width=120, file=io.StringIO())
    with console.capture() as capture:
        for part in evaluation_report(evaluation):
            console.print(part)
    return capture.get()


def test_meetings_are_summed_up(tmp_path: Path) -> None:
    write_team(tmp_path)
    evaluation = evaluate_output(tmp_path)
    found = evaluation.meetings
    assert found is not None
    assert found.verdicts == {"waiting": 1, "accepted": 2}
    assert (found.first_meeting, found.to_common_frame) == (94.0, 7.5)
    assert {kind: traffic.total for kind, traffic in found.traffic_by_kind.items()} == {
        "map": 2000,
        "edge": 140,
        "digest": 60,
    }
    edge = found.traffic_by_kind["edge"].per_meeting
    assert edge.mean == pytest.approx(140 / 3)
    assert (edge.median, edge.max) == (40.0, 100.0)
    assert found.traffic.total == 2200
    assert (found.traffic.per_meeting.median, found.traffic.per_meeting.max) == (60.0, 2100.0)
    assert json.loads((tmp_path / "evaluation.json").read_text())["meetings"]["to_common_frame"] == 7.5
    said = printed(evaluation)
    assert "3 meetings (1 waiting, 2 accepted), the first at 94.0 s" in said
    assert "common frame 7.5 s of team time after it" in said
    assert re.search(r"map +│ +667 │ +0 │ +2,000 │ +2,000", said)
    assert re.search(r"together +│ +733 │ +60 │ +2,100 │ +2,200", said)


def test_meetings_without_a_common_frame_and_no_meetings(tmp_path: Path) -> None:
    write_team(tmp_path, common_frame=None)
    assert "no common frame" in printed(evaluate_output(tmp_path))
    write_team(tmp_path, first_meeting=None, common_frame=None, meetings=[])
    evaluation = evaluate_output(tmp_path)
    assert evaluation.meetings is not None
    assert evaluation.meetings.traffic.total == 0
    assert printed(evaluation).strip() == "no two robots met"
    assert json.loads((tmp_path / "evaluation.json").read_text())["meetings"]["verdicts"] == {}
    content = json.loads(RUNS[0])
    del content["team"]
    (tmp_path / "run.json").write_text(json.dumps(content))
    assert evaluate_output(tmp_path).meetings is None


@pytest.mark.parametrize(
    "change",
    [
        {"first_meeting": "soon"},
        {"common_frame": float("nan")},
        {"meetings": [{}]},
        {"meetings": [TEAM["meetings"][0] | {"bytes": {"edge": -1}}]},
        {"meetings": [TEAM["meetings"][0] | {"robots": ["red"]}]},
        {"meetings": [TEAM["meetings"][0] | {"verdict": "perhaps"}]},
    ],
)
def test_damaged_meetings_are_named(tmp_path: Path, change: dict[str, object]) -> None:
    write_team(tmp_path, **change)
    with pytest.raises(EvaluationError, match=r"run\.json: not what a run writes \(team\..*\); run again"):
        evaluate_output(tmp_path)


def test_truth_must_name_robots_of_the_run(tmp_path: Path) -> None:
    export(sample_run(), tmp_path)
    with pytest.raises(EvaluationError, match="truth of 'pink', but the run has only red, blue, green"):
        evaluate_output(tmp_path, truth={"pink": tmp_path / "x.tum"})
    with pytest.raises(EvaluationError, match="one truth for 3 robots"):
        evaluate_output(tmp_path, truth=tmp_path / "x.tum")


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("robots", "robot"), {}),
        (("robots",), {}),
        (("robots",), {"../../robot": {"component": 0}}),
        (("robots",), {"a\u2028b": {"component": 0}}),
        (("components", 0), []),
        (("vertices", 0, "id"), ["robot"]),
        (("vertices", 0, "first_scan", "pose"), [1, 2]),
        (("vertices", 0, "first_scan", "time"), float("nan")),
        (("vertices", 1, "pose", 0), 1e300),
        (("vertices", 1, "covariance"), [[1, 0, 0], [0, 1, 0], [0, 0, 0]]),
        (("edges", 0, "covariance", 0), [1, 2]),
        (("edges", 0), None),
        (("edges", 0), {"tail": ["a", 0], "head": ["a", 1], "kind": "loop", "fate": "", "measurement": [1, 2, 3]}),
    ],
)
def test_a_damaged_run_is_named(tmp_path: Path, place: tuple[str | int, ...], value: object) -> None:
    content = json.loads(RUNS[0])
    *way, last = place
    entry = content
    for step in way:
        entry = entry[step]
    entry[last] = value
    (tmp_path / "run.json").write_text(json.dumps(content))
    with pytest.raises(EvaluationError, match=r"run\.json: not what a run writes \(.*\); run again") as caught:
        evaluate_output(tmp_path)
    assert str(caught.value).isprintable()
