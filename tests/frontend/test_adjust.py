"""Adjustment of poses and map: its solver, and its covariances against Monte Carlo truth."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from frontend import adjust, adjust_equations, motion, refine, se2, skyline
from frontend.adjust import Adjusted
from frontend.points import Points, points_of
from frontend.records import FloatArray
from tests.frontend import simulated
from tests.frontend.simulated import CORRIDOR, ROOM, drawn, scan_of
from tools.simulation import LMS200, FloorPlan
from tools.simulation.laser import measure

kernels: Any = adjust


def banded(rng: np.random.Generator, n: int) -> FloatArray:
    """A positive definite matrix, mostly of zeros far from the diagonal."""
    root = np.tril(rng.normal(size=(n, n)))
    root[np.subtract.outer(np.arange(n), np.arange(n)) > rng.integers(1, n, n)[:, None]] = 0.0
    return root @ root.T + 0.1 * np.eye(n)


@pytest.mark.parametrize("poses", [1, 2, 7, 30])
def test_the_solver_solves_and_inverts(poses: int) -> None:
    rng = np.random.default_rng(poses)
    full = banded(rng, 3 * poses)
    right, headings = rng.normal(size=3 * poses), rng.uniform(-3, 3, poses)
    factor, solution = np.tril(full), right.copy()
    first = skyline.factorise(factor)
    skyline.solve(factor, first, solution)
    np.testing.assert_allclose(full @ solution, right, atol=1e-8)
    inverse = np.linalg.inv(full)
    for i, block in enumerate(skyline.marginals(factor, first, headings)):
        c, s = np.cos(headings[i]), np.sin(headings[i])
        rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        expected = rotation @ inverse[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] @ rotation.T
        np.testing.assert_allclose(block, expected, rtol=1e-6, atol=1e-9)


def test_eliminating_surfels_is_least_squares_with_them() -> None:
    """Poses and offsets of the surfels together, solved densely, against the reduced system."""
    rng = np.random.default_rng(1)
    n, poses, surfels = 200, 5, 12
    scan, surfel = np.sort(rng.integers(0, poses, n)), rng.integers(1, surfels, n)
    jacobian, error, weight = rng.normal(size=(n, 3)), rng.normal(size=n), rng.uniform(0.1, 1.0, n)
    known = np.where(np.arange(surfels) < 5, 3.0, 0.0)
    design = np.zeros((n, 3 * poses + surfels))
    for q in range(n):
        design[q, 3 * scan[q] : 3 * scan[q] + 3] = jacobian[q]
        design[q, 3 * poses + surfel[q]] = -1.0
    normal = (design.T * weight) @ design + np.diag(np.concatenate([np.full(3 * poses, 1e-3), known]))
    normal[3 * poses, 3 * poses] = 1.0  # row 0 of the table stands for no surfel
    expected = np.linalg.solve(normal, -(design.T * weight) @ error)
    information, right = np.zeros((3 * poses, 3 * poses)), np.zeros(3 * poses)
    squares, _, free = adjust_equations.reduce(scan, surfel, jacobian, error, weight, known, information, right)
    assert free == surfels - 5
    full = np.tril(information) + np.tril(information, -1).T + 1e-3 * np.eye(3 * poses)
    np.testing.assert_allclose(np.linalg.solve(full, right), expected[: 3 * poses], rtol=1e-6)
    offsets = np.linalg.lstsq(np.vstack([np.diag(weight**0.5) @ design[:, 3 * poses + 1 :], np.diag(known[1:] ** 0.5)]),
                              -np.concatenate([weight**0.5 * error, np.zeros(surfels - 1)]), rcond=None)  # fmt: skip
    assert squares == pytest.approx(offsets[1][0])


def visit(plan: FloorPlan, true: FloatArray, seed: int) -> tuple[list[Points], FloatArray, FloatArray, FloatArray]:
    """Scans from the true poses, the poses roughly, odometry increments and their variances."""
    rng = np.random.default_rng(seed)
    points = [points_of(scan_of(r), 25.0, 181) for r in measure(LMS200, plan.segments, true, rng)]
    steps = se2.between(true[:-1], true[1:])
    variances = np.array([motion.variance(i, PARAMETERS.motion) for i in np.vstack([np.zeros((1, 3)), steps])])
    increments = np.vstack([np.zeros((1, 3)), se2.compose(steps, rng.normal(0.0, np.sqrt(variances[1:])))])
    poses = se2.compose(true, rng.normal(0.0, [0.01, 0.01, 0.004], true.shape))
    poses[0] = true[0]
    return points, poses, increments, variances


def straight(length: float, step: float = 0.1) -> FloatArray:
    x = np.arange(0.0, length + 1e-9, step)
    return np.column_stack([x, np.zeros((len(x), 2))])


PARAMETERS = replace(simulated.PARAMETERS, map_width=60.0)


def adjusted(plan: FloorPlan, true: FloatArray, seed: int) -> Adjusted:
    points, poses, increments, variances = visit(plan, true, seed)
    return refine.refine(points, poses, increments, variances, None, PARAMETERS)[0]


def test_covariances_are_those_of_the_errors() -> None:
    """Many drives through a room: NEES / 3 of the last pose is near 1, and no component is far off."""
    turn = np.linspace(0.0, 2.2, 15)
    arc = np.column_stack([0.4 * np.cumsum(np.cos(turn)) / 3, 0.4 * np.cumsum(np.sin(turn)) / 3, turn])
    true = np.vstack([straight(3.0), se2.compose(np.array([3.0, 0.0, 0.0]), arc)])
    found = [adjusted(ROOM, true, seed) for seed in range(24)]
    errors = np.array([se2.log(se2.between(true[-1], a.poses[-1])) for a in found])
    covariances = np.array([a.covariances[-1] for a in found])
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors) / 3.0
    # The drive is always the same, and so is what cells and corners do to it: some of the error is not noise.
    assert 0.4 < nees.mean() < 3.5
    ratio = np.sqrt((errors**2).mean(axis=0) / covariances.mean(axis=0).diagonal())
    assert (ratio > 0.35).all()
    assert (ratio < 2.5).all()
    assert np.abs(errors[:, :2]).max() < 0.03


def test_a_corridor_says_that_it_does_not_know_the_place_along_it() -> None:
    """Along bare walls the covariance is that of odometry, across them that of the laser."""
    true = straight(10.0)
    for seed in range(3):
        a = adjusted(CORRIDOR, true, seed)
        along, across, heading = np.sqrt(a.covariances[-1].diagonal())
        odometry = np.sqrt((len(true) - 1) * motion.variance(np.array([0.1, 0.0, 0.0]), PARAMETERS.motion)[0])
        assert 0.5 * odometry < along < 1.2 * odometry
        assert across < 0.2 * along
        assert heading < 0.005
        error = a.poses[-1] - true[-1]
        assert abs(error[0]) < 3.5 * along
        assert abs(error[1]) < 4.0 * across


def test_a_map_that_is_not_known_costs_certainty() -> None:
    """The same scans in a map that is known for sure are known better, in every direction."""
    true = straight(3.0)
    points, poses, increments, variances = visit(ROOM, true, 0)
    own = refine.refine(points, poses, increments, variances, None, PARAMETERS)[0]
    sure = refine.localise(points, poses, increments, variances, drawn(points, true, 60.0), PARAMETERS)
    assert np.linalg.eigvalsh(own.covariances[-1] - sure.covariances[-1]).min() > -1e-9
    assert np.linalg.eigvalsh(sure.covariances[0]).min() > 0.0  # a robot that enters is not certain where,
    assert own.covariances[0].max() < 1e-7  # but where it begins a map is the frame
    np.testing.assert_array_equal(own.poses[0], true[0])


def test_errors_that_go_together_bend_the_map() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [8.0, 0.0, np.pi / 2]])
    assert not kernels._bending(poses, 0.0).any()
    first, near, far = kernels._bending(poses, 1e-4)
    assert not first.any()
    assert np.linalg.eigvalsh(near).min() > 0.0
    assert far[2, 2] == pytest.approx(2.0 * near[2, 2])
    assert far[0, 0] > far[1, 1]  # seen by a robot that has turned left, to the side of the way is ahead
    assert far[0, 0] > 2.0 * near[1, 1]


def test_scattered_scans_are_believed_less() -> None:
    """Ranges that share an error for a few scans at a time: less is known, and sigma says why."""
    true = straight(3.0)
    points, poses, increments, variances = visit(ROOM, true, 0)
    rng = np.random.default_rng(0)
    shaken = []
    for i, p in enumerate(points):
        if i % 6 == 0:
            push = rng.normal(0.0, 0.02, 12)
        hits = p.hits.copy()
        ranges = np.hypot(hits[:, 0], hits[:, 1])
        sector = (np.arctan2(hits[:, 1], hits[:, 0]) / np.pi * 6 + 6).astype(int) % 12
        hits[:, :2] *= (1.0 + push[sector] / ranges)[:, None].astype(np.float32)
        shaken.append(Points(hits, p.clear, p.sensor))
    plain = refine.refine(points, poses, increments, variances, None, PARAMETERS)[0]
    rough = refine.refine(shaken, poses, increments, variances, None, PARAMETERS)[0]
    assert rough.sigma > 1.5 * plain.sigma
    assert np.linalg.det(rough.covariances[-1]) > 8.0 * np.linalg.det(plain.covariances[-1])
