"""Edges of the topological map: plain immutable data, valid by construction."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple, Protocol

import gtsam
import numpy as np

from factors.errors import FactorError
from factors.noise import FloatArray, UncertainPose, check_covariance, check_pose


class VertexId(NamedTuple):
    """A vertex: the robot that made it and its running number, from 0. Reads "red:3"."""

    robot: str
    number: int

    def __str__(self) -> str:
        return f"{self.robot}:{self.number}"


class EdgeId(NamedTuple):
    """An edge: the robot that made it and its running number, from 0. Reads "red#7"."""

    robot: str
    number: int

    def __str__(self) -> str:
        return f"{self.robot}#{self.number}"


class EdgeKind(StrEnum):
    """What an edge came from; the kind decides the factor it becomes."""

    INTER_VERTEX = "inter_vertex"  # M7b
    COVARIANCE_INTERSECTION = "covariance_intersection"  # M5
    LOOP = "loop"  # M8
    FUSING = "fusing"  # M11
    SIGHTING = "sighting"  # Eq. 9
    ALIGNMENT = "alignment"  # M13


class GraphEdge(Protocol):
    """What the joint graph asks of an edge, whatever was measured: n numbers about tail_T_head."""

    @property
    def id(self) -> EdgeId:
        """Same for all versions."""

    @property
    def version(self) -> int:
        """From 0."""

    @property
    def kind(self) -> EdgeKind:
        """What the edge came from."""

    @property
    def tail(self) -> VertexId:
        """The vertex the measurement is seen from."""

    @property
    def head(self) -> VertexId:
        """The vertex that is seen."""

    @property
    def estimate(self) -> UncertainPose | None:
        """tail_T_head as measured; None if the edge alone does not fix it, and so cannot hold a vertex."""

    @property
    def covariance(self) -> FloatArray:
        """(n, n) of the residual."""

    def residual(self, tail_T_head: gtsam.Pose2) -> tuple[FloatArray, FloatArray]:
        """(n,) how far a pose is from the measurement, and (n, 3) its derivative by the tangent at ``head``."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, fit for JSON, with the kind under "kind"."""


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """One version of a measured transform between two vertices; a change is a new Edge with a higher version.

    Attributes:
        id: same for all versions.
        version: from 0.
        kind: may change between versions (M5 turns an inter-vertex edge into a covariance intersection);
            SIGHTING is the kind of a SightingEdge only.
        tail, head: the two vertices.
        measurement: tail_T_head, metres and radians.
        covariance: (3, 3) in the tangent frame of ``head``; kept as a read-only copy.

    Raises:
        FactorError: if the measurement is not finite, the covariance is refused by ``check_covariance``, the
            kind is that of another class, or tail and head are the same.
    """

    id: EdgeId
    version: int
    kind: EdgeKind
    tail: VertexId
    head: VertexId
    measurement: gtsam.Pose2
    covariance: FloatArray

    def __post_init__(self) -> None:
        if self.kind is EdgeKind.SIGHTING:
            raise FactorError(f"edge {self.id}: a sighting is no measured transform, it needs a SightingEdge")
        check_ends(self)
        check_pose(self.measurement, str(self))
        object.__setattr__(self, "covariance", check_covariance(self.covariance, str(self)))

    def __str__(self) -> str:
        return describe(self)

    @property
    def estimate(self) -> UncertainPose:
        """tail_T_head with its covariance in the frame of head."""
        return UncertainPose(self.measurement, self.covariance)

    def residual(self, tail_T_head: gtsam.Pose2) -> tuple[FloatArray, FloatArray]:
        """(3,) Log(measurement^-1 * tail_T_head) and its (3, 3) derivative by the tangent at ``head``."""
        offset = self.measurement.between(tail_T_head)
        return gtsam.Pose2.Logmap(offset), gtsam.Pose2.LogmapDerivative(offset)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, fit for JSON; ``from_dict`` reads them back, the angle to one part in 1e15."""
        pose = self.measurement
        return {
            "id": [self.id.robot, self.id.number],
            "version": self.version,
            "kind": str(self.kind),
            "tail": [self.tail.robot, self.tail.number],
            "head": [self.head.robot, self.head.number],
            "measurement": [pose.x(), pose.y(), pose.theta()],
            "covariance": self.covariance.tolist(),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Edge":
        """The edge that ``to_dict`` wrote.

        Raises:
            FactorError: if the data are not those of a valid edge.
        """
        try:
            return cls(
                id=EdgeId(*data["id"]),
                version=data["version"],
                kind=EdgeKind(data["kind"]),
                tail=VertexId(*data["tail"]),
                head=VertexId(*data["head"]),
                measurement=gtsam.Pose2(*data["measurement"]),
                covariance=np.array(data["covariance"], dtype=np.float64),
            )
        except FactorError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise FactorError(f"not an edge: {error!r} in {data!r}") from error


def describe(edge: GraphEdge) -> str:
    """The edge in messages: id, version, kind and ends."""
    return f"edge {edge.id} version {edge.version} ({edge.kind} {edge.tail} -> {edge.head})"


def check_ends(edge: GraphEdge) -> None:
    """Raise FactorError if the version is negative or the ends are one vertex."""
    if edge.version < 0:
        raise FactorError(f"edge {edge.id}: version {edge.version} is negative")
    if edge.tail == edge.head:
        raise FactorError(f"{describe(edge)}: tail and head are the same vertex")
