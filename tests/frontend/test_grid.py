"""Maps against the reference: hits, carving, surfels, the index of the nearest, and keeping many maps apart."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from frontend import grid
from frontend.grid import Maps, in_rows
from frontend.points import Points
from frontend.records import FloatArray
from tests.frontend import reference
from tests.frontend.simulated import RESOLUTION, ROOM, insert, look

LAYERS = ("log_odds", "index", "surfels", "counts", "touched")
GUARD = 5000  # values before and after each array that nobody may write


def scan(hits: FloatArray, clear: FloatArray | None = None) -> Points:
    """Endpoints (n, 2) or with normals (n, 4), seen from the origin."""
    if hits.shape[1] == 2:
        hits = np.hstack((hits, np.zeros_like(hits)))
    ends = np.empty((0, 2)) if clear is None else clear
    return Points(hits.astype(np.float32), ends.astype(np.float32), np.zeros(2))


def guarded(maps: Maps) -> tuple[Maps, list[Any]]:
    """The same maps amid memory that must stay as it is, and that memory."""
    fields: dict[str, Any] = {}
    fences = []
    for name in LAYERS:
        array = getattr(maps, name)
        memory = np.full(array.size + 2 * GUARD, 0 if array.dtype == bool else 77, array.dtype)
        inside = memory[GUARD:-GUARD].reshape(array.shape)
        inside[...] = array
        fields[name] = inside
        fences += [(memory[:GUARD], memory[0].copy()), (memory[-GUARD:], memory[0].copy())]
    return replace(maps, **fields), fences


def same(maps: Maps, expected: reference.Map, p: int = 0) -> None:
    np.testing.assert_array_equal(in_rows(maps.log_odds[p]), expected.log_odds)
    np.testing.assert_array_equal(in_rows(maps.index[p]), expected.index)
    assert maps.counts[p] == len(expected.surfels)
    np.testing.assert_allclose(maps.surfels[p, 1 : maps.counts[p]], np.array(expected.surfels)[1:], atol=1e-5)


def untouched_is_blank(maps: Maps) -> None:
    assert not maps.log_odds[~maps.touched].any()
    assert not maps.index[~maps.touched].any()


def identical(a: Maps, p: int, b: Maps, q: int) -> None:
    np.testing.assert_array_equal(a.log_odds[p], b.log_odds[q])
    np.testing.assert_array_equal(a.index[p], b.index[q])
    np.testing.assert_array_equal(a.touched[p], b.touched[q])
    assert a.counts[p] == b.counts[q]
    np.testing.assert_array_equal(a.surfels[p, 1 : a.counts[p]], b.surfels[q, 1 : b.counts[q]])


def inserted_like_the_reference(width: float, poses: FloatArray, capacity: int = 30000, every: int = 3) -> Maps:
    maps, fences = guarded(Maps.empty(1, width, RESOLUTION, capacity))
    expected = reference.Map(maps.touched.shape[1] * grid.TILE, RESOLUTION, capacity)
    seen = look(ROOM, np.tile([0.0, 0.0, 0.3], (len(poses), 1)), sensing_range=4.5)
    for pose, points in zip(poses, seen, strict=True):
        some = Points(points.hits[::every].copy(), points.clear[::every].copy(), np.array([0.05, -0.1]))
        insert(maps, some, pose)
        expected.add(pose, some.hits, some.clear, some.sensor)
    same(maps, expected)
    assert all((fence == value).all() for fence, value in fences)
    return maps


POSES = np.array([(0.011, 0.023, 0.1), (0.2, 0.1, 0.12), (0.21, -0.13, 3.0)])


def test_insert_agrees_with_the_reference() -> None:
    maps = inserted_like_the_reference(16.0, POSES)
    assert maps.counts[0] > 100
    assert (maps.surfels[0, :, grid.N] > 1).any()
    untouched_is_blank(maps)


def test_insert_agrees_with_the_reference_scan_after_scan() -> None:
    """Long enough for cells to reach the floor of the log-odds and for surfels to die."""
    rng = np.random.default_rng(2)
    poses = POSES[0] + rng.normal(0.0, [0.3, 0.3, 0.2], (25, 3))
    maps = inserted_like_the_reference(16.0, poses, every=6)
    assert maps.log_odds.min() <= -grid.LIMIT
    assert (maps.surfels[0, 1 : maps.counts[0], grid.N] == 0).any()
    untouched_is_blank(maps)


BORDER = [(2.9, 0.1, 0.3), (-2.96, 2.9, 2.0), (3.3, -0.2, 3.1), (-3.4, -3.3, -2.2), (0.1, 40.0, 1.0), (1e5, -1e5, 0.2)]


@pytest.mark.parametrize("pose", BORDER)
def test_beyond_the_border_nothing_is_written(pose: tuple[float, float, float]) -> None:
    inserted_like_the_reference(6.0, np.array([pose, pose]))


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), *BORDER[:3]])
def test_tiles_that_were_written_to_count_as_touched(pose: tuple[float, float, float]) -> None:
    """A map smaller than the laser's reach, as the paper's 20 m: most beams leave it."""
    maps = Maps.empty(1, 6.0, RESOLUTION)
    rng = np.random.default_rng(4)
    for length in (8.0, 4.0, 1.0):
        angle = rng.uniform(0.2, 1.2, 30)
        insert(maps, scan(length * np.column_stack((np.cos(angle), np.sin(angle)))), np.array(pose))
    untouched_is_blank(maps)


def test_log_odds_stay_within_their_limits() -> None:
    maps = Maps.empty(1, 6.0, RESOLUTION)
    for _ in range(40):
        insert(maps, scan(np.array([[1.02, 0.02]])), np.zeros(3))
    assert maps.log_odds.max() == grid.LIMIT
    assert -grid.LIMIT - grid.MISS < maps.log_odds.min() <= -grid.LIMIT


def test_a_surfel_is_the_mean_of_its_endpoints() -> None:
    """Up to MAX_HITS of them: after that the older ones fade."""
    rng = np.random.default_rng(1)
    maps = Maps.empty(1, 6.0, RESOLUTION)
    ends = np.column_stack((rng.uniform([1.0, 0.5], [1.05, 0.55], (150, 2)), rng.normal(0.0, 0.5, (150, 2))))
    for i, end in enumerate(ends.astype(np.float32), start=1):
        insert(maps, scan(end[None]), np.zeros(3))
        assert maps.counts[0] == 2
        if i in (1, 7, grid.MAX_HITS):
            np.testing.assert_allclose(maps.surfels[0, 1, 1:], ends[:i].mean(axis=0), atol=1e-5)
    mean = ends[: grid.MAX_HITS].mean(axis=0)
    for end in ends[grid.MAX_HITS :]:
        mean += (end - mean) / grid.MAX_HITS
    np.testing.assert_allclose(maps.surfels[0, 1], (grid.MAX_HITS, *mean), atol=1e-5)


def test_the_index_names_the_nearest_surfel() -> None:
    """Of those whose cell is within REACH cells; one endpoint a cell, so that no surfel moves."""
    rng = np.random.default_rng(8)
    maps = Maps.empty(1, 6.0, RESOLUTION)
    cells = rng.permutation(np.array([(u, v) for u in range(25, 95) for v in range(25, 95)]))[:150]
    ends = (cells + rng.uniform(0.05, 0.95, (150, 2)) - 64) * RESOLUTION
    # A cell of its own for each: a neighbour's endpoint may be nearer to the middle of a cell than its own.
    apart = [i for i in range(150) if all(np.abs(cells[i] - cells[j]).max() > 1 for j in range(i))]
    insert(maps, scan(ends[apart]), np.zeros(3))
    ends, cells = ends[apart].astype(np.float32), cells[apart]
    index = in_rows(maps.index[0])
    for v in range(128):
        for u in range(128):
            centre = (np.array([u, v]) + 0.5 - 64) * RESOLUTION
            near = np.hypot(*(cells - (u, v)).T) <= grid.REACH
            distances = np.where(near, np.hypot(*(ends - centre).T), np.inf)
            if near.any():
                assert distances[index[v, u] - 1] == pytest.approx(distances.min(), abs=1e-6)
            else:
                assert index[v, u] == 0


def test_what_moved_away_dies_and_what_it_stood_before_lives() -> None:
    """A post 0.1 m before a wall goes away: the beams that now pass clear it, and none of the wall's surfels."""
    maps = Maps.empty(1, 6.0, RESOLUTION)
    y = np.arange(-0.5, 0.5, 0.05) + 0.02
    wall = np.column_stack((np.full(20, 2.02), y))
    again = wall + np.array([0.0, 0.001])
    post = np.array([[1.82, 0.021]])
    insert(maps, scan(np.vstack((wall, post))), np.zeros(3))
    for _ in range(12):
        insert(maps, scan(again), np.zeros(3))
    hits = maps.surfels[0, 1 : maps.counts[0], grid.N]
    assert hits[20] == 0
    np.testing.assert_array_equal(hits[:20], 13)


