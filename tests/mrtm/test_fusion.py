"""The joint grid: against a slow reference, and against what a wall must survive."""

import math

import gtsam
import numpy as np
import numpy.typing as npt
import pytest

from frontend.local_map import Grid, LocalMap
from mrtm.joint import fusion
from mrtm.joint.fusion import FREE_VOTE, LIMIT, OCCUPIED_VOTE, fuse

Log = npt.NDArray[np.float32]
RESOLUTION = 0.05


def local_map(log_odds: npt.ArrayLike, origin: tuple[float, float] = (0.0, 0.0)) -> LocalMap:
    none = np.empty((0, 3))
    grid = Grid(np.array(log_odds, np.float32), RESOLUTION, np.array(origin))
    return LocalMap(grid, np.empty(0, np.int64), np.empty(0), none, np.empty((0, 2)), np.empty((0, 2)))


def wall_seen_from_the_left(column: int, size: int = 80) -> Log:
    """Free, then a wall one cell wide, then unknown."""
    log_odds = np.zeros((size, size), np.float32)
    log_odds[:, :column] = -3.0
    log_odds[:, column] = 4.0
    return log_odds


def slow_fuse(maps: list[tuple[gtsam.Pose2, LocalMap]], grid: Grid) -> npt.NDArray[np.float64]:
    """Obvious, cell by cell: vote, interpolate, sum."""
    total = np.zeros(grid.log_odds.shape)
    for row, column in np.ndindex(total.shape):
        centre = grid.origin + grid.resolution * (np.array([column, row]) + 0.5)
        for pose, local in maps:
            votes = np.pad(local.grid.log_odds.clip(-FREE_VOTE, OCCUPIED_VOTE), 1)
            x, y = (pose.transformTo(centre) - local.grid.origin) / local.grid.resolution + 0.5
            c, r = math.floor(x), math.floor(y)
            if 0 <= r < votes.shape[0] - 1 and 0 <= c < votes.shape[1] - 1:
                u, v = x - c, y - r
                total[row, column] += np.array([1 - v, v]) @ votes[r : r + 2, c : c + 2] @ np.array([1 - u, u])
    return np.asarray(total.clip(-LIMIT, LIMIT))


@pytest.mark.parametrize("resolution", [0.05, 0.03, 0.11])
def test_agrees_with_the_slow_reference(resolution: float) -> None:
    rng = np.random.default_rng(5)
    maps = [
        (
            gtsam.Pose2(rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-np.pi, np.pi)),
            local_map(rng.normal(0, 4, (rng.integers(5, 20), rng.integers(5, 20))), (-0.3, 0.2)),
        )
        for _ in range(4)
    ]
    grid = fuse(maps, resolution)
    np.testing.assert_allclose(grid.log_odds, slow_fuse(maps, grid), atol=2e-4)
    assert grid.log_odds.any()


def test_a_map_in_its_own_frame_is_itself_clipped_and_cropped() -> None:
    log_odds = np.zeros((20, 30), np.float32)
    log_odds[5:9, 10:17] = -1.0
    log_odds[8, 10:17] = 9.0
    grid = fuse([(gtsam.Pose2(), local_map(log_odds, (-1.0, 2.0)))], RESOLUTION)
    np.testing.assert_allclose(grid.origin, [-1.0 + 10 * RESOLUTION, 2.0 + 5 * RESOLUTION], atol=1e-9)
    np.testing.assert_allclose(grid.log_odds, log_odds[5:9, 10:17].clip(-FREE_VOTE, OCCUPIED_VOTE), atol=1e-4)


def test_quarter_turns_are_exact() -> None:
    rng = np.random.default_rng(2)
    log_odds = rng.uniform(0.5, 1.0, (6, 9)).astype(np.float32)
    grid = fuse([(gtsam.Pose2(0, 0, math.pi / 2), local_map(log_odds))], RESOLUTION)
    # x becomes y, y becomes -x: row r, column c goes to row c, column 5 - r.
    np.testing.assert_allclose(grid.log_odds, log_odds.T[:, ::-1], atol=1e-3)
    np.testing.assert_allclose(grid.origin, [-6 * RESOLUTION, 0.0], atol=1e-9)


