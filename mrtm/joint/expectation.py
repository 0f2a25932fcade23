"""What a graph expects edges to measure that it does not believe, each by itself or after others have come in."""

from collections.abc import Sequence
from itertools import pairwise

import gtsam
import numpy as np
from scipy.linalg import block_diag

from factors import GraphEdge, squared_mahalanobis
from factors.noise import FloatArray


class Expectation:
    """Edges may be taken in one after the other; what is expected of the rest follows, as far as it is linear.

    Args:
        edges: n, which the estimate does not know of.
        poses: the relative pose of the ends of each, as estimated.
        known: (3 n, 3 n) the covariance of all these poses together, each in the frame of its head.
    """

    def __init__(self, edges: Sequence[GraphEdge], poses: Sequence[gtsam.Pose2], known: FloatArray) -> None:
        residuals, jacobians = zip(*(e.residual(pose) for e, pose in zip(edges, poses, strict=True)), strict=True)
        ends = np.cumsum([0, *map(len, residuals)]).tolist()
        self._rows = [slice(*both) for both in pairwise(ends)]
        self._residual = np.concatenate(residuals)
        jacobian = block_diag(*jacobians)
        self._covariance = jacobian @ known @ jacobian.T
        self._noise = [e.covariance for e in edges]

    def misfit(self, n: int) -> float:
        """chi2 of edge ``n`` over its own covariance."""
        return float(squared_mahalanobis(self._residual[self._rows[n]], self._noise[n]))

    def innovation(self, n: int) -> tuple[float, FloatArray]:
        """chi2 of edge ``n`` over its covariance and the estimate's together, and that sum."""
        rows = self._rows[n]
        total = self._noise[n] + self._covariance[rows, rows]
        return float(squared_mahalanobis(self._residual[rows], total)), total

    def take(self, n: int) -> None:
        """Let the estimate know of edge ``n``."""
        rows = self._rows[n]
        gain = np.linalg.solve(self._noise[n] + self._covariance[rows, rows], self._covariance[rows]).T
        self._residual = self._residual - gain @ self._residual[rows]
        self._covariance = self._covariance - gain @ self._covariance[rows]
