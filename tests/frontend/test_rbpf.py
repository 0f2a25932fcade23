"""The particle filter: its random numbers, proposals and weights, resampling, and who descends from whom."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from frontend import motion, rbpf, se2
from frontend.grid import Maps
from frontend.matching import match
from frontend.parameters import FilterParameters, MotionParameters
from frontend.rbpf import ParticleFilter
from frontend.records import FloatArray
from tests.frontend.reference import Floats
from tests.frontend.simulated import PARAMETERS, ROOM, look, room

SMALL = FilterParameters(particles=12, map_width=13.0)


# --- random numbers -------------------------------------------------------------------------------------------------


def uniforms(count: int, vary: int) -> FloatArray:
    """Numbers of which one argument, the ``vary``-th, counts up."""
    arguments = np.tile([17, 3, 5, 1], (count, 1))
    arguments[:, vary] = np.arange(count)
    return np.array([rbpf._uniform(*a) for a in arguments.tolist()])


@pytest.mark.parametrize("vary", [0, 1, 2, 3])
def test_uniform_numbers_are_uniform_and_independent(vary: int) -> None:
    u = uniforms(5000, vary)
    assert ((u > 0) & (u <= 1)).all()
    assert kstest(u, "uniform").pvalue > 1e-3
    for lag in (1, 2, 12, 40):
        assert abs(np.corrcoef(u[:-lag], u[lag:])[0, 1]) < 4 / math.sqrt(5000)


def test_uniform_numbers_differ_whatever_is_varied() -> None:
    drawn = {rbpf._uniform(*a) for a in np.ndindex(6, 6, 6, 6)}
    assert len(drawn) == 6**4


COVARIANCE = np.array([[4e-2, 1e-2, -1e-3], [1e-2, 1e-2, 2e-3], [-1e-3, 2e-3, 1e-3]])


def is_drawn_from(samples: Floats, mean: FloatArray, covariance: Floats) -> None:
    """Mean, covariance and shape of the samples (n, 3) fit the Gaussian."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), (samples - mean).T).T
    n = len(white)
    assert n * float(white.mean(axis=0) @ white.mean(axis=0)) < chi2.ppf(0.9999, 3)
    np.testing.assert_allclose(np.cov(white.T), np.eye(3), atol=5 * math.sqrt(2 / n))
    for axis in white.T:
        assert kstest(axis, "norm").pvalue > 1e-3
    assert kstest((white**2).sum(axis=1), chi2(3).cdf).pvalue > 1e-3


@pytest.mark.parametrize("vary", [0, 1, 2])
def test_draws_have_mean_and_covariance(vary: int) -> None:
    mean = np.array([1.0, -2.0, 3.0])
    samples = np.tile(mean, (6000, 1))
    for i, sample in enumerate(samples):
        key = [7, 8, 9]
        key[vary] = i
        rbpf._draw(sample, COVARIANCE, *key)
    is_drawn_from(samples, mean, COVARIANCE)


def test_a_draw_of_no_width_stays() -> None:
    sample = np.array([1.0, 2.0, 3.0])
    rbpf._draw(sample, np.zeros((3, 3)), 1, 2, 3)
    np.testing.assert_allclose(sample, [1.0, 2.0, 3.0], atol=1e-7)


# --- proposal -------------------------------------------------------------------------------------------------------


