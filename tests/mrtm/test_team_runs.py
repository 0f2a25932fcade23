"""Whole sessions of simulated teams, from their files to the joint map; they take a while."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from mrtm.config import load_config
from mrtm.evaluation import evaluate_output
from mrtm.result import RunResult
from mrtm.session import run_session
from tests.mrtm.small_logs import small
from tools.simulation import LMS200, OdometryNoise, SightingModel, simulate_team, write_session
from tools.simulation.floors import wings

DEMO = Path(__file__).parents[2] / "data" / "demo"
NAMES = ["red", "blue", "green"]

pytestmark = pytest.mark.slow


def run(session: Path, out: Path, *options: str) -> RunResult:
    config = load_config(options=["frontend.particles=10", *options])
    return run_session(session, out, config, lambda fraction, doing: None)


@pytest.fixture(scope="module")
def headless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three robots in three wings; whoever sees another does not see where that one looks."""
    folder = tmp_path_factory.mktemp("headless")
    team = simulate_team(wings(0), NAMES, LMS200, OdometryNoise(), 1)
    write_session(team, SightingModel(sigma_heading=None), 1, folder)
    return folder


@pytest.mark.parametrize(("alignments", "rmse"), [(0, 2.0), (12, 0.1)])
def test_a_whole_team_without_headings_comes_into_one_frame(
    headless: Path, tmp_path: Path, alignments: int, rmse: float
) -> None:
    """Seen within a few metres of each other, wings of 20 m lie a little askew until their maps are aligned."""
    assert ",,0.05,0.02," in (headless / "sightings.csv").read_text()
    result = run(headless / "team.yaml", tmp_path, f"joint.alignments={alignments}")
    assert len(result.components) == 1
    assert result.team is not None
    assert all(fate.fate == "accepted" for fate in result.team.sightings)
    (ate,) = evaluate_output(tmp_path, truth={name: headless / "truth" / f"{name}.tum" for name in NAMES}).ate
    assert ate.translation.rmse < rmse


def test_the_order_of_the_robots_in_the_file_does_not_matter(tmp_path: Path) -> None:
    session = yaml.safe_load((DEMO / "team.yaml").read_text())
    for robot in session["robots"].values():
        robot["log"] = str(DEMO / robot["log"])
    session["sightings"] = str(DEMO / session["sightings"])
    del session["truth"]
    results = []
    for order in (NAMES, NAMES[::-1]):
        session["robots"] = {name: session["robots"][name] for name in order}
        path = tmp_path / f"{order[0]}.yaml"
        path.write_text(yaml.safe_dump(session, sort_keys=False))
        results.append(run_session(path, tmp_path / order[0], small(), lambda fraction, doing: None))
        assert list(results[-1].trajectories) == order
    one, other = results
    for name in NAMES:
        np.testing.assert_array_equal(one.trajectories[name].poses, other.trajectories[name].poses)
    assert one.components == other.components
    assert one.team is not None
    assert other.team is not None
    assert one.team.meetings == other.team.meetings
    assert one.team.sightings == other.team.sightings
    for name in ("map.pgm", "map.yaml"):
        first, second = ((tmp_path / start / name).read_bytes() for start in ("red", "green"))
        assert first == second
