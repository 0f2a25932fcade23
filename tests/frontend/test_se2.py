"""Planar motions against GTSAM's Pose2, and what must hold for any of them."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from frontend import se2
from frontend.records import FloatArray

angles = st.floats(-np.pi, np.pi) | st.sampled_from([0.0, np.pi, -np.pi, 1e-9, -1e-5, 2e-4, np.pi - 1e-12])
coordinates = st.floats(-50.0, 50.0)
poses = st.tuples(coordinates, coordinates, angles).map(np.array)


def pose2(pose: FloatArray) -> gtsam.Pose2:
    return gtsam.Pose2(*pose)


def same(ours: FloatArray, theirs: gtsam.Pose2, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(ours[:2], [theirs.x(), theirs.y()], atol=tolerance)
    assert abs(np.angle(np.exp(1j * (ours[2] - theirs.theta())))) < tolerance
    assert -np.pi <= ours[2] <= np.pi


@given(st.floats(-1e3, 1e3))
def test_wrapped_angles_are_the_same_angles(angle: float) -> None:
    wrapped = se2.wrap(np.array(angle))
    assert -np.pi <= wrapped <= np.pi
    assert abs(np.exp(1j * wrapped) - np.exp(1j * angle)) < 1e-9


def test_half_a_turn_is_positive() -> None:
    np.testing.assert_array_equal(se2.wrap(np.array([np.pi, -np.pi, 3 * np.pi, 0.0])), [np.pi, np.pi, np.pi, 0.0])


@given(poses, poses)
def test_motions_agree_with_gtsam(a: FloatArray, b: FloatArray) -> None:
    same(se2.compose(a, b), pose2(a).compose(pose2(b)))
    same(se2.between(a, b), pose2(a).between(pose2(b)))
    same(se2.inverse(a), pose2(a).inverse())


@given(poses)
def test_logarithm_agrees_with_gtsam(a: FloatArray) -> None:
    if abs(abs(a[2]) - np.pi) > 1e-9 and not 0.0 < abs(a[2]) < 1e-8:  # half a turn has two logarithms
        # GTSAM's loses digits at small turns, all of them at the smallest.
        np.testing.assert_allclose(se2.log(a), gtsam.Pose2.Logmap(pose2(a)), atol=1e-5)


@given(poses, poses)
def test_round_trips(a: FloatArray, b: FloatArray) -> None:
    same(se2.compose(a, se2.between(a, b)), pose2(b))
    same(se2.compose(se2.inverse(a), a), gtsam.Pose2())
    same(se2.inverse(se2.inverse(a)), pose2(a))
    same(a, gtsam.Pose2.Expmap(se2.log(a)), 1e-5)
    same(se2.exp(se2.log(a)), pose2(a))


@given(arrays(np.float64, (4, 1, 3), elements=coordinates), arrays(np.float64, (5, 3), elements=coordinates))
def test_arguments_broadcast(a: FloatArray, b: FloatArray) -> None:
    for function in (se2.compose, se2.between):
        whole = function(a, b)
        assert whole.shape == (4, 5, 3)
        for i in range(4):
            for j in range(5):
                np.testing.assert_array_equal(whole[i, j], function(a[i, 0], b[j]))


@pytest.mark.parametrize("heading", [0.3, np.pi, -2.0])
def test_mean_and_covariance_of_a_cloud(heading: float) -> None:
    """Drawn by GTSAM's exponential: the mean and the covariance in its tangent frame come back, also at half a turn."""
    rng = np.random.default_rng(1)
    covariance = np.array([[0.04, 0.01, -0.002], [0.01, 0.02, 0.003], [-0.002, 0.003, 0.01]])
    centre = gtsam.Pose2(2.0, -1.0, heading)
    drawn = [centre.compose(gtsam.Pose2.Expmap(xi)) for xi in rng.multivariate_normal(np.zeros(3), covariance, 4000)]
    cloud = np.array([(p.x(), p.y(), p.theta()) for p in drawn])
    mean, spread = se2.mean_and_covariance(cloud, np.full(4000, 1 / 4000))
    same(mean, centre, 0.01)
    np.testing.assert_allclose(spread, covariance, atol=0.0015)
    tangents = np.array([gtsam.Pose2.Logmap(pose2(mean).between(p)) for p in drawn])
    np.testing.assert_allclose(tangents.mean(axis=0), 0.0, atol=1e-8)
    np.testing.assert_allclose(spread, tangents.T @ tangents / 4000, atol=1e-8)


def test_mean_and_covariance_heed_the_weights() -> None:
    cloud = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [99.0, 9.0, 3.0]])
    mean, spread = se2.mean_and_covariance(cloud, np.array([0.25, 0.75, 0.0]))
    np.testing.assert_allclose(mean, [0.75, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(spread, np.diag([0.1875, 0.0, 0.0]), atol=1e-9)
