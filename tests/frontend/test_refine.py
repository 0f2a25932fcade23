"""Refinement of a finished visit: the smoother against dense least squares, and poses that get better."""

import math
from typing import Any

import numpy as np
import pytest

from frontend import motion, refine, se2
from frontend.grid import Maps
from frontend.points import Points
from frontend.records import FloatArray
from tests.frontend import reference
from tests.frontend.simulated import PARAMETERS, drawn, drive, room


def random_chain(rng: np.random.Generator, n: int) -> tuple[FloatArray, ...]:
    """Poses, matches, Hessians, odometry and its variances; everything disagrees with everything a little."""
    steps = rng.normal([0.3, 0.0, 0.0], [0.1, 0.1, 0.4], (n, 3))
    poses = np.empty((n, 3))
    poses[0] = rng.uniform(-3, 3, 3)
    for i in range(1, n):
        poses[i] = se2.compose(poses[i - 1], steps[i])
        poses[i, 2] = poses[i - 1, 2] + steps[i, 2]  # not wrapped: the match of a pose is on the same side
    roots = rng.normal(0.0, 30.0, (n, 3, 3))
    hessians = roots @ roots.swapaxes(1, 2) + 1e-3 * np.eye(3)
    motions = se2.compose(steps, rng.normal(0.0, [0.05, 0.05, 0.03], (n, 3)))
    return poses, poses + rng.normal(0.0, 0.03, (n, 3)), hessians, motions, rng.uniform(1e-4, 1e-3, (n, 3))


def smoothed(chain: tuple[FloatArray, ...]) -> FloatArray:
    out = np.full_like(chain[0], np.nan)
    kernel: Any = refine._smooth
    kernel(*chain, out)
    return out


@pytest.mark.parametrize("n", [1, 2, 3, 25])
def test_smoothing_is_least_squares(n: int) -> None:
    for seed in range(3):
        chain = random_chain(np.random.default_rng(seed), n)
        np.testing.assert_allclose(smoothed(chain), reference.smooth(*chain), atol=1e-7)


def test_smoothing_does_not_trip_over_half_a_turn() -> None:
    poses, matched, hessians, motions, variances = random_chain(np.random.default_rng(5), 8)
    poses[3:, 2] += 2 * np.pi
    matched[3:, 2] += 2 * np.pi
    motions[:, 2] -= 2 * np.pi
    chain = poses, matched, hessians, motions, variances
    np.testing.assert_allclose(smoothed(chain), reference.smooth(*chain), atol=1e-7)
    assert np.abs(smoothed(chain) - poses).max() < 0.2


def test_a_scan_without_information_follows_odometry() -> None:
    poses, matched, hessians, motions, _ = random_chain(np.random.default_rng(6), 5)
    hessians[1:] = 1e-3 * np.eye(3)
    result = poses
    for _ in range(8):
        result = smoothed((result, matched, hessians, motions, np.full((5, 3), 1e-4)))
    np.testing.assert_allclose(result[0], matched[0], atol=1e-4)
    np.testing.assert_allclose(se2.between(result[:-1], result[1:]), motions[1:], atol=1e-4)


def visit(scans: slice) -> tuple[list[Points], FloatArray, FloatArray, FloatArray]:
    """Of a drive through the room: points, true poses seen from the first, odometry and its variances."""
    log, points, increments = drive()
    true = se2.between(log.poses[scans][0], log.poses[scans])
    increments = increments[scans]
    return points[scans], true, increments, np.array([motion.variance(i, PARAMETERS.motion) for i in increments])


def errors(poses: FloatArray, true: FloatArray) -> tuple[float, float]:
    """Root mean square of the distance, metres, and of the angle, radians."""
    off = se2.between(true, poses)
    return math.sqrt((off[:, :2] ** 2).sum(axis=1).mean()), math.sqrt((off[:, 2] ** 2).mean())


def disturbed(true: FloatArray) -> FloatArray:
    return se2.compose(true, np.random.default_rng(1).normal(0.0, [0.03, 0.03, 0.015], true.shape))


def test_the_poses_of_a_visit_get_better() -> None:
    points, true, increments, variances = visit(slice(0, 90))
    rough = np.vstack((true[:1], disturbed(true)[1:]))
    rough_before, hits_before = rough.copy(), [p.hits.copy() for p in points]
    found, maps = refine.refine(points, rough, increments, variances, None, PARAMETERS)
    poses = found.poses
    np.testing.assert_allclose(poses[0], true[0], atol=1e-12)
    before, after = errors(rough, true), errors(poses, true)
    assert after[0] < before[0] / 2
    assert after[1] < before[1] / 1.5
    assert (np.abs(poses[:, 2]) <= np.pi).all()
    # The map is made of the poses that are returned, and nobody's arguments changed.
    assert len(maps.counts) == 1
    fits = [reference.evaluate(maps, p.hits, x, 0.02).fit / len(p.hits) for p, x in zip(points, poses, strict=True)]
    assert np.mean(fits) > 0.8
    np.testing.assert_array_equal(rough, rough_before)
    for scan, hits in zip(points, hits_before, strict=True):
        np.testing.assert_array_equal(scan.hits, hits)


