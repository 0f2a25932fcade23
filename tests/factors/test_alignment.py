from typing import Any

import gtsam
import numpy as np
import pytest

from factors import Edge, EdgeId, EdgeKind, VertexId, alignment_factor, factor_of, has_kernel
from factors.alignment import SHARED


def test_error_and_derivatives(checks: Any) -> None:
    checks.error_and_derivatives(EdgeKind.ALIGNMENT, alignment_factor, SHARED)


def test_covariance_frame(checks: Any) -> None:
    checks.covariance_is_in_the_frame_of_the_child(EdgeKind.ALIGNMENT, alignment_factor)


def test_a_corridor_weighs_across_it_and_hardly_along_it() -> None:
    # 1 cm across the head's x axis, 5 m along it: an offset costs what its own direction says.
    covariance = np.diag([25.0, 1e-4, 1e-6])
    edge = Edge(EdgeId("red", 0), 0, EdgeKind.ALIGNMENT, VertexId("red", 0), VertexId("blue", 0),
                gtsam.Pose2(3.0, 1.0, 1.2), covariance)  # fmt: skip
    factor = factor_of(edge, 0, 1)
    assert has_kernel(factor)

    def cost(*offset: float) -> float:
        values = gtsam.Values()
        values.insert(0, gtsam.Pose2())
        values.insert(1, edge.measurement.compose(gtsam.Pose2(*offset)))
        return float(factor.error(values))

    assert cost(0.5, 0.0, 0.0) == pytest.approx(0.5 * 0.01, rel=1e-6)
    assert cost(0.0, 0.02, 0.0) == pytest.approx(0.5 * 4.0, rel=1e-6)


def test_maps_of_one_robot_share_errors_with_its_other_edges() -> None:
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2())
    values.insert(1, gtsam.Pose2(0.1, 0.0, 0.0))
    own, between = (
        factor_of(
            Edge(EdgeId("red", 0), 0, EdgeKind.ALIGNMENT, VertexId("red", 0), head, gtsam.Pose2(), np.eye(3)), 0, 1
        )
        for head in (VertexId("red", 1), VertexId("blue", 0))
    )
    assert between.error(values) == pytest.approx(0.5 * 0.1**2)
    assert own.error(values) == pytest.approx(between.error(values) / SHARED)
