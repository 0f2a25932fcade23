import gtsam
import numpy as np
import pytest

from factors import ROOT_COVARIANCE, FactorError, prior_factor


def test_error_and_derivative_against_closed_form(rng: np.random.Generator) -> None:
    pose = gtsam.Pose2(3.0, -2.0, 2.5)
    covariance = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.002], [0.0, 0.002, 0.01]])
    factor = prior_factor(5, pose, covariance)
    at = pose.compose(gtsam.Pose2.Expmap(rng.normal(0.0, 0.5, 3)))
    values = gtsam.Values()
    values.insert(5, at)
    np.testing.assert_allclose(factor.unwhitenedError(values), gtsam.Pose2.Logmap(pose.between(at)), atol=1e-12)

    derivative = gtsam.Pose2.LogmapDerivative(pose.between(at))
    jacobian, _ = factor.linearize(values).jacobian()
    np.testing.assert_allclose(
        jacobian.T @ jacobian, derivative.T @ np.linalg.inv(covariance) @ derivative, rtol=1e-9, atol=1e-9
    )


def test_covariance_is_in_the_frame_of_the_vertex() -> None:
    """Turned by a quarter: the loose axis of the vertex is y of the joint frame."""
    factor = prior_factor(0, gtsam.Pose2(0.0, 0.0, np.pi / 2), np.diag([1.0, 1e-4, 1e-4]))
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(0.0, 1.0, np.pi / 2))
    assert factor.error(values) == pytest.approx(0.5)


def test_default_holds_the_root_still() -> None:
    assert np.sqrt(np.diag(ROOT_COVARIANCE)).max() <= 1e-4


@pytest.mark.parametrize("pose", [gtsam.Pose2(np.nan, 0, 0), gtsam.Pose2(0, np.inf, 0)])
def test_refuses_a_pose_that_is_not_finite(pose: gtsam.Pose2) -> None:
    with pytest.raises(FactorError, match="prior: pose is not finite"):
        prior_factor(0, pose)


def test_refuses_a_bad_covariance() -> None:
    with pytest.raises(FactorError, match="prior: covariance is not positive definite"):
        prior_factor(0, gtsam.Pose2(), np.diag([1.0, -1.0, 1.0]))
