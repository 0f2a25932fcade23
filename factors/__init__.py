"""Every edge of the joint graph, one module a type, each folded into a native GTSAM factor where there is one."""

from collections.abc import Callable
from typing import Any

import gtsam

from factors.alignment import alignment_factor
from factors.covariance_intersection import covariance_intersection_factor, intersect
from factors.edge import Edge, EdgeId, EdgeKind, GraphEdge, VertexId
from factors.errors import FactorError
from factors.fusing import fuse_sightings, fusing_edge, fusing_factor
from factors.inter_vertex import inter_vertex_factor
from factors.loop import loop_factor
from factors.noise import (
    FULL_WEIGHT,
    UncertainPose,
    adjoint_transport,
    check_covariance,
    check_pose,
    compose,
    has_kernel,
    inverse,
    squared_mahalanobis,
    weighed,
    weight,
    without_kernel,
)
from factors.prior import ROOT_COVARIANCE, prior_factor
from factors.sighting import AnchoredSighting, Sighting, SightingEdge, sighting_factor

# The kind of an edge decides its class, so each builder meets only the class it takes.
_FACTORS: dict[EdgeKind, Callable[[Any, int, int], gtsam.NoiseModelFactor]] = {
    EdgeKind.INTER_VERTEX: inter_vertex_factor,
    EdgeKind.COVARIANCE_INTERSECTION: covariance_intersection_factor,
    EdgeKind.LOOP: loop_factor,
    EdgeKind.FUSING: fusing_factor,
    EdgeKind.SIGHTING: sighting_factor,
    EdgeKind.ALIGNMENT: alignment_factor,
}


def factor_of(edge: GraphEdge, tail: int, head: int) -> gtsam.NoiseModelFactor:
    """The GTSAM factor of ``edge`` between the variables ``tail`` and ``head``."""
    return _FACTORS[edge.kind](edge, tail, head)


def edge_from_dict(data: dict[str, Any]) -> GraphEdge:
    """The edge that its ``to_dict`` wrote; FactorError if the data are not those of a valid edge."""
    sighting = isinstance(data, dict) and data.get("kind") == EdgeKind.SIGHTING
    return SightingEdge.from_dict(data) if sighting else Edge.from_dict(data)


__all__ = [
    "FULL_WEIGHT",
    "ROOT_COVARIANCE",
    "AnchoredSighting",
    "Edge",
    "EdgeId",
    "EdgeKind",
    "FactorError",
    "GraphEdge",
    "Sighting",
    "SightingEdge",
    "UncertainPose",
    "VertexId",
    "adjoint_transport",
    "alignment_factor",
    "check_covariance",
    "check_pose",
    "compose",
    "covariance_intersection_factor",
    "edge_from_dict",
    "factor_of",
    "fuse_sightings",
    "fusing_edge",
    "fusing_factor",
    "has_kernel",
    "inter_vertex_factor",
    "intersect",
    "inverse",
    "loop_factor",
    "prior_factor",
    "sighting_factor",
    "squared_mahalanobis",
    "weighed",
    "weight",
    "without_kernel",
]
