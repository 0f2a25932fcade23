"""Every edge of the joint graph, one module a type, each folded into a native GTSAM factor."""

from collections.abc import Callable

import gtsam

from factors.covariance_intersection import covariance_intersection_factor, intersect
from factors.edge import Edge, EdgeId, EdgeKind, VertexId
from factors.errors import FactorError
from factors.inter_vertex import inter_vertex_factor
from factors.loop import loop_factor
from factors.noise import (
    UncertainPose,
    adjoint_transport,
    check_covariance,
    check_pose,
    compose,
    has_kernel,
    inverse,
    particle_estimate,
    without_kernel,
)
from factors.prior import ROOT_COVARIANCE, prior_factor
from factors.sighting import Sighting

_FACTORS: dict[EdgeKind, Callable[[Edge, int, int], gtsam.BetweenFactorPose2]] = {
    EdgeKind.INTER_VERTEX: inter_vertex_factor,
    EdgeKind.COVARIANCE_INTERSECTION: covariance_intersection_factor,
    EdgeKind.LOOP: loop_factor,
}


def factor_of(edge: Edge, tail: int, head: int) -> gtsam.BetweenFactorPose2:
    """The GTSAM factor of ``edge`` between the variables ``tail`` and ``head``."""
    return _FACTORS[edge.kind](edge, tail, head)


__all__ = [
    "ROOT_COVARIANCE",
    "Edge",
    "EdgeId",
    "EdgeKind",
    "FactorError",
    "Sighting",
    "UncertainPose",
    "VertexId",
    "adjoint_transport",
    "check_covariance",
    "check_pose",
    "compose",
    "covariance_intersection_factor",
    "factor_of",
    "has_kernel",
    "inter_vertex_factor",
    "intersect",
    "inverse",
    "loop_factor",
    "particle_estimate",
    "prior_factor",
    "without_kernel",
]