def test_the_proposal_is_the_gaussian_around_the_match() -> None:
    """Every particle is drawn from match and prior together, and weighed by their evidence (Laplace)."""
    count, steps = 40, 40
    at = np.array([-0.7, 0.4, 2.1])
    (points,) = look(ROOM, at[None])
    maps = Maps.empty(count, 16.0, 0.05)
    maps.copy_from(room()[2], np.zeros(count, np.int64))
    prior, variances = at + np.array([0.02, -0.01, 0.01]), np.array([1e-4, 4e-4, 1e-4])
    rotation = np.array([[math.cos(prior[2]), -math.sin(prior[2])], [math.sin(prior[2]), math.cos(prior[2])]])
    information = np.zeros((3, 3))
    information[:2, :2] = rotation @ np.diag(1 / variances[:2]) @ rotation.T
    information[2, 2] = 1 / variances[2]

    mean, hessian = prior.copy(), np.empty((3, 3))
    *_, log_likelihood = match(*maps.layers(0), points.hits, mean, prior, information, PARAMETERS.sigma, hessian)
    covariance = np.linalg.inv(hessian + information)
    off = mean - prior
    log_weight = (
        PARAMETERS.independence * log_likelihood
        - 4.5 * math.log1p(off @ information @ off / 9)
        + 0.5 * math.log(np.linalg.det(covariance) * np.linalg.det(information))
    )

    samples = []
    for step in range(steps):
        poses, log_weights = np.tile(prior, (count, 1)), np.arange(count, dtype=np.float64)
        covariances = np.empty((count, 3, 3))
        rbpf._propose(
            maps.log_odds, maps.index, maps.surfels, maps.resolution, points.hits, np.tile(prior, (count, 1)),
            variances, PARAMETERS.independence, PARAMETERS.sigma, 5, step, poses, log_weights, covariances,
        )  # fmt: skip
        samples.append(poses)
        np.testing.assert_allclose(log_weights, np.arange(count) + log_weight, rtol=1e-6)
        np.testing.assert_allclose(covariances, np.tile(covariance, (count, 1, 1)), rtol=1e-6)
    is_drawn_from(np.concatenate(samples), mean, covariance)


def begun(parameters: FilterParameters, poses: FloatArray, seed: int = 3) -> ParticleFilter:
    """A filter whose particles have each mapped the room from where they believe to be."""
    particles = ParticleFilter(parameters, seed)
    particles.start(poses)
    (points,) = look(ROOM, np.zeros((1, 3)))
    particles.insert(points, particles.poses)
    return particles


@pytest.mark.parametrize("heading", [0.0, 1.0, np.pi - 0.05])
def test_weights_do_not_depend_on_the_heading(heading: float) -> None:
    """Also where some particles are on one side of half a turn and some on the other."""
    increment = np.array([0.1, 0.0, 0.05])
    start = np.zeros((12, 3))
    start[:, 2] = heading
    particles = begun(SMALL, start)
    particles.poses[:, 2] = se2.wrap(particles.poses[:, 2] + np.linspace(-0.01, 0.01, 12))
    (points,) = look(ROOM, increment[None])
    particles.track(points, increment)
    particles.update(points, mapping=False)
    assert particles.resampled == 0
    assert np.ptp(np.log(particles.weights)) < 1.0


# --- resampling -----------------------------------------------------------------------------------------------------


def weigh(particles: ParticleFilter, log_weights: FloatArray) -> None:
    particles._log_weights[:] = log_weights


def test_resampling_is_systematic() -> None:
    """Floor or ceiling of n times the weight; survivors keep their place; maps, poses and weights follow."""
    rng = np.random.default_rng(4)
    numbers = []
    for seed in range(20):
        particles = begun(SMALL, rng.normal(0.0, 0.1, (12, 3)), seed)
        weigh(particles, np.log(rng.dirichlet(np.full(12, 0.1)) + 1e-9))
        weights, before = particles.weights, particles.poses.copy()
        maps = Maps.empty(12, SMALL.map_width, SMALL.resolution)
        maps.copy_from(particles.maps, np.arange(12))
        assert 1 / (weights @ weights) < 6
        parents = particles._resample()
        counts = np.bincount(parents, minlength=12)
        assert (counts >= np.floor(12 * weights)).all()
        assert (counts <= np.ceil(12 * weights)).all()
        survivors = np.flatnonzero(counts)
        np.testing.assert_array_equal(parents[survivors], survivors)
        np.testing.assert_array_equal(particles.poses, before[parents])
        np.testing.assert_array_equal(particles.maps.log_odds, maps.log_odds[parents])
        np.testing.assert_array_equal(particles.maps.index, maps.index[parents])
        np.testing.assert_array_equal(particles.maps.counts, maps.counts[parents])
        np.testing.assert_allclose(particles.weights, 1 / 12)
        assert particles.resampled == 1
        numbers.append(counts - 12 * weights)
    assert np.abs(np.mean(numbers, axis=0)).max() < 0.4  # unbiased