def test_a_known_map_holds_the_poses() -> None:
    """With what earlier visits knew, the first pose need not stay, and what they knew does."""
    base = room()[2]
    layers = ("log_odds", "index", "surfels", "counts", "touched")
    frozen = [getattr(base, layer).copy() for layer in layers]
    log, points, increments = drive()
    true = log.poses[:40]
    variances = np.array([motion.variance(i, PARAMETERS.motion) for i in increments[:40]])
    rough = disturbed(true)
    rough[0] = se2.compose(true[0], np.array([0.04, -0.03, 0.01]))
    found, maps = refine.refine(points[:40], rough, increments[:40], variances, base, PARAMETERS)
    poses = found.poses
    assert errors(poses, true)[0] < 0.02 < errors(rough, true)[0] / 1.5
    assert np.hypot(*(poses[0] - true[0])[:2]) < 0.02
    assert maps.counts[0] >= base.counts[0] > 100
    for layer, before in zip(layers, frozen, strict=True):
        np.testing.assert_array_equal(getattr(base, layer), before)


def test_scans_that_saw_nothing_are_carried_by_odometry() -> None:
    points, true, _, _ = visit(slice(0, 60))
    increments = np.vstack((np.zeros(3), se2.between(true[:-1], true[1:])))
    variances = np.array([motion.variance(i, PARAMETERS.motion) for i in increments])
    nothing = Points(points[0].hits[:0], points[0].clear[:0], points[0].sensor)
    blind = [nothing if 20 <= i < 26 or i == 59 else p for i, p in enumerate(points)]
    found, _ = refine.refine(blind, true, increments, variances, None, PARAMETERS)
    assert errors(found.poses, true)[0] < 0.012


@pytest.mark.parametrize("hits", [0, 1, 180])
def test_a_visit_of_one_scan(hits: int) -> None:
    (points,) = drive()[1][:1]
    few = Points(points.hits[:hits], points.clear, points.sensor)
    at = np.array([[0.2, 0.1, 3.0]])
    found, maps = refine.refine([few], at, np.zeros((1, 3)), np.full((1, 3), 1e-5), None, PARAMETERS)
    np.testing.assert_allclose(found.poses, at, atol=1e-12)
    assert found.covariances.shape == (1, 3, 3)
    assert isinstance(maps, Maps)
    np.testing.assert_array_equal(maps.log_odds, drawn([few], at).log_odds)


def tracked_back(
    points: list[Points], path: FloatArray, increments: FloatArray, known: Maps | None = None
) -> FloatArray:
    """The path (n, 3) in the known room, tracked back."""
    variances = np.array([motion.variance(i, PARAMETERS.motion) for i in increments])
    packed = refine._Packed(points)
    return refine._tracked_back(known or room()[2], packed, path, increments, variances, PARAMETERS)


def known_visit() -> tuple[list[Points], FloatArray, FloatArray]:
    """40 scans in the room, their true poses, and odometry without error."""
    log, points, _ = drive()
    true = log.poses[:40]
    return points[:40], true, np.vstack([np.zeros(3), se2.between(true[:-1], true[1:])])


def test_a_jump_in_a_known_map_is_taken_out() -> None:
    points, true, increments = known_visit()
    path = true.copy()
    path[:10] = se2.compose(np.array([0.2, -0.24, 0.0]), path[:10])
    assert np.abs(tracked_back(points, path, increments) - true)[:, :2].max() < 0.03


def test_a_slip_along_the_only_wall_in_sight_is_taken_out() -> None:
    """Slow enough to be no jump; the map explains every pose on the way."""
    points, true, increments = known_visit()
    for i in range(25):
        y = true[i, 1] + points[i].hits[:, :2] @ [math.sin(true[i, 2]), math.cos(true[i, 2])]
        wall = np.abs(y - y.max()) < 0.1
        points[i] = Points(points[i].hits[wall], points[i].clear, points[i].sensor)
    path = true.copy()
    path[:30, 0] += 0.3 * np.minimum(1.0, (30 - np.arange(30)) / 8.0)
    assert np.abs(tracked_back(points, path, increments) - true)[:, :2].max() < 0.04


def test_where_odometry_lies_the_path_stays() -> None:
    """A wheel that spun: what it says is in no direction where the map has nothing to say."""
    points, true, increments = known_visit()
    increments[10] += [0.31, 0.0, 0.0]
    assert np.abs(tracked_back(points, true, increments) - true)[:, :2].max() < 0.03
