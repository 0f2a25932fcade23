"""Normalised estimation error squared: is a covariance honest?

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, 5.4.
"""

import numpy as np

from frontend import se2
from frontend.records import FloatArray


def nees(true: FloatArray, estimated: FloatArray, covariances: FloatArray) -> FloatArray:
    """``e' inv(P) e / 3`` of each pose (n,), with ``e = Log(true^-1 * estimated)``.

    The average is near 1 for an honest estimate, above 1 for an over-confident one. The covariance is in the tangent
    space at the estimate, where the error is ``Log(estimated^-1 * true)``: that is ``-e``, so the form is the same.

    Args:
        true: (n, 3) poses x, y, theta.
        estimated: (n, 3) poses in the same frame.
        covariances: (n, 3, 3) in the frame of the child, order x, y, theta.
    """
    error = se2.log(se2.between(true, estimated))
    whitened = np.linalg.solve(covariances, error[..., None])[..., 0]
    return np.asarray((error * whitened).sum(axis=-1) / 3.0)
