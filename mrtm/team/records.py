"""What a robot knows and tells the others: five kinds of records, each versioned, valid by construction.

A record has one writer, the robot its key names, who alone makes new versions of it; nothing authenticates that.
Times are team times, seconds.
"""

import math
import reprlib
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar, NamedTuple

import numpy as np

from factors import Edge, EdgeKind, FactorError, UncertainPose, VertexId, check_covariance
from factors.sighting import Sighting
from frontend.local_map import Bends, Grid
from frontend.records import FloatArray
from mrtm.team.checks import (
    FARTHEST,
    LATEST,
    MOST_PLACES,
    MOST_POINTS,
    SUREST,
    VAGUEST,
    RecordError,
    check,
    check_array,
    check_frame,
    check_name,
    check_position,
    check_real,
    check_vertex,
    check_whole,
)

TOLD_EDGES = (EdgeKind.INTER_VERTEX, EdgeKind.COVARIANCE_INTERSECTION, EdgeKind.LOOP)
"""What a robot's own front end finds; packed by their place here. Edges between robots are not told: whoever has the
sightings derives them."""


class Kind(StrEnum):
    """The kinds of records, topology before metric maps: in this order they travel, and by it they are packed."""

    VERTEX = "vertex"
    EDGE = "edge"
    ANCHOR = "anchor"
    SIGHTING = "sighting"
    MAP = "map"


class Key(NamedTuple):
    """What all versions of a record share. Reads "edge red:7"."""

    kind: Kind
    robot: str
    number: int

    def __str__(self) -> str:
        return f"{self.kind} {reprlib.repr(self.robot)[1:-1]}:{self.number}"


@dataclass(frozen=True, slots=True)
class VertexRecord:
    """A vertex is there, with a map made of ``scans`` scans.

    Raises:
        RecordError: if a field does not check; so for all records.
    """

    kind: ClassVar[Kind] = Kind.VERTEX
    id: VertexId
    version: int
    time: float
    scans: int

    def __post_init__(self) -> None:
        _check_header(self)
        check_whole(self.scans, _what(self), "scans")

    @property
    def key(self) -> Key:
        """(vertex, robot, index)."""
        return Key(self.kind, self.id.robot, self.id.number)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeRecord:
    """A version of an edge of TOLD_EDGES, and when it was made."""

    kind: ClassVar[Kind] = Kind.EDGE
    edge: Edge
    time: float

    def __post_init__(self) -> None:
        _check_header(self)
        what = _what(self)
        check(self.edge.kind in TOLD_EDGES, what, "kind", self.edge.kind, f"one of {', '.join(TOLD_EDGES)}")
        check_vertex(self.edge.tail, what, "tail")
        check_vertex(self.edge.head, what, "head")
        check_position(self.edge.measurement, what, "measurement")

    @property
    def key(self) -> Key:
        """(edge, robot, number)."""
        return Key(self.kind, self.edge.id.robot, self.edge.id.number)

    @property
    def version(self) -> int:
        """That of the edge."""
        return self.edge.version


@dataclass(frozen=True, slots=True, eq=False)
class MapRecord:
    """The local map of a vertex, without what only its robot needs (scans, their times and poses).

    Attributes:
        grid: in the vertex's frame, at most LARGEST_GRID cells a side. The exchange keeps of it what
            ``mrtm.team.map_codec`` says.
        cloud: (m, 2) points of surfaces, metres.
        normals: (m, 2) their unit normals, zero where none is known.
        bends: how sure the map's parts are, at MOST_PLACES places at most; travels in single precision.
    """

    kind: ClassVar[Kind] = Kind.MAP
    vertex: VertexId
    version: int
    time: float
    grid: Grid
    cloud: FloatArray
    normals: FloatArray
    bends: Bends = field(default_factory=Bends)

    def __post_init__(self) -> None:
        _check_header(self)
        what, grid = _what(self), self.grid
        check_frame(what, grid.log_odds.shape, grid.resolution, grid.origin)
        check_array(grid.log_odds, grid.log_odds.shape, np.float32, what, "log_odds")
        shape = (len(self.cloud), 2)
        check(len(self.cloud) <= MOST_POINTS, what, "number of points", len(self.cloud), f"at most {MOST_POINTS}")
        check_array(self.cloud, shape, np.float64, what, "cloud")
        check_array(self.normals, shape, np.float64, what, "normals")
        squared = (self.normals**2).sum(axis=1)
        odd = squared[(np.abs(squared - 1.0) > 1e-4) & (squared != 0.0)]
        if len(odd):
            check(False, what, "length of a normal", math.sqrt(odd[0]), "1, or 0 if unknown")
        places, covariances = self.bends.places, self.bends.covariances
        check(len(places) <= MOST_PLACES, what, "number of places", len(places), f"at most {MOST_PLACES}")
        check_array(places, (len(places), 2), np.float64, what, "places")
        check_array(covariances, (len(places), 3, 3), np.float64, what, "covariances of places")
        if len(places):
            check(
                np.array_equal(covariances, np.swapaxes(covariances, 1, 2)),
                what,
                "covariances of places",
                "lopsided",
                "symmetric",
            )
            values = np.linalg.eigvalsh(covariances)
            good = bool(np.all(values[:, 0] >= -_ROUNDED * values[:, 2]))
            check(good, what, "eigenvalues of a covariance", values[:, 0].min(), "at least 0")

    @property
    def key(self) -> Key:
        """(map, robot, index of the vertex)."""
        return Key(self.kind, self.vertex.robot, self.vertex.number)