def test_a_full_table_takes_no_more_surfels() -> None:
    maps = inserted_like_the_reference(16.0, POSES, capacity=20)
    assert maps.counts[0] == 20
    untouched_is_blank(maps)


def stack(particles: int, seed: int) -> Maps:
    """Maps of all sorts, the last one empty."""
    rng = np.random.default_rng(seed)
    maps = Maps.empty(particles, 8.0, RESOLUTION)
    for p in range(particles - 1):
        one = replace(maps, **{layer: getattr(maps, layer)[p : p + 1] for layer in LAYERS})
        for _ in range(1 + p):
            insert(one, scan(rng.uniform(-2, 2, (30, 2))), rng.uniform(-1, 1, 3))
    return maps


def test_copies_are_copies_whatever_was_there() -> None:
    source, target = stack(5, 1), stack(7, 2)
    parents = np.array([4, 0, 0, 3, 1, 2, 3])
    before = stack(5, 1)
    target.copy_from(source, parents)
    for p, parent in enumerate(parents):
        identical(target, p, source, parent)
    for p in range(5):
        identical(source, p, before, p)


def test_copies_within_a_stack() -> None:
    """Resampling: parents keep their place."""
    maps, before = stack(6, 3), stack(6, 3)
    parents = np.array([0, 3, 0, 3, 5, 5])
    maps.copy_from(maps, parents)
    for p, parent in enumerate(parents):
        identical(maps, p, before, parent)