@pytest.mark.parametrize("degrees", [0, 7, 30, 45, 61])
@pytest.mark.parametrize("shift", [0.0, 0.0125, 0.025])
def test_a_wall_stays_closed_and_thin(degrees: float, shift: float) -> None:
    pose = gtsam.Pose2(shift, shift, math.radians(degrees))
    grid = fuse([(pose, local_map(wall_seen_from_the_left(40)))], RESOLUTION)
    wall = np.pad(grid.log_odds > 0.62, 20)
    # Cross the wall square to it, every quarter of a cell along it: always a wall, at most two and a half cells of it.
    for along in np.arange(0.5, 3.5, RESOLUTION / 4):
        across = 40.5 * RESOLUTION + np.arange(-0.3, 0.3, 0.002)
        points = np.array([pose.transformFrom(np.array([x, along])) for x in across])
        columns, rows = np.floor((points - grid.origin) / RESOLUTION).astype(int).T + 20
        crossed = wall[rows, columns]
        assert crossed.any()
        assert np.ptp(across[crossed]) < 2.5 * RESOLUTION


def test_maps_a_cell_apart_keep_the_wall_and_outvote_a_ghost() -> None:
    maps = [(gtsam.Pose2(), local_map(wall_seen_from_the_left(column))) for column in (40, 41, 40, 41, 40)]
    ghost = wall_seen_from_the_left(40)
    ghost[30:34, 10:14] = 4.0  # a person who stood still in one map only
    grid = fuse([*maps, (gtsam.Pose2(), local_map(ghost))], RESOLUTION)
    wall = grid.log_odds > 0.62
    assert wall[:, 40:42].all()
    assert not wall[:, :40].any()


def test_a_box_is_covered_exactly() -> None:
    maps = [(gtsam.Pose2(), local_map(wall_seen_from_the_left(40)))]
    grid = fuse(maps, 0.1, np.array([[-1.0, 0.5], [1.0, 1.5]]))
    assert grid.log_odds.shape == (10, 20)
    np.testing.assert_allclose(grid.origin, [-1.0, 0.5])
    assert (grid.log_odds[:, :9] == 0).all()
    assert (grid.log_odds[:, 11:] < 0).all()


def test_nothing_known_is_one_unknown_cell() -> None:
    for maps in ([], [(gtsam.Pose2(), local_map(np.zeros((4, 4), np.float32)))]):
        assert fuse(maps, RESOLUTION).log_odds.tolist() == [[0.0]]


def test_the_same_maps_give_the_same_bits() -> None:
    rng = np.random.default_rng(1)
    maps = [(gtsam.Pose2(*rng.normal(0, 1, 3)), local_map(rng.normal(0, 3, (60, 60)))) for _ in range(5)]
    assert fuse(maps).log_odds.tobytes() == fuse(maps).log_odds.tobytes()


def test_bad_input_is_refused() -> None:
    maps = [(gtsam.Pose2(math.nan, 0, 0), local_map(wall_seen_from_the_left(3, 8)))]
    with pytest.raises(ValueError, match="not finite"):
        fuse(maps)
    with pytest.raises(ValueError, match="resolution"):
        fuse([], 0.0)


def test_over_much_ground_cells_are_coarser(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fusion, "MOST_CELLS", 1e4)
    one = local_map(np.ones((20, 20), np.float32))
    grid = fuse([(gtsam.Pose2(), one), (gtsam.Pose2(30.0, 20.0, 0.0), one)])
    assert grid.resolution == 0.4
    assert grid.log_odds.size <= 1e4
    assert grid.resolution * grid.log_odds.shape[1] > 30.0