@dataclass(frozen=True, slots=True, eq=False)
class AnchorRecord:
    """Where a robot was at a moment that matters to others: the end of a sighting.

    Attributes:
        version: 0 is provisional; from 1 on the map has been closed and the pose refined.
        vertex: of the robot, in whose frame; versions may differ in it.
        pose: vertex_T_robot with its covariance in the frame of the robot.
    """

    kind: ClassVar[Kind] = Kind.ANCHOR
    robot: str
    number: int
    version: int
    time: float
    vertex: VertexId
    pose: UncertainPose

    def __post_init__(self) -> None:
        _check_header(self)
        what = _what(self)
        check_vertex(self.vertex, what, "vertex")
        check(self.vertex.robot == self.robot, what, "vertex", str(self.vertex), f"one of {self.robot}")
        pose, covariance = self.pose
        check_position(pose, what, "pose")
        try:
            object.__setattr__(self, "pose", UncertainPose(pose, check_covariance(covariance, what)))
        except FactorError as error:
            raise RecordError(str(error)) from error

    @property
    def key(self) -> Key:
        """(anchor, robot, number)."""
        return Key(self.kind, self.robot, self.number)


@dataclass(frozen=True, slots=True)
class SightingRecord:
    """A robot saw another; where both were is in their anchors.

    Attributes:
        version: 0, as what was seen does not change.
        observer_anchor, observed_anchor: (robot, number) of an anchor of the observer, of the observed.
    """

    kind: ClassVar[Kind] = Kind.SIGHTING
    observer: str
    number: int
    version: int
    time: float
    observed: str
    measurement: Sighting
    observer_anchor: tuple[str, int]
    observed_anchor: tuple[str, int]

    def __post_init__(self) -> None:
        _check_header(self)
        what = _what(self)
        check_name(self.observed, what, "observed")
        check(self.observed != self.observer, what, "observed", self.observed, "another robot than the observer")
        for name, robot in (("observer", self.observer), ("observed", self.observed)):
            owner, number = getattr(self, f"{name}_anchor")
            check(owner == robot, what, f"{name}_anchor", owner, f"one of {robot}")
            check_whole(number, what, f"{name}_anchor")
        m = self.measurement
        check(m.range <= FARTHEST, what, "range", m.range, f"at most {FARTHEST:g} m")
        for name, sigma in (("range", m.sigma_range), ("bearing", m.sigma_bearing), ("heading", m.sigma_heading)):
            good = sigma is None or SUREST <= sigma <= VAGUEST
            check(good, what, f"sigma_{name}", sigma, f"from {SUREST:g} to {VAGUEST:g}")

    @property
    def key(self) -> Key:
        """(sighting, observer, number)."""
        return Key(self.kind, self.observer, self.number)


_ROUNDED = 1e-6  # of a covariance in single precision

Record = VertexRecord | EdgeRecord | MapRecord | AnchorRecord | SightingRecord


def _check_header(record: Record) -> None:
    what = _what(record)
    check_name(record.key.robot, what, "robot")
    check_whole(record.key.number, what, "number")
    check_whole(record.version, what, "version")
    check_real(record.time, LATEST, what, "time")


def _what(record: Record) -> str:
    return f"{record.key} version {reprlib.repr(record.version)}"