def test_cleared_maps_are_like_new() -> None:
    maps = stack(4, 5)
    maps.clear()
    for array in (maps.log_odds, maps.index):
        assert not array.any()
    fresh = Maps.empty(1, 8.0, RESOLUTION)
    points = scan(np.random.default_rng(1).uniform(-2, 2, (30, 2)))
    for p in range(4):
        identical(maps, p, Maps.empty(1, 8.0, RESOLUTION), 0)
    insert(maps, points, np.zeros(3))
    insert(fresh, points, np.zeros(3))
    identical(maps, 0, fresh, 0)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (3.9, 3.9, 0.7)])
def test_a_map_whose_beams_left_it_is_cleared_all_over(pose: tuple[float, float, float]) -> None:
    maps = Maps.empty(1, 8.0, RESOLUTION)
    insert(maps, scan(np.array([[9.0, 1.0], [-1.0, 9.0], [-9.0, -2.0]])), np.array(pose))
    assert maps.log_odds.any()
    maps.clear()
    assert not maps.log_odds.any()


def test_what_is_known_of_a_map_is_cut_out_at_its_place() -> None:
    maps = Maps.empty(2, 8.0, RESOLUTION)
    insert(maps, scan(np.array([[1.02, 0.02], [0.02, -3.01]])), np.zeros(3))
    part, corner = maps.known(0)
    whole = in_rows(maps.log_odds[0])
    u, v = np.round(corner / RESOLUTION + 0.5 * len(whole)).astype(int)
    np.testing.assert_array_equal(whole[v : v + part.shape[0], u : u + part.shape[1]], part)
    assert np.count_nonzero(whole) == np.count_nonzero(part)
    assert part.shape == (62, 21)  # from the hit at y = -3.01 m to the cell above the sensor's axis, 1.02 m across
    assert maps.known(1)[0].size == 0


def test_maps_that_nothing_was_drawn_in_take_no_memory() -> None:
    """Nor do tiles that no beam touched: pages, not huge ones, are what the system hands out."""
    resource = pytest.importorskip("resource")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    maps = Maps.empty(100, 70.0, RESOLUTION)  # 590 MB of addresses
    for p in range(100):
        one = replace(maps, **{layer: getattr(maps, layer)[p : p + 1] for layer in LAYERS})
        insert(one, scan(np.array([[1.0, 1.0]])), np.zeros(3))
    assert maps.log_odds.nbytes + maps.index.nbytes > 5e8
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50e3  # kB
