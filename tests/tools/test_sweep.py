"""The sweep: what its table says of runs, and a small one for real."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from tools.sweep import Outcome, app, table


def test_the_table_tells_spread_and_names_the_seeds_of_broken_maps() -> None:
    outcomes = [Outcome("hall", "", seed, error, error > 0.3) for seed, error in enumerate((0.02, 0.01, 0.5))]
    outcomes += [Outcome("hall", "topology.omega=0.4", 0, 0.03, False)]
    first, second = table(outcomes).splitlines()[2:]
    assert first == "| hall | default | 3 | 0.0200 | 0.0100 | 0.5000 | 50.00 | 2 |"
    assert second == "| hall | topology.omega=0.4 | 1 | 0.0300 | 0.0300 | 0.0300 | 1.00 | none |"


@pytest.mark.slow
def test_the_command_maps_every_change(tmp_path: Path) -> None:
    command = ["--plans", "cluttered", "--seeds", "1", "--no-logs", "--vary", "frontend.particles=8", "--jobs", "1"]
    result = CliRunner().invoke(app, [*command, "--set", "x"])
    assert result.exit_code == 2  # it is called --vary
    result = CliRunner().invoke(app, [*command, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    written = (tmp_path / "sweep.md").read_text()
    assert "| cluttered | default | 1 |" in written
    assert "| cluttered | frontend.particles=8 | 1 |" in written
