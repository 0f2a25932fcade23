from typing import Any, Literal

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors import EdgeKind, FactorError, UncertainPose, covariance_intersection_factor, intersect

POSE = gtsam.Pose2(4.0, -2.0, 2.9)


def covariance(rng: np.random.Generator, sigma: float) -> np.ndarray:
    root = rng.normal(0.0, sigma, (3, 3))
    return root @ root.T + 0.01 * sigma**2 * np.eye(3)


def step(pose: gtsam.Pose2, xi: np.ndarray) -> gtsam.Pose2:
    return pose.compose(gtsam.Pose2.Expmap(xi))


def test_error_and_derivatives(checks: Any) -> None:
    checks.error_and_derivatives(EdgeKind.COVARIANCE_INTERSECTION, covariance_intersection_factor)


def test_covariance_frame(checks: Any) -> None:
    checks.covariance_is_in_the_frame_of_the_child(EdgeKind.COVARIANCE_INTERSECTION, covariance_intersection_factor)


def gain(old: np.ndarray, new: np.ndarray, omega: float | Literal["optimal"]) -> np.ndarray:
    """(3, 6) derivative of the fused pose by the errors of (old, new), by differences through ``intersect``."""
    columns = []
    for axis in np.eye(6):
        ends = []
        for size in (1e-5, -1e-5):
            fused = intersect(
                UncertainPose(step(POSE, size * axis[:3]), old), UncertainPose(step(POSE, size * axis[3:]), new), omega
            )
            ends.append(gtsam.Pose2.Logmap(POSE.between(fused.pose)))
        columns.append((ends[0] - ends[1]) / 2e-5)
    return np.column_stack(columns)


@given(
    seed=st.integers(0, 2**32 - 1),
    correlation=st.floats(-1.0, 1.0),
    omega=st.one_of(st.floats(0.0, 1.0), st.just("optimal")),
)
def test_never_more_confident_than_the_truth_allows(
    seed: int, correlation: float, omega: float | Literal["optimal"]
) -> None:
    """For every joint covariance with these marginals, the claimed covariance is above that of the fused error."""
    rng = np.random.default_rng(seed)
    old, new = covariance(rng, 0.02), covariance(rng, 0.05)
    # Cross-covariance L_old C L_new' is possible if and only if no singular value of C is above one.
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    cross = np.linalg.cholesky(old) @ (correlation * turn) @ np.linalg.cholesky(new).T
    joint = np.block([[old, cross], [cross.T, new]])
    fused = intersect(UncertainPose(POSE, old), UncertainPose(POSE, new), omega)
    by_error = gain(old, new, omega)
    true = by_error @ joint @ by_error.T
    assert np.linalg.eigvalsh(fused.covariance - true).min() > -1e-8 * np.trace(fused.covariance)


def test_unlike_a_product_of_independent_estimates(rng: np.random.Generator) -> None:
    """The same estimate twice teaches nothing; fusing it as independent would halve the covariance."""
    estimate = UncertainPose(POSE, covariance(rng, 0.05))
    for omega in (0.0, 0.5, 1.0, "optimal"):
        fused = intersect(estimate, estimate, omega)
        assert fused.pose.equals(POSE, 1e-9)
        np.testing.assert_allclose(fused.covariance, estimate.covariance, rtol=1e-9)


def test_is_the_formula_of_the_paper_where_the_group_is_flat(rng: np.random.Generator) -> None:
    """M5 without rotation: translations with no angular error fuse as the paper's vectors do."""
    old, new = np.diag([0.04, 0.01, 1e-10]), np.diag([0.01, 0.09, 1e-10])
    a, b = np.array([1.0, 2.0, 0.0]), np.array([1.3, 1.6, 0.0])
    fused = intersect(UncertainPose(gtsam.Pose2(*a), old), UncertainPose(gtsam.Pose2(*b), new), 0.3)
    expected = np.linalg.inv(0.3 * np.linalg.inv(new) + 0.7 * np.linalg.inv(old))
    mean = expected @ (0.3 * np.linalg.inv(new) @ b + 0.7 * np.linalg.inv(old) @ a)
    np.testing.assert_allclose([fused.pose.x(), fused.pose.y(), fused.pose.theta()], mean, atol=1e-6)
    np.testing.assert_allclose(np.diag(fused.covariance)[:2], np.diag(expected)[:2], rtol=1e-4)


def test_ends_of_omega_are_the_two_estimates_in_their_own_frames(rng: np.random.Generator) -> None:
    old = UncertainPose(POSE, covariance(rng, 0.05))
    new = UncertainPose(step(POSE, np.array([0.4, -0.3, 0.5])), covariance(rng, 0.05))
    for omega, one in ((0.0, old), (1.0, new)):
        fused = intersect(old, new, omega)
        assert fused.pose.equals(one.pose, 1e-9)
        np.testing.assert_allclose(fused.covariance, one.covariance, rtol=1e-7)


def test_changing_the_roles_changes_little(rng: np.random.Generator) -> None:
    """The tangent space is that of one of the two: the choice is of second order."""
    old = UncertainPose(POSE, covariance(rng, 0.02))
    new = UncertainPose(step(POSE, np.array([0.02, -0.01, 0.02])), covariance(rng, 0.02))
    one, other = intersect(old, new, 0.4), intersect(new, old, 0.6)
    np.testing.assert_allclose(gtsam.Pose2.Logmap(one.pose.between(other.pose)), 0.0, atol=1e-5)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=0.02, atol=1e-6)


@given(seed=st.integers(0, 2**32 - 1))
def test_optimal_omega_is_the_best_on_a_fine_grid(seed: int) -> None:
    rng = np.random.default_rng(seed)
    old, new = (UncertainPose(POSE, covariance(rng, s)) for s in (0.03, 0.05))
    best = np.linalg.det(intersect(old, new, "optimal").covariance)
    grid = [np.linalg.det(intersect(old, new, float(w)).covariance) for w in np.linspace(0.0, 1.0, 51)]
    assert best <= min(grid) * (1.0 + 1e-6)


@pytest.mark.parametrize("omega", [-0.1, 1.1, np.nan])
def test_refuses_a_weight_that_is_none(omega: float, rng: np.random.Generator) -> None:
    estimate = UncertainPose(POSE, covariance(rng, 0.05))
    with pytest.raises(FactorError, match="omega"):
        intersect(estimate, estimate, omega)


@pytest.mark.parametrize("bad", [np.diag([1.0, np.nan, 1.0]), np.diag([1.0, 0.0, 1.0]), np.triu(np.ones((3, 3)))])
def test_refuses_what_is_no_covariance(bad: np.ndarray) -> None:
    good = UncertainPose(POSE, np.eye(3))
    with pytest.raises(FactorError, match="old estimate"):
        intersect(UncertainPose(POSE, bad), good)
    with pytest.raises(FactorError, match="new estimate"):
        intersect(good, UncertainPose(POSE, bad))


def test_refuses_a_pose_that_is_not_finite() -> None:
    good = UncertainPose(POSE, np.eye(3))
    with pytest.raises(FactorError, match="new estimate: pose is not finite"):
        intersect(good, UncertainPose(gtsam.Pose2(np.nan, 0.0, 0.0), np.eye(3)))
