"""Covariances of poses on SE(2): checks, changes of frame, the robust kernel.

Convention (the whole project): a covariance is 3x3, order x, y, theta, in the tangent space at the measured
pose, in the frame of the child: ``a_T_b_true = a_T_b * Exp(xi)``, ``xi ~ N(0, covariance)``. This is what
``gtsam.BetweenFactorPose2`` expects. A tangent vector moves between frames by the adjoint (Sola, Deray and
Atchuthan 2018, "A micro Lie theory for state estimation in robotics").
"""

from typing import NamedTuple

import gtsam
import numpy as np
import numpy.typing as npt

from factors.errors import FactorError

FloatArray = npt.NDArray[np.float64]

# Standard deviations outside 0.1 um .. 100 km, or a condition beyond what doubles can solve, are mistakes.
_MIN_VARIANCE, _MAX_VARIANCE, _MAX_CONDITION = 1e-14, 1e10, 1e14

# chi2 of 3 degrees of freedom, 95 %: up to here an honest edge keeps its full weight.
_DCS_THRESHOLD = 7.815


class UncertainPose(NamedTuple):
    """``pose`` a_T_b and its (3, 3) ``covariance`` in the tangent space at b."""

    pose: gtsam.Pose2
    covariance: FloatArray


def check_pose(pose: gtsam.Pose2, what: str) -> gtsam.Pose2:
    """Return ``pose``, or raise FactorError naming ``what`` if it is not finite (GTSAM takes NaN)."""
    values = (pose.x(), pose.y(), pose.theta())
    if not np.all(np.isfinite(values)):
        raise FactorError(f"{what}: pose is not finite: x, y, theta = {values}")
    return pose


def check_covariance(covariance: npt.ArrayLike, what: str) -> FloatArray:
    """Return a read-only, exactly symmetric copy of a (3, 3) covariance.

    Raises:
        FactorError: naming ``what``, if it has another shape, is not finite, symmetric and positive definite,
            or lies outside what double precision can solve.
    """
    matrix = np.array(covariance, dtype=np.float64)
    if matrix.shape != (3, 3):
        raise FactorError(f"{what}: covariance has shape {matrix.shape}, expected (3, 3)")
    if not np.all(np.isfinite(matrix)):
        raise FactorError(f"{what}: covariance is not finite: {matrix.tolist()}")
    if not np.allclose(matrix, matrix.T, rtol=1e-8, atol=1e-8 * np.abs(np.diag(matrix)).max()):
        raise FactorError(f"{what}: covariance is not symmetric: {matrix.tolist()}")
    matrix = 0.5 * (matrix + matrix.T)
    eigenvalues = np.linalg.eigvalsh(matrix)
    low, high = float(eigenvalues[0]), float(eigenvalues[-1])
    if low <= 0.0 or high > _MAX_CONDITION * low:
        raise FactorError(f"{what}: covariance is not positive definite: eigenvalues {eigenvalues.tolist()}")
    if low < _MIN_VARIANCE or high > _MAX_VARIANCE:
        raise FactorError(
            f"{what}: covariance is out of bounds: eigenvalues {eigenvalues.tolist()} not within "
            f"[{_MIN_VARIANCE:g}, {_MAX_VARIANCE:g}]"
        )
    matrix.setflags(write=False)
    return matrix


def adjoint_transport(a_T_b: gtsam.Pose2, covariance: FloatArray) -> FloatArray:
    """A (3, 3) covariance in the tangent frame of b, re-expressed in the tangent frame of a: ``Ad C Ad'``."""
    adjoint = a_T_b.AdjointMap()
    return np.asarray(adjoint @ covariance @ adjoint.T, dtype=np.float64)


def inverse(estimate: UncertainPose) -> UncertainPose:
    """b_T_a, covariance in the frame of a, from a_T_b with its covariance in the frame of b. Exact."""
    return UncertainPose(estimate.pose.inverse(), adjoint_transport(estimate.pose, estimate.covariance))


def compose(first: UncertainPose, second: UncertainPose) -> UncertainPose:
    """a_T_c from independent a_T_b (``first``) and b_T_c (``second``), the covariance to first order."""
    carried = adjoint_transport(second.pose.inverse(), first.covariance)
    return UncertainPose(first.pose.compose(second.pose), carried + second.covariance)


def robust(model: gtsam.noiseModel.Base) -> gtsam.noiseModel.Robust:
    """``model`` under dynamic covariance scaling (Agarwal et al. 2013), for edges that may be false.

    Exactly quadratic for 95 % of honest residuals, so the marginals of a graph of true edges stay exact
    (Cauchy and Geman-McClure always shave weight); beyond, its pull falls with the third power of the
    residual, so a false edge does not bend a map (Cauchy: the first power, metres of bend on a loose chain).
    """
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.DCS.Create(_DCS_THRESHOLD), model)


def has_kernel(factor: gtsam.BetweenFactorPose2) -> bool:
    """Whether the factor is under a robust kernel."""
    return isinstance(factor.noiseModel(), gtsam.noiseModel.Robust)


def without_kernel(factor: gtsam.BetweenFactorPose2) -> gtsam.BetweenFactorPose2:
    """The same factor with its Gaussian noise alone."""
    noise = factor.noiseModel()
    if not isinstance(noise, gtsam.noiseModel.Robust):
        return factor
    tail, head = factor.keys()
    return gtsam.BetweenFactorPose2(tail, head, factor.measured(), noise.noise())
