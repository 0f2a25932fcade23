import math

import gtsam
import numpy as np
import pytest

from factors import VertexId
from frontend.local_map import Grid, LocalMap
from mrtm.joint.crispness import KNOWN, crispness, opinions
from tests.mrtm.sample_run import sample_run

RUN = sample_run()
TEAM = [VertexId(robot, index) for robot in ("red", "blue") for index in (0, 1)]
Maps = list[tuple[gtsam.Pose2, LocalMap]]


def maps(spread: float = 0.0, seed: int = 0) -> Maps:
    """Four maps of the same rooms, displaced at random."""
    rng = np.random.default_rng(seed)
    off = rng.normal(0.0, 1.0, (len(TEAM), 3)) * [spread, spread, spread / 5]
    return [(RUN.vertex_poses[v].compose(gtsam.Pose2(*d)), RUN.local_maps[v]) for v, d in zip(TEAM, off, strict=True)]


def flat(value: float, cells: int = 20, resolution: float = 0.1) -> LocalMap:
    grid = Grid(np.full((cells, cells), value, np.float32), resolution, np.zeros(2))
    nothing = np.empty((0, 2))
    return LocalMap(grid, np.empty(0, np.int64), np.empty(0), np.empty((0, 3)), nothing, nothing)


def bits(p: float) -> float:
    return -p * math.log2(p) - (1 - p) * math.log2(1 - p)


def probability(log_odds: float) -> float:
    return 1 / (1 + math.exp(-log_odds))


@pytest.mark.parametrize("seed", range(3))
def test_crisp_at_the_truth_and_worse_the_further_off(seed: int) -> None:
    found = [crispness(maps(spread, seed)) for spread in (0.0, 0.02, 0.06, 0.2)]
    for measure in ([c.entropy for c in found], [c.disagreement for c in found]):
        assert measure == sorted(measure)
        assert measure[-1] > 1.1 * measure[0]
    assert found[-1].disagreement > 1.4 * found[0].disagreement


def test_the_whole_map_may_lie_anywhere() -> None:
    frame = gtsam.Pose2(13.37, -4.2, 0.7)
    here, there = (crispness(m) for m in (maps(0.02), [(frame.compose(pose), m) for pose, m in maps(0.02)]))
    assert there.entropy == pytest.approx(here.entropy, rel=0.05)
    assert there.disagreement == pytest.approx(here.disagreement, rel=0.1)
    assert there.area == pytest.approx(here.area, rel=0.02)


def test_two_maps_that_agree_are_as_sure_as_each_and_contradict_by_nothing() -> None:
    found = crispness([(gtsam.Pose2(), flat(-2.0)), (gtsam.Pose2(), flat(-2.0))])
    assert found.entropy == pytest.approx(bits(probability(-2.0)))
    assert found.disagreement == pytest.approx(0.0, abs=1e-6)
    assert found.area == pytest.approx(4.0, rel=0.01)


def test_two_maps_that_contradict_each_other_make_one_bit() -> None:
    found = crispness([(gtsam.Pose2(), flat(-6.0)), (gtsam.Pose2(), flat(6.0))])
    assert found.entropy == pytest.approx(1.0)
    assert found.disagreement == pytest.approx(1.0 - bits(probability(6.0)))


def test_only_where_two_maps_know_something_counts() -> None:
    one = (gtsam.Pose2(), flat(-3.0))
    assert math.isnan(crispness([one]).entropy)
    assert crispness([one, (gtsam.Pose2(5.0, 0.0, 0.0), flat(3.0))]).area == 0.0
    assert math.isnan(crispness([one, (gtsam.Pose2(), flat(0.9 * KNOWN))]).entropy)
    assert math.isnan(crispness([]).entropy)
    half = crispness([one, (gtsam.Pose2(1.0, 0.0, 0.0), flat(-3.0))])
    assert half.area == pytest.approx(2.0, rel=0.06)


def test_opinions_say_where() -> None:
    contradicting = (gtsam.Pose2(1.0, 0.0, 0.0), flat(6.0))
    entropy, disagreement = opinions(
        [(gtsam.Pose2(), flat(-6.0)), contradicting], np.array([[0.0, 0.0], [3.0, 2.0]]), 0.1
    )
    assert entropy.shape == (20, 30)
    assert np.isnan(entropy[:, :9]).all()
    assert np.isnan(disagreement[:, 21:]).all()
    assert entropy[5, 15] == pytest.approx(1.0)
