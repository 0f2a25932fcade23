import gtsam
import numpy as np

from factors import UncertainPose, adjoint_transport, compose, inverse

A_T_B = UncertainPose(gtsam.Pose2(6.0, -3.0, 2.1), np.diag([0.02, 0.005, 0.003]) ** 2)
B_T_C = UncertainPose(gtsam.Pose2(-4.0, 7.0, -1.2), np.diag([0.004, 0.03, 0.002]) ** 2)


def draw(estimate: UncertainPose, rng: np.random.Generator, count: int) -> list[gtsam.Pose2]:
    noise = rng.multivariate_normal(np.zeros(3), estimate.covariance, count)
    return [estimate.pose.compose(gtsam.Pose2.Expmap(xi)) for xi in noise]


def spread(mean: gtsam.Pose2, poses: list[gtsam.Pose2]) -> np.ndarray:
    return np.cov([gtsam.Pose2.Logmap(mean.between(pose)) for pose in poses], rowvar=False)


def assert_same_covariance(measured: np.ndarray, claimed: np.ndarray) -> None:
    """Relative to the claimed one: every direction within 5 %, at 20000 draws five standard errors."""
    root = np.linalg.cholesky(claimed)
    ratio = np.linalg.solve(root, np.linalg.solve(root, measured).T)
    np.testing.assert_allclose(np.linalg.eigvalsh(ratio), 1.0, atol=0.05)


def test_inverse_by_monte_carlo(rng: np.random.Generator) -> None:
    back = inverse(A_T_B)
    assert_same_covariance(spread(back.pose, [pose.inverse() for pose in draw(A_T_B, rng, 20000)]), back.covariance)


def test_composition_by_monte_carlo(rng: np.random.Generator) -> None:
    both = compose(A_T_B, B_T_C)
    pairs = zip(draw(A_T_B, rng, 20000), draw(B_T_C, rng, 20000), strict=True)
    assert_same_covariance(spread(both.pose, [a.compose(b) for a, b in pairs]), both.covariance)


def test_inverse_and_transport_undo_themselves() -> None:
    twice = inverse(inverse(A_T_B))
    assert twice.pose.equals(A_T_B.pose, 1e-12)
    np.testing.assert_allclose(twice.covariance, A_T_B.covariance, rtol=1e-9, atol=1e-18)
    there = adjoint_transport(A_T_B.pose, A_T_B.covariance)
    np.testing.assert_allclose(adjoint_transport(A_T_B.pose.inverse(), there), A_T_B.covariance, rtol=1e-9, atol=1e-18)


def test_composition_is_associative() -> None:
    left = compose(compose(A_T_B, B_T_C), A_T_B)
    right = compose(A_T_B, compose(B_T_C, A_T_B))
    assert left.pose.equals(right.pose, 1e-12)
    np.testing.assert_allclose(left.covariance, right.covariance, rtol=1e-9, atol=1e-15)
