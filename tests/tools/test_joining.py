import numpy as np
import typer
from typer.testing import CliRunner

from factors import EdgeKind, VertexId
from tools.bench import joining


def test_components_are_joined_whole() -> None:
    assert joining.join(12, 3, seed=0) > 0.0


def test_a_driven_graph_has_its_vertices_and_loops() -> None:
    graph, poses = joining.drive("red", 12, 4, np.random.default_rng(0))
    assert len(graph.vertices()) == len(poses) == 12
    assert sum(edge.kind is EdgeKind.LOOP for edge in graph.edges()) == 4
    found = graph.estimate(VertexId("red", 11))
    assert np.hypot(found.x() - poses[11].x(), found.y() - poses[11].y()) < 2.0


def test_command_prints_both_counts() -> None:
    app = typer.Typer()
    app.command()(joining.main)
    result = CliRunner().invoke(app, ["--vertices", "10", "--runs", "2"])
    assert result.exit_code == 0
    assert "1 fusing edges" in result.stdout
    assert "5 fusing edges" in result.stdout
