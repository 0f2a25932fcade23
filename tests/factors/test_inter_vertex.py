from typing import Any

import gtsam

from factors import EdgeKind, inter_vertex_factor


def test_error_and_derivatives(checks: Any) -> None:
    checks.error_and_derivatives(EdgeKind.INTER_VERTEX, inter_vertex_factor)


def test_covariance_frame(checks: Any) -> None:
    checks.covariance_is_in_the_frame_of_the_child(EdgeKind.INTER_VERTEX, inter_vertex_factor)


def test_pulls_with_full_weight_however_far(checks: Any) -> None:
    edge = checks.edge(EdgeKind.INTER_VERTEX, 0.01)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2())
    values.insert(1, edge.measurement.compose(gtsam.Pose2(5.0, 0.0, 0.0)))
    factor = inter_vertex_factor(edge, 0, 1)
    error = factor.whitenedError(values)
    assert factor.error(values) == 0.5 * float(error @ error)
