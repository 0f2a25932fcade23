import gtsam
import numpy as np
import pytest

from factors import FactorError, UncertainPose, adjoint_transport, compose, inverse, particle_estimate

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


def test_particles_give_back_what_they_were_drawn_from(rng: np.random.Generator) -> None:
    source = UncertainPose(gtsam.Pose2(2.0, 1.0, 3.1), np.diag([0.3, 0.05, 0.2]) ** 2)  # straddles pi
    particles = np.array([[p.x(), p.y(), p.theta()] for p in draw(source, rng, 20000)])
    found = particle_estimate(particles, np.ones(len(particles)))
    assert gtsam.Pose2.Logmap(source.pose.between(found.pose)) == pytest.approx(np.zeros(3), abs=0.015)
    assert_same_covariance(found.covariance, source.covariance)


def test_particle_mean_is_the_one_of_the_group(rng: np.random.Generator) -> None:
    particles = rng.normal(0.0, 0.5, (30, 3)) + np.array([4.0, 0.0, np.pi])
    weights = rng.uniform(0.0, 3.0, 30)
    found = particle_estimate(particles, weights)
    logs = np.array([gtsam.Pose2.Logmap(found.pose.between(gtsam.Pose2(*p))) for p in particles])
    np.testing.assert_allclose(weights @ logs, 0.0, atol=1e-9)
    shares = weights / weights.sum()
    np.testing.assert_allclose(found.covariance, (shares[:, None] * logs).T @ logs, atol=1e-12)


def test_weights_count_as_copies(rng: np.random.Generator) -> None:
    particles = rng.normal(0.0, 0.1, (5, 3))
    counts = np.array([1.0, 2.0, 0.0, 3.0, 1.0])
    weighted = particle_estimate(particles, counts)
    copied = particle_estimate(np.repeat(particles, counts.astype(int), axis=0), np.ones(7))
    assert weighted.pose.equals(copied.pose, 1e-9)
    np.testing.assert_allclose(weighted.covariance, copied.covariance, atol=1e-12)


@pytest.mark.parametrize(
    ("particles", "weights"),
    [
        (np.full((4, 3), np.nan), np.ones(4)),
        (np.zeros((4, 2)), np.ones(4)),
        (np.zeros((4, 3)), np.ones(3)),
        (np.zeros((4, 3)), np.zeros(4)),
        (np.zeros((4, 3)), np.array([1.0, -1.0, 1.0, 1.0])),
        (np.zeros((4, 3)), np.array([1.0, np.nan, 1.0, 1.0])),
    ],
)
def test_refuses_unusable_particles(particles: np.ndarray, weights: np.ndarray) -> None:
    with pytest.raises(FactorError):
        particle_estimate(particles, weights)
