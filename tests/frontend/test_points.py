"""Scans become endpoints with normals: against the reference, on walls known by hand, and on broken scans."""

import math
from dataclasses import replace

import numpy as np
import pytest

from frontend import se2
from frontend.points import MIN_RANGE, Points, merge, points_of
from frontend.records import FloatArray, Laser, LaserScan
from tests.frontend import reference
from tests.frontend.simulated import ROOM, scan_of
from tools.simulation import LMS200, FloorPlan, LaserModel, cluttered
from tools.simulation.laser import measure

MOUNT = (0.1, -0.05, 0.3)


def scanner(beams: int) -> LaserModel:
    return replace(LaserModel.spanning(math.radians(270 if beams > 400 else 180), beams, 80.0), mount=MOUNT)


def agree(scan: LaserScan, sensing_range: float, max_beams: int) -> Points:
    points = points_of(scan, sensing_range, max_beams)
    stride = math.ceil(len(scan.ranges) / max_beams)
    laser = scan.laser
    ranges = scan.ranges.astype(np.float64)
    hits, clear = reference.endpoints(ranges, laser.angles, laser.mount, sensing_range, stride)
    np.testing.assert_allclose(points.hits, hits, atol=1e-4)
    np.testing.assert_allclose(points.clear, clear, atol=1e-5)
    np.testing.assert_array_equal(points.sensor, laser.mount[:2])
    return points


@pytest.mark.parametrize("beams", [180, 361, 1080])
def test_points_agree_with_the_reference(beams: int) -> None:
    laser = scanner(beams)
    places = [((-3.0, 0.2, 0.4), ROOM), ((1.0, 1.0, 2.0), ROOM), ((3.5, 3.5, -1.0), cluttered(2))]
    for pose, plan in places:
        (ranges,) = measure(laser, plan.segments, np.array([pose]), np.random.default_rng(1))
        points = agree(scan_of(ranges, laser), 4.0, 181)
        assert min(len(points.hits), len(points.clear)) > 10
        facing = points.hits[:, 2:] * (points.hits[:, :2] - points.sensor)
        assert (facing.sum(axis=1) <= 1e-6).all()
        lengths = np.hypot(points.hits[:, 2], points.hits[:, 3])
        assert (np.abs(lengths[lengths > 0] - 1.0) < 1e-6).all()


def test_points_agree_with_the_reference_on_noise() -> None:
    rng = np.random.default_rng(7)
    for _ in range(10):
        ranges = rng.uniform(0.0, 6.0) + rng.exponential(rng.choice([0.02, 0.2, 2.0]), 180)
        ranges[rng.random(180) < 0.1] = np.nan
        ranges[rng.random(180) < 0.1] = np.inf
        ranges[rng.random(180) < 0.05] = MIN_RANGE / 2
        agree(scan_of(ranges, scanner(180)), 5.0, 181)


def test_a_wall_a_post_and_a_gap() -> None:
    """A wall ahead, split by a door through which another wall is seen; then a single point."""
    walls: list[tuple[float, ...]] = [(2, -3, 2, -0.5), (2, 0.5, 2, 3), (4, -3, 4, 3)]
    plan = FloorPlan("door", walls)
    (ranges,) = measure(LMS200.exact(), plan.segments, np.zeros((1, 3)), np.random.default_rng(0))
    hits = points_of(scan_of(ranges), 25.0, 181).hits
    normals = hits[np.hypot(hits[:, 2], hits[:, 3]) > 0, 2:]
    np.testing.assert_allclose(normals, np.tile([-1.0, 0.0], (len(normals), 1)), atol=1e-3)
    assert len(normals) > 60
    ranges[:] = np.nan
    ranges[90] = 1.0
    lonely = points_of(scan_of(ranges), 25.0, 181).hits
    np.testing.assert_allclose(lonely, [[math.cos(LMS200.first + 90 * LMS200.step), 0.0, 0.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize("beams", [180, 361, 1080])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 0.0, 0.9 * MIN_RANGE])
def test_scans_without_a_valid_beam_give_no_points(value: float, beams: int) -> None:
    points = points_of(scan_of(np.full(beams, value), scanner(beams)), 25.0, 181)
    assert points.hits.shape == (0, 4)
    assert points.clear.shape == (0, 2)


def test_a_scanner_of_one_beam() -> None:
    scan = LaserScan(0.0, np.array([2.0], np.float32), np.zeros(3), Laser(np.zeros(1), np.zeros(3), 80.0))
    np.testing.assert_array_equal(points_of(scan, 25.0, 181).hits, [[2.0, 0.0, 0.0, 0.0]])


def test_of_many_beams_a_subset_is_used_but_all_are_fitted() -> None:
    laser = scanner(1080)
    (ranges,) = measure(laser, ROOM.segments, np.array([[-1.0, 0.0, 0.5]]), np.random.default_rng(1))
    ranges[~np.isfinite(ranges)] = 3.0
    every, sixth = points_of(scan_of(ranges, laser), 25.0, 1080).hits, points_of(scan_of(ranges, laser), 25.0, 181).hits
    assert len(every) == 1080
    np.testing.assert_array_equal(sixth, every[::6])


def test_merge_moves_points_and_normals() -> None:
    rng = np.random.default_rng(3)
    scans, poses = [], rng.uniform(-3, 3, (4, 3))
    for n in (5, 0, 1, 8):
        angle = rng.uniform(-np.pi, np.pi, n)
        hits = np.column_stack((rng.uniform(-9, 9, (n, 2)), np.cos(angle), np.sin(angle))).astype(np.float32)
        scans.append(Points(hits, np.zeros((2, 2), np.float32), np.array([float(n), 0.0])))
    merged = merge(scans, poses)
    expected: list[FloatArray] = []
    for scan, pose in zip(scans, poses, strict=True):
        for x, y, nx, ny in scan.hits.astype(np.float64):
            position = se2.compose(pose, np.array([x, y, 0.0]))[:2]
            tip = se2.compose(pose, np.array([x + nx, y + ny, 0.0]))[:2]
            expected.append(np.append(position, tip - position))
    np.testing.assert_allclose(merged.hits, expected, atol=1e-5)
    assert len(merged.clear) == 0
    assert merged.sensor[0] == 8
