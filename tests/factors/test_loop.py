from typing import Any

import gtsam
import numpy as np
import pytest

from factors import EdgeKind, has_kernel, loop_factor, without_kernel


def test_error_and_derivatives(checks: Any) -> None:
    checks.error_and_derivatives(EdgeKind.LOOP, loop_factor)


def test_covariance_frame(checks: Any) -> None:
    checks.covariance_is_in_the_frame_of_the_child(EdgeKind.LOOP, loop_factor)


def _cost(factor: gtsam.NoiseModelFactor, edge: Any, sigmas: float) -> float:
    """The factor's cost at a residual of so many standard deviations."""
    root = np.linalg.cholesky(edge.covariance)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2())
    values.insert(1, edge.measurement.compose(gtsam.Pose2.Expmap(root @ np.array([sigmas, 0.0, 0.0]))))
    return float(factor.error(values))


def test_honest_residuals_keep_full_weight_and_false_ones_saturate(checks: Any) -> None:
    edge = checks.edge(EdgeKind.LOOP, 0.01)
    factor = loop_factor(edge, 0, 1)
    for sigmas in (0.5, 1.0, 2.0, 2.7):
        assert _cost(factor, edge, sigmas) == pytest.approx(0.5 * sigmas**2, rel=1e-6)
    # Ten times farther, and next to no more cost: nothing left to pull with.
    assert _cost(factor, edge, 200.0) < _cost(factor, edge, 20.0) * 1.05


def test_kernel_comes_off(checks: Any) -> None:
    edge = checks.edge(EdgeKind.LOOP, 0.01)
    factor = loop_factor(edge, 0, 1)
    plain = without_kernel(factor)
    assert has_kernel(factor)
    assert not has_kernel(plain)
    assert without_kernel(plain) is plain
    assert _cost(plain, edge, 20.0) == pytest.approx(200.0, rel=1e-6)
