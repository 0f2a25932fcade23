"""The honesty of covariances is measured right: on samples whose honesty is known, and on a run with a known error."""

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

from factors import Edge, EdgeId, EdgeKind, VertexId
from frontend.local_map import Grid, LocalMap
from frontend.records import FloatArray
from mrtm.result import EdgeFate, Event, RunResult
from tools.honesty.runs import ENTERING, VERTEX, Sample, finished, samples_of
from tools.honesty.statistics import components, verdict
from tools.honesty.tables import tables
from tools.nees import app

COVARIANCE = np.array([[4e-2, 1e-2, -1e-3], [1e-2, 1e-2, 2e-3], [-1e-3, 2e-3, 1e-3]])


def drawn(factor: float, kind: str = "loop", runs: int = 20, each: int = 20) -> list[Sample]:
    """Measurements whose errors have COVARIANCE; what they claim is ``factor`` times that."""
    random = np.random.default_rng(3)
    samples = []
    for seed in range(runs):
        for xi in random.multivariate_normal(np.zeros(3), COVARIANCE, each):
            true = random.uniform(-3, 3, 3)
            measured = gtsam.Pose2(*true).compose(gtsam.Pose2.Expmap(xi))
            pose = np.array([measured.x(), measured.y(), measured.theta()])
            samples.append(Sample("hall", seed, kind, "edge", true, pose, factor * COVARIANCE, 0.0, 0))
    return samples


def test_honest_covariances_are_called_so() -> None:
    v = verdict(drawn(1.0))
    assert v is not None
    assert v.is_honest
    assert 0.9 < v.mean < 1.1
    assert v.chi2[0] < v.mean < v.chi2[1]
    assert v.bootstrap[0] < 1.0 < v.bootstrap[1]
    assert v.median == pytest.approx(0.789, abs=0.1)
    assert v.beyond == pytest.approx(0.05, abs=0.03)
    assert (v.count, v.runs) == (400, 20)


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_wrong_covariances_are_found_out(factor: float) -> None:
    v = verdict(drawn(factor))
    assert v is not None
    assert not v.is_honest
    assert v.mean == pytest.approx(1.0 / factor, rel=0.1)


def test_runs_not_samples_are_independent() -> None:
    """Twenty copies of one sample a run are as uncertain as one sample a run."""
    one = drawn(1.0, each=1, runs=40)
    single, copied = verdict(one), verdict([sample for sample in one for _ in range(20)])
    assert single is not None
    assert copied is not None
    assert copied.bootstrap == pytest.approx(single.bootstrap)
    assert np.ptp(copied.chi2) < 0.5 * np.ptp(single.chi2)


def test_components_name_the_direction_that_lies() -> None:
    """The covariance claims the corridor is known ten times as well as it is along, in frames of any heading."""
    random = np.random.default_rng(4)
    samples = []
    for heading in random.uniform(-np.pi, np.pi, 500):
        c, s = np.cos(heading), np.sin(heading)
        plan_T_child = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        error = plan_T_child.T @ (random.normal(size=3) * (0.5, 0.02, 0.001))
        claimed = plan_T_child.T @ np.diag([0.05**2, 0.02**2, 0.001**2]) @ plan_T_child
        samples.append(Sample("corridor", 0, "loop", "e", np.zeros(3), error, claimed, heading))
    parts = {part.name: part for part in components(samples, axis_aligned=True)}
    assert parts["along"].ratio == pytest.approx(10, rel=0.15)
    assert parts["across"].ratio == pytest.approx(1, rel=0.15)
    assert parts["weak"].ratio == pytest.approx(10, rel=0.15)
    assert parts["strong"].ratio == pytest.approx(1, rel=0.15)
    assert parts["along"].sigma == pytest.approx(0.05)
    assert "along" not in {part.name for part in components(samples, axis_aligned=False)}


