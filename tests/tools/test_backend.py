"""The benchmark of the back end: pose graphs in a robot's order, fed to every back end, compared with the optimum."""

import lzma
from pathlib import Path

import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

from factors import EdgeKind
from frontend.records import FloatArray
from tools.bench.backend import BACKENDS, feed, solve
from tools.bench.pose_graphs import PoseGraph, find_pose_graphs
from tools.benchmark import app

COVARIANCE = np.diag([0.02, 0.02, 0.01]) ** 2
SIDE = gtsam.Pose2(5.0, 0.0, np.pi / 6)


def line(word: str, tail: int, head: int, step: gtsam.Pose2, information: FloatArray) -> str:
    upper = information[np.triu_indices(3)]
    return " ".join(map(str, (word, tail, head, step.x(), step.y(), step.theta(), *upper))) + "\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three rounds of a ring of twelve, with noise, as city10000 with its truth; edges in no order."""
    rng = np.random.default_rng(3)
    truth = [gtsam.Pose2()]
    while len(truth) < 36:
        truth.append(truth[-1].compose(SIDE))
    pairs = [(i, i + 1) for i in range(35)] + [(i, i - 12) for i in range(12, 36, 3)]
    information = np.linalg.inv(COVARIANCE).astype(np.float64)
    lines = []
    for tail, head in rng.permutation(pairs).tolist():
        noise = gtsam.Pose2.Expmap(rng.multivariate_normal(np.zeros(3), COVARIANCE))
        lines.append(line("EDGE2", tail, head, truth[tail].between(truth[head]).compose(noise), information))
    place = tmp_path / "posegraphs"
    place.mkdir()
    with lzma.open(place / "isam_city10000.txt.xz", "wt") as stream:
        stream.writelines(lines)
    with lzma.open(place / "city10000_groundtruth.txt.xz", "wt") as stream:
        stream.writelines(line("EDGE2", i, i + 1, SIDE, information) for i in range(35))
    return tmp_path


@pytest.fixture
def ring(folder: Path) -> PoseGraph:
    (graph,) = find_pose_graphs([folder / "elsewhere", folder])
    return graph


def test_edges_come_in_the_order_of_a_drive(ring: PoseGraph) -> None:
    assert ring.name == "city10000"
    assert len(ring.edges) == 43
    known = {0}
    for edge in ring.edges:
        ends = {edge.tail.number, edge.head.number}
        assert len(ends - known) == (edge.kind is EdgeKind.INTER_VERTEX)  # every loop has both its poses
        known |= ends
    assert ring.truth is not None
    np.testing.assert_allclose(ring.truth[12], 0.0, atol=1e-9)
    np.testing.assert_allclose(ring.edges[0].covariance, COVARIANCE, rtol=1e-9)


def test_a_cut_graph_has_the_poses_asked_for(folder: Path) -> None:
    (graph,) = find_pose_graphs([folder], poses=14)
    assert {edge.head.number for edge in graph.edges} | {0} == set(range(14))
    assert [edge.kind for edge in graph.edges].count(EdgeKind.LOOP) == 1
    assert graph.truth is not None
    assert len(graph.truth) == 14


def test_every_back_end_comes_to_the_optimum(ring: PoseGraph) -> None:
    told: list[str] = []
    batch = solve(ring)
    assert batch.gap < 1e-3
    for name in BACKENDS:
        fed = feed(ring, name, told.append)
        assert len(fed.seconds) == len(ring.edges)
        assert (fed.seconds > 0).all()
        assert fed.gap <= fed.worst_gap
        assert fed.worst_gap < (0.05 if name == "bare iSAM2" else 1e-3)
        assert fed.cost == pytest.approx(batch.cost, rel=0.01)
        assert fed.ate is not None
        assert 0.0 < fed.ate < 0.5
    assert told[-1].startswith("city10000, joint graph: 43 of 43 edges")


def test_the_command_writes_table_and_picture(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tools.benchmark.places", lambda: [folder])
    result = CliRunner().invoke(app, ["--backend", "--poses", "20", "--out", str(tmp_path / "out"), "--note", "small"])
    assert result.exit_code == 0, result.output
    (table,) = (tmp_path / "out").glob("*-backend.md")
    text = table.read_text()
    assert "city10000: 20 poses, 22 edges" in text
    assert all(f"| {name} |" in text for name in (*BACKENDS, "batch"))
    assert table.with_suffix(".png").stat().st_size > 10_000


def test_without_pose_graphs_the_command_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tools.benchmark.places", lambda: [tmp_path])
    result = CliRunner().invoke(app, ["--backend", "--out", str(tmp_path)])
    assert result.exit_code == 1
    assert "set MRTM_DATA" in result.output