@pytest.mark.parametrize("effective", [5.5, 6.5])
def test_resampling_waits_until_half_the_particles_are_ineffective(effective: float) -> None:
    particles = begun(SMALL, np.zeros((12, 3)))
    for share in np.linspace(1 / 12, 0.99, 2000):  # one particle's share that leaves so many effective
        weights = np.append(share, np.full(11, (1 - share) / 11))
        if 1 / (weights @ weights) < effective:
            break
    weigh(particles, np.log(weights))
    parents = particles._resample()
    assert (particles.resampled == 1) == (effective < 6)
    assert (len(set(parents)) < 12) == (effective < 6)
    if effective > 6:
        np.testing.assert_allclose(particles.weights, weights)


def test_paths_follow_the_ancestors() -> None:
    """After every step each path is one that there was before, and the particle's map belongs to it."""
    rng = np.random.default_rng(9)
    noisy = FilterParameters(particles=12, map_width=13.0, motion=MotionParameters(xy_floor=0.1, theta_floor=0.1))
    particles = begun(noisy, rng.normal(0.0, 0.05, (12, 3)))
    pose, before = np.zeros(3), particles.paths()
    np.testing.assert_array_equal(before, particles.poses[None])
    marks = particles.maps.log_odds.copy()
    died = 0
    for _ in range(8):
        increment = np.array([0.1, 0.0, 0.1])
        pose = se2.compose(pose, increment)
        (points,) = look(ROOM, pose[None])
        particles.track(points, increment)
        weigh(particles, particles._log_weights + rng.normal(0.0, 1.5, 12))
        particles.update(points, mapping=False)
        paths = particles.paths()
        assert paths.shape == (len(before) + 1, 12, 3)
        np.testing.assert_array_equal(paths[-1], particles.poses)
        parents = [
            int(np.flatnonzero((before == path[:-1, None]).all(axis=(0, 2)))[0]) for path in paths.swapaxes(0, 1)
        ]
        np.testing.assert_array_equal(particles.maps.log_odds, marks[parents])
        died += 12 - len(set(parents))
        before, marks = paths, particles.maps.log_odds.copy()
    assert died > 5
    assert particles.resampled > 1


def test_a_filter_that_just_resampled_is_not_certain() -> None:
    """All particles alike: what remains is the width of their proposals, in the robot's frame."""
    particles = begun(SMALL, np.tile([0.0, 0.0, 1.0], (12, 1)))
    width = np.array([[4e-4, 1e-4, 0.0], [1e-4, 1e-4, 0.0], [0.0, 0.0, 1e-5]])
    particles._covariances[:] = width
    mean, covariance = particles.pose_and_covariance()
    np.testing.assert_allclose(mean, [0.0, 0.0, 1.0], atol=1e-12)
    c, s = math.cos(1.0), math.sin(1.0)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # map_T_robot
    np.testing.assert_allclose(rotation @ covariance @ rotation.T, width, atol=1e-12)


# --- tracking -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lie", "far"), [((0.0, 0.0, 0.0), False), ((0.3, -0.2, 0.1), None), ((-1.2, 0.1, 0.25), True)]
)
def test_odometry_that_lies_is_found_out(lie: tuple[float, float, float], far: bool | None) -> None:
    particles = begun(SMALL, np.zeros((12, 3)))
    true = np.array([0.3, 0.1, 0.1])
    (points,) = look(ROOM, true[None])
    step = particles.track(points, se2.compose(true, np.array(lie)))
    assert np.hypot(*(step.pose - true)[:2]) < 0.02
    assert abs(step.pose[2] - true[2]) < math.radians(0.5)
    assert far is None or (step.searched > 0) == far
    assert step.fit > 0.8


def test_odometry_without_a_scan_to_check_it_is_believed() -> None:
    particles = begun(SMALL, np.zeros((12, 3)))
    (points,) = look(ROOM, np.zeros((1, 3)))
    empty: Any = type(points)(points.hits[:0], points.clear[:0], points.sensor)
    increments = np.array([[0.3, 0.0, 0.2], [0.1, 0.1, -0.5]])
    for increment in increments:
        step = particles.track(empty, increment)
        assert (step.fit, step.known, step.searched) == (0.0, 0.0, 0)
    np.testing.assert_allclose(step.pose, se2.compose(*increments), atol=1e-9)
    particles.update(empty, mapping=True)
    expected = sum(motion.variance(increment, SMALL.motion) for increment in increments)
    np.testing.assert_allclose(particles._covariances[0], np.diag(expected), rtol=1e-6)
