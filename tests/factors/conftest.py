"""What the tests of every relative factor share: examples, and the checks a type module calls with its own factor."""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import chi2, kstest

from factors import Edge, EdgeId, EdgeKind, VertexId

FloatArray = npt.NDArray[np.float64]
Builder = Callable[[Edge, int, int], gtsam.BetweenFactorPose2]

TAIL, HEAD = 11, 7


def random_pose(rng: np.random.Generator) -> gtsam.Pose2:
    return gtsam.Pose2(*rng.uniform([-8.0, -8.0, -np.pi], [8.0, 8.0, np.pi]))


def random_covariance(rng: np.random.Generator, sigma: float) -> FloatArray:
    """(3, 3), correlated, standard deviations about ``sigma``."""
    root = rng.normal(0.0, sigma, (3, 3))
    return np.asarray(root @ root.T + 0.1 * sigma**2 * np.eye(3), dtype=np.float64)


@dataclass
class BetweenChecks:
    """A relative factor against closed form and Monte Carlo, whatever its type."""

    rng: np.random.Generator

    def edge(self, kind: EdgeKind, sigma: float) -> Edge:
        pose, covariance = random_pose(self.rng), random_covariance(self.rng, sigma)
        return Edge(EdgeId("red", 4), 0, kind, VertexId("red", 0), VertexId("red", 1), pose, covariance)

    def error_and_derivatives(self, kind: EdgeKind, build: Builder, shared: float = 1.0) -> None:
        """``e = Log(Z^-1 A^-1 B)``: value, closed-form Jacobians and central differences, at poses near and far.

        The factor has ``shared`` times the edge's covariance.
        """
        for spread in (0.0, 0.01, 1.0):
            edge = self.edge(kind, 0.1)
            a = random_pose(self.rng)
            b = a.compose(edge.measurement).compose(gtsam.Pose2.Expmap(self.rng.normal(0.0, spread, 3)))
            factor, values = build(edge, TAIL, HEAD), gtsam.Values()
            values.insert(TAIL, a)
            values.insert(HEAD, b)
            assert list(factor.keys()) == [TAIL, HEAD]

            offset = edge.measurement.between(a.between(b))
            residual = gtsam.Pose2.Logmap(offset)
            np.testing.assert_allclose(factor.unwhitenedError(values), residual, atol=1e-12)

            by_head = gtsam.Pose2.LogmapDerivative(offset)
            by_tail = -by_head @ b.between(a).AdjointMap()
            for key, closed in ((TAIL, by_tail), (HEAD, by_head)):
                np.testing.assert_allclose(self._numerical(factor, values, key), closed, atol=1e-6)

            # What the solver sees: whitened by the square root information (times the kernel's weight).
            jacobian, _ = factor.linearize(values).jacobian()
            information: FloatArray = np.linalg.inv(shared * edge.covariance).astype(np.float64)
            weight = self._weight(factor, float(residual @ information @ residual))
            seen: FloatArray = jacobian.T @ jacobian
            expected: FloatArray = weight * self._stack(by_tail, by_head, information)
            np.testing.assert_allclose(seen, expected, rtol=1e-6, atol=1e-6)

    def covariance_is_in_the_frame_of_the_child(self, kind: EdgeKind, build: Builder) -> None:
        """Noise drawn at the head: chi2 of the factor has 3 degrees of freedom; drawn at the tail, it must not."""
        pose = gtsam.Pose2(6.0, -3.0, 2.1)
        covariance = np.diag([0.03, 0.01, 0.002]) ** 2
        edge = Edge(EdgeId("red", 1), 0, kind, VertexId("red", 0), VertexId("red", 1), pose, covariance)
        factor = build(edge, TAIL, HEAD)
        draws = self.rng.multivariate_normal(np.zeros(3), covariance, 4000)
        at_head = [self._chi2(factor, covariance, pose.compose(gtsam.Pose2.Expmap(xi))) for xi in draws]
        at_tail = [self._chi2(factor, covariance, gtsam.Pose2.Expmap(xi).compose(pose)) for xi in draws]
        assert kstest(at_head, chi2(3).cdf).pvalue > 1e-3
        assert kstest(at_tail, chi2(3).cdf).pvalue < 1e-9

    @staticmethod
    def _chi2(factor: gtsam.BetweenFactorPose2, covariance: FloatArray, measured: gtsam.Pose2) -> float:
        values = gtsam.Values()
        values.insert(TAIL, gtsam.Pose2(1.0, 2.0, 0.5))
        values.insert(HEAD, gtsam.Pose2(1.0, 2.0, 0.5).compose(measured))
        error = factor.unwhitenedError(values)
        return float(error @ np.linalg.solve(covariance, error))

    @staticmethod
    def _stack(by_tail: FloatArray, by_head: FloatArray, information: FloatArray) -> FloatArray:
        both = np.hstack([by_tail, by_head])
        return np.asarray(both.T @ information @ both, dtype=np.float64)

    @staticmethod
    def _weight(factor: gtsam.BetweenFactorPose2, squared: float) -> float:
        noise = factor.noiseModel()
        if not isinstance(noise, gtsam.noiseModel.Robust):
            return 1.0
        # Agarwal et al. 2013, eq. 15, squared: the weight of the squared residual.
        return min(1.0, 2.0 * 7.815 / (7.815 + squared)) ** 2

    @staticmethod
    def _numerical(factor: gtsam.BetweenFactorPose2, values: gtsam.Values, key: int) -> FloatArray:
        columns = []
        for axis in np.eye(3):
            errors = []
            for step in (1e-6, -1e-6):
                moved = gtsam.Values(values)
                moved.update(key, values.atPose2(key).compose(gtsam.Pose2.Expmap(step * axis)))
                errors.append(factor.unwhitenedError(moved))
            columns.append((errors[0] - errors[1]) / 2e-6)
        return np.column_stack(columns).astype(np.float64)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(2)


@pytest.fixture
def checks(rng: np.random.Generator) -> BetweenChecks:
    return BetweenChecks(rng)
