"""Covariances of poses on SE(2): checks, changes of frame, the robust kernel.

Convention (the whole project): a covariance is 3x3, order x, y, theta, in the tangent space at the measured
pose, in the frame of the child: ``a_T_b_true = a_T_b * Exp(xi)``, ``xi ~ N(0, covariance)``. This is what
``gtsam.BetweenFactorPose2`` expects. A tangent vector moves between frames by the adjoint (Sola, Deray and
Atchuthan 2018, "A micro Lie theory for state estimation in robotics").
"""

from typing import NamedTuple

import gtsam
import numba
import numpy as np
import numpy.typing as npt

from factors.errors import FactorError

FloatArray = npt.NDArray[np.float64]

# Standard deviations outside 0.1 um .. 100 km, or a condition beyond what doubles can solve, are mistakes.
_MIN_VARIANCE, _MAX_VARIANCE, _MAX_CONDITION = 1e-14, 1e10, 1e14

# chi2 of so many degrees of freedom, 95 %: up to here an edge under the robust kernel keeps its full weight.
FULL_WEIGHT = {2: 5.991, 3: 7.815}


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


def check_covariance(covariance: npt.ArrayLike, what: str, size: int = 3) -> FloatArray:
    """Return a read-only, exactly symmetric copy of a (3, 3) covariance, or of another size.

    Raises:
        FactorError: naming ``what``, if it has another shape, is not finite, symmetric and positive definite,
            or lies outside what double precision can solve.
    """
    matrix = np.array(covariance, dtype=np.float64)
    if matrix.shape != (size, size):
        raise FactorError(f"{what}: covariance has shape {matrix.shape}, expected ({size}, {size})")
    if not np.all(np.isfinite(matrix)):
        raise FactorError(f"{what}: covariance is not finite: {matrix.tolist()}")
    size_of = np.abs(matrix)
    if (np.abs(matrix - matrix.T) > 1e-8 * (size_of + size_of.diagonal().max())).any():
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


def check_pose_covariance(estimate: UncertainPose, what: str) -> UncertainPose:
    """``estimate``, checked; its covariance may be zero or singular, as that of few particles is.

    The covariance comes back read-only and positive definite: wider by 1e-12 of itself, at least by (0.3 um)^2.

    Raises:
        FactorError: naming ``what``, if the pose is not finite or the covariance fails ``check_covariance`` in
            another way than by being singular.
    """
    check_pose(estimate.pose, what)
    given = np.asarray(estimate.covariance, dtype=np.float64)
    # A hair wider, it is positive definite if it was semidefinite: one set of rules for both.
    hair = max(1e-12 * float(np.abs(np.nan_to_num(given)).max(initial=0.0)), 10.0 * _MIN_VARIANCE)
    wider = given + hair * np.eye(3) if given.shape == (3, 3) else given
    return UncertainPose(estimate.pose, check_covariance(wider, what))


@numba.njit(cache=True, error_model="numpy")
def squared_mahalanobis(residual, covariance):  # type: ignore[no-untyped-def]
    """chi2 of a residual (n,) over its positive definite covariance (n, n): NumPy's solver takes ten times as long."""
    rest, left = residual.copy(), covariance.copy()
    total = 0.0
    for i in range(len(rest)):
        total += rest[i] * rest[i] / left[i, i]
        for r in range(i + 1, len(rest)):
            share = left[r, i] / left[i, i]
            rest[r] -= share * rest[i]
            for c in range(i + 1, len(rest)):
                left[r, c] -= share * left[i, c]
    return total


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
    kernel = gtsam.noiseModel.mEstimator.DCS.Create(FULL_WEIGHT[model.dim()])
    return gtsam.noiseModel.Robust.Create(kernel, model)


def has_kernel(factor: gtsam.NoiseModelFactor) -> bool:
    """Whether the factor is under a robust kernel."""
    return isinstance(factor.noiseModel(), gtsam.noiseModel.Robust)


def without_kernel(factor: gtsam.NoiseModelFactor) -> gtsam.NoiseModelFactor:
    """The same factor with its Gaussian noise alone."""
    noise = factor.noiseModel()
    if not isinstance(noise, gtsam.noiseModel.Robust):
        return factor
    return factor.cloneWithNewNoiseModel(noise.noise())


def weight(factor: gtsam.NoiseModelFactor, values: gtsam.Values) -> float:
    """What the robust kernel of a factor that has one leaves of its information, where ``values`` have its ends."""
    full = FULL_WEIGHT[factor.dim()]
    chi2 = 2.0 * without_kernel(factor).error(values)
    return float(min(1.0, 2.0 * full / (full + chi2)) ** 2)


def weighed(factor: gtsam.NoiseModelFactor, share: float) -> gtsam.NoiseModelFactor:
    """The same factor with a fixed share of its information in place of its robust kernel."""
    plain = without_kernel(factor)
    if share == 1.0:
        return plain
    noise = plain.noiseModel()
    assert isinstance(noise, gtsam.noiseModel.Gaussian)
    return factor.cloneWithNewNoiseModel(gtsam.noiseModel.Gaussian.Information(share * noise.information()))
