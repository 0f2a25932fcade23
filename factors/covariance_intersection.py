"""The update of an edge when the robot travels it again (M5).

The new transform shares maps, and so errors, with the old one, to an unknown degree: covariance intersection
(Julier and Uhlmann 1997) is consistent for every correlation.
"""

from typing import Literal

import gtsam
import numpy as np

from factors.edge import Edge
from factors.errors import FactorError
from factors.noise import FloatArray, UncertainPose, check_covariance, check_pose


def covariance_intersection_factor(edge: Edge, tail: int, head: int) -> gtsam.BetweenFactorPose2:
    """The fused tail_T_head, keys ``tail`` and ``head``; it takes the place of the edge it updates."""
    noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
    return gtsam.BetweenFactorPose2(tail, head, edge.measurement, noise)


def intersect(old: UncertainPose, new: UncertainPose, omega: float | Literal["optimal"] = 0.5) -> UncertainPose:
    """Fuse two estimates of the same a_T_b whose correlation is not known.

    The paper averages transformation matrices entry by entry, which leaves the group. Here the same formula
    works in the tangent space at ``old``: ``new`` becomes a vector there and its covariance follows it, the
    fused vector goes back to the group, and its covariance is re-expressed at the fused pose.

    Args:
        old: the edge as it is.
        new: the transform measured this time.
        omega: weight of ``new``, 0 to 1 (paper: 0.5), or "optimal": least determinant, the measure M6
            uses too; unlike the trace it does not depend on the units.

    Raises:
        FactorError: if a pose is not finite, a covariance not positive definite, or omega not in [0, 1].
    """
    old_covariance = check_covariance(old.covariance, "covariance intersection, old estimate")
    new_covariance = check_covariance(new.covariance, "covariance intersection, new estimate")
    check_pose(old.pose, "covariance intersection, old estimate")
    check_pose(new.pose, "covariance intersection, new estimate")

    offset = old.pose.between(new.pose)
    # Log(offset * Exp(xi)) = Log(offset) + J xi to first order.
    jacobian = gtsam.Pose2.LogmapDerivative(offset)
    old_information: FloatArray = np.linalg.inv(old_covariance).astype(np.float64)
    new_information: FloatArray = np.linalg.inv(jacobian @ new_covariance @ jacobian.T).astype(np.float64)
    weight = _least_determinant_omega(old_information, new_information) if omega == "optimal" else omega
    if not 0.0 <= weight <= 1.0:
        raise FactorError(f"covariance intersection: omega {weight} is not within [0, 1]")

    covariance = np.linalg.inv(weight * new_information + (1.0 - weight) * old_information)
    step = covariance @ (weight * new_information @ gtsam.Pose2.Logmap(offset))
    # Exp(step + xi) = Exp(step) * Exp(J xi) to first order.
    jacobian = gtsam.Pose2.ExpmapDerivative(step)
    fused = jacobian @ covariance @ jacobian.T
    return UncertainPose(old.pose.compose(gtsam.Pose2.Expmap(step)), 0.5 * (fused + fused.T))


def _least_determinant_omega(old_information: FloatArray, new_information: FloatArray) -> float:
    """The weight w in [0, 1] that makes det(w * new + (1 - w) * old) of the informations greatest.

    With g the eigenvalues of ``old^-1 new`` the logarithm of the determinant is a constant plus the sum of
    ``log(1 + w (g - 1))``: concave, so its slope has at most one zero, found by bisection.
    """
    gains = np.linalg.eigvals(np.linalg.solve(old_information, new_information)).real - 1.0

    def slope(weight: float) -> float:
        return float(np.sum(gains / (1.0 + weight * gains)))

    if slope(0.0) <= 0.0:
        return 0.0
    if slope(1.0) >= 0.0:
        return 1.0
    low, high = 0.0, 1.0
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if slope(middle) > 0.0 else (low, middle)
    return 0.5 * (low + high)
