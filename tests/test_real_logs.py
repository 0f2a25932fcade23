"""The default configuration on real logs, against the bars it must reach."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from factors import EdgeKind
from frontend.readers import open_log
from mrtm.config import load_config
from mrtm.evaluation import TimedPoses, evaluate_ate, evaluate_relations, read_relations, read_tum
from mrtm.joint.doubts import GATE
from mrtm.result import RunResult
from mrtm.session import map_scans, map_session
from mrtm.team.session_file import open_session

pytestmark = pytest.mark.slow


def run(log: Path, seconds: float = math.inf, options: Sequence[str] = ()) -> tuple[RunResult, dict[str, TimedPoses]]:
    """Map a log, or the first ``seconds`` of it."""
    if not log.exists():
        pytest.skip(f"no {log}")
    scans = list(open_log(log).scans())
    begun = [scan for scan in scans if scan.time < scans[0].time + seconds]
    result = map_scans(begun, load_config(options=options))
    return result, {name: TimedPoses(t.times, t.poses) for name, t in result.trajectories.items()}


def check_loops(result: RunResult) -> None:
    """A false loop either strains against the rest of the graph, or bends it: that is for the relations to show."""
    loops = [fate for fate in result.edges if fate.fate == "accepted" and fate.edge.kind is not EdgeKind.INTER_VERTEX]
    assert loops
    for fate in loops:
        assert fate.chi2 < GATE[3], fate.edge
        edge = fate.edge
        a, b = result.vertex_poses[edge.tail], result.vertex_poses[edge.head]
        assert edge.estimate is not None
        strain = edge.estimate.pose.between(a.between(b))
        assert np.hypot(strain.x(), strain.y()) < 0.5, edge
    assert len(result.components) == 1


@pytest.mark.parametrize(
    ("name", "scans", "metres", "degrees", "worst"),
    [("intel", 13631, 0.026, 1.0, 0.5), ("aces", 7374, 0.046, 0.7, 1.0)],
)
def test_relations(data: Path, name: str, scans: int, metres: float, degrees: float, worst: float) -> None:
    result, trajectories = run(data / f"{name}.clf.bz2")
    assert result.counts["scans"] == scans
    true = read_relations(data / f"{name}.relations")
    errors, _ = evaluate_relations(true, trajectories)
    assert errors.count > 0.95 * len(true.times)
    assert errors.translation.mean <= metres
    assert errors.rotation.mean <= degrees
    assert errors.translation.max < worst
    assert errors.rotation.max < 10.0
    check_loops(result)


@pytest.mark.parametrize(
    ("name", "crossing", "bounds"),
    [("intel-3robots", 826, (0.022, 0.5, 0.025, 0.6)), ("aces-2robots", 45, (0.042, 0.6, 0.075, 1.0))],
)
def test_team(data: Path, name: str, crossing: int, bounds: tuple[float, float, float, float]) -> None:
    """Robots that did not know where the others started: no worse between them than within the map of one."""
    session = open_session(data / f"{name}.yaml")
    result = map_session(session, load_config(), lambda done, doing: None)
    assert len(result.components) == 1
    assert session.relations is not None
    errors, between = evaluate_relations(
        read_relations(session.relations),
        {robot: TimedPoses(t.times, t.poses) for robot, t in result.trajectories.items()},
    )
    assert between is not None
    assert between.count == crossing
    found = errors.translation.mean, errors.rotation.mean, between.translation.mean, between.rotation.mean
    assert np.all(np.array(found) <= bounds), found


def test_csail(data: Path) -> None:
    """The reference is another system's, good to about 0.1 m."""
    result, trajectories = run(data / "mit-csail.clf.bz2")
    assert result.counts["scans"] == 1988
    (robot,) = trajectories
    errors = evaluate_ate({robot: read_tum(data / "mit-csail.reference.tum")}, trajectories)
    assert errors.count == 1051
    assert errors.translation.rmse <= 0.20
    assert errors.translation.max < 1.0
    check_loops(result)


@pytest.mark.parametrize("seed", [0, 3, 4])
def test_a_turn_that_odometry_missed_is_found_among_clutter(data: Path, seed: int) -> None:
    """At 73 s CSAIL's odometry jumps by 0.22 rad in a spin: the wider search's lattice passes the true pose over."""
    _, trajectories = run(data / "mit-csail.clf.bz2", 100.0, [f"seed={seed}", "frontend.particles=80"])
    (robot,) = trajectories
    errors = evaluate_ate({robot: read_tum(data / "mit-csail.reference.tum")}, trajectories)
    assert errors.count > 200
    assert errors.translation.max < 1.0
