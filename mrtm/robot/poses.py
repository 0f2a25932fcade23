"""Poses as the front end has them (arrays) and as the factors have them (``gtsam.Pose2``)."""

import gtsam
import numpy as np

from factors import UncertainPose, squared_mahalanobis
from frontend import se2
from frontend.records import FloatArray


def pose_of(xytheta: FloatArray) -> gtsam.Pose2:
    """The (3,) array as a pose."""
    return gtsam.Pose2(float(xytheta[0]), float(xytheta[1]), float(se2.wrap(xytheta[2])))


def array_of(pose: gtsam.Pose2) -> FloatArray:
    """The pose as a (3,) array."""
    return np.array([pose.x(), pose.y(), pose.theta()])


def exactly(xytheta: FloatArray) -> UncertainPose:
    """The (3,) array as a pose without error."""
    return UncertainPose(pose_of(xytheta), np.zeros((3, 3)))


def innovation(expected: UncertainPose, measured: UncertainPose) -> tuple[FloatArray, float]:
    """How far a measurement is from what was expected: the tangent vector (3,) and its chi2, 3 degrees of freedom.

    The sum of the covariances is right for independent estimates that are not far apart.
    """
    offset = gtsam.Pose2.Logmap(expected.pose.between(measured.pose))
    return offset, float(squared_mahalanobis(offset, expected.covariance + measured.covariance))