def a_run(measured: gtsam.Pose2, truth: FloatArray) -> RunResult:
    """Two vertices, made at scans 0 and 2; the second's first pose is not quite at its origin."""
    a, b = VertexId("r", 0), VertexId("r", 1)
    grid = Grid(np.zeros((1, 1), np.float32), 0.05, np.zeros(2))
    covariance = np.diag([0.01, 0.01, 0.001])

    def local(scans: list[int], first: FloatArray) -> LocalMap:
        poses, none = np.tile(first, (len(scans), 1)), np.empty((0, 2))
        return LocalMap(grid, np.array(scans), np.array(scans, float), poses, none, none)

    def edge(version: int, kind: EdgeKind) -> Edge:
        return Edge(EdgeId("r", 0), version, kind, a, b, measured, covariance)

    first, last = edge(0, EdgeKind.LOOP), edge(1, EdgeKind.LOOP)
    return RunResult(
        config={},
        seed=0,
        trajectories={},
        local_maps={a: local([0, 1], np.zeros(3)), b: local([2, 3], np.array([0.1, 0.0, 0.0]))},
        map_poses={},
        vertex_poses={a: gtsam.Pose2(1, 1, 1), b: gtsam.Pose2(1, 1, 1).compose(measured)},
        vertex_covariances={a: covariance, b: 4 * covariance},
        components=[[a, b]],
        edges=[EdgeFate(first, "replaced"), EdgeFate(last, "accepted"), EdgeFate(edge(2, EdgeKind.LOOP), "refused")],
        events=[
            Event(2.0, "r", "left vertex", {"since_resampling": 7}),
            Event(2.0, "r", "loop closed", {"edge": str(first), "offset": [0, 0, 0], "innovation": 0.5}),
            Event(3.0, "r", "left vertex", {"since_resampling": 1}),
            Event(3.0, "r", "edge updated", {"edge": str(last)}),
        ],
        timings={},
        longest={},
        counts={},
        blemishes=[],
    )


def test_errors_are_against_the_pose_at_the_scan_that_made_the_vertex() -> None:
    truth = np.array([[5.0, 5, np.pi / 2], [0, 0, 0], [5.0, 7.1, np.pi / 2], [0, 0, 0]])  # b's frame: 2 m ahead of a's
    samples = samples_of(a_run(gtsam.Pose2(2.3, 0.0, 0.0), truth), truth, "hall", 1)
    assert [s.kind for s in samples] == [ENTERING, "loop", VERTEX]
    for sample in samples:
        np.testing.assert_allclose(sample.error, [0.3, 0, 0], atol=1e-12)
        assert sample.heading == pytest.approx(np.pi / 2)
    assert [s.nees for s in samples] == pytest.approx([3.0, 3.0, 0.75])
    assert [s.since_resampling for s in samples] == [7, 1, None]
    assert not samples[1].is_false


def test_false_loops_are_listed_with_plan_and_seed() -> None:
    true, covariance = np.array([2.0, 0, 0]), np.diag([1e-4, 1e-4, 1e-4])
    offsets = {"off by 0.6 m": 0.6, "many sigmas and 0.3 m": 0.3, "many sigmas, little": 0.1}
    samples = [
        Sample("hall", 8, "loop", name, true, true + np.array([off, 0, 0]), covariance, 0.0, 0)
        for name, off in offsets.items()
    ]
    assert [s.is_false for s in samples] == [True, True, False]


def test_innovations_of_a_finished_run(tmp_path: Path) -> None:
    event = {"time": 1.0, "robot": "r", "kind": "re-entered", "detail": {"offset": [0.1, 0, 0], "innovation": 2.5}}
    (tmp_path / "run.json").write_text(json.dumps({"seed": 4, "events": [event, event | {"detail": {}}]}))
    run = finished(tmp_path)
    assert [(i.kind, i.seed, i.normalised) for i in run.innovations] == [("re-entered", 4, 2.5)]
    (table,) = tables([run])
    assert "2.50" in table.markdown()
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(ValueError, match=r"run\.json: not what a run writes"):
        finished(tmp_path)


def test_unknown_plan_is_one_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["--plans", "castle", "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert "no such building" in result.output
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_command_line(tmp_path: Path) -> None:
    command = ["--plans", "cluttered", "--seeds", "2", "--laps", "1", "--jobs", "2", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    text = (tmp_path / "nees.md").read_text()
    assert "| inter_vertex | cluttered |" in text
    assert "| joint vertex | cluttered |" in text
    assert (tmp_path / "nees.png").stat().st_size > 10_000
