"""What a robot knows and tells the others: five kinds of records, each versioned, valid by construction.

A record has one writer, the robot its key names, who alone makes new versions of it; nothing authenticates that.
Times are team times, seconds.
"""

import math
import reprlib
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, NamedTuple

import gtsam
import numpy as np
import numpy.typing as npt

from factors import Edge, EdgeKind, FactorError, UncertainPose, VertexId, check_covariance, check_pose
from factors.sighting import Sighting
from frontend.local_map import Grid
from frontend.records import FloatArray
from mrtm.errors import MrtmError

LONGEST_NAME = 64
LARGEST_NUMBER = 2**31 - 1
FARTHEST = 1e6
"""Metres; no coordinate of a building lies beyond."""
LATEST = 1e12
"""Seconds, either way."""
LARGEST_GRID = 4000
"""Cells along one side."""
MOST_POINTS = 2**20
"""Occupied cells of a grid, points of a cloud."""
FINEST, COARSEST = 0.001, 10.0
"""Metres a cell."""
TOLD_EDGES = (EdgeKind.INTER_VERTEX, EdgeKind.COVARIANCE_INTERSECTION, EdgeKind.LOOP)
"""What a robot's own front end finds; packed by their place here. Edges between robots are not told: whoever has the
sightings derives them."""


class RecordError(MrtmError):
    """A record that does not check: which, which field, the value, and what it must be."""


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
        _check_count(self.scans, _what(self), "scans")

    @property
    def key(self) -> Key:
        """(vertex, robot, index)."""
        return Key(self.kind, self.id.robot, self.id.index)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeRecord:
    """A version of an edge of TOLD_EDGES, and when it was made."""

    kind: ClassVar[Kind] = Kind.EDGE
    edge: Edge
    time: float

    def __post_init__(self) -> None:
        _check_header(self)
        what = _what(self)
        _check(self.edge.kind in TOLD_EDGES, what, "kind", self.edge.kind, f"one of {', '.join(TOLD_EDGES)}")
        _check_vertex(self.edge.tail, what, "tail")
        _check_vertex(self.edge.head, what, "head")
        _check_pose(self.edge.measurement, what, "measurement")

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
    """

    kind: ClassVar[Kind] = Kind.MAP
    vertex: VertexId
    version: int
    time: float
    grid: Grid
    cloud: FloatArray
    normals: FloatArray

    def __post_init__(self) -> None:
        _check_header(self)
        what, grid = _what(self), self.grid
        check_frame(what, grid.log_odds.shape, grid.resolution, grid.origin)
        _check_array(grid.log_odds, grid.log_odds.shape, np.float32, what, "log_odds")
        shape = (len(self.cloud), 2)
        _check(len(self.cloud) <= MOST_POINTS, what, "number of points", len(self.cloud), f"at most {MOST_POINTS}")
        _check_array(self.cloud, shape, np.float64, what, "cloud")
        _check_array(self.normals, shape, np.float64, what, "normals")
        squared = (self.normals**2).sum(axis=1)
        odd = squared[(np.abs(squared - 1.0) > 1e-4) & (squared != 0.0)]
        if len(odd):
            _check(False, what, "length of a normal", math.sqrt(odd[0]), "1, or 0 if unknown")

    @property
    def key(self) -> Key:
        """(map, robot, index of the vertex)."""
        return Key(self.kind, self.vertex.robot, self.vertex.index)


@dataclass(frozen=True, slots=True, eq=False)
class AnchorRecord:
    """Where a robot was at a moment that matters to others: the end of a sighting.

    Attributes:
        version: 0 is provisional; from 1 on the map has been closed and the pose refined.
        vertex: in whose frame; versions may differ in it.
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
        _check_vertex(self.vertex, what, "vertex")
        pose, covariance = self.pose
        _check_pose(pose, what, "pose")
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
        version: 0: what was seen does not change.
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
        _check(self.observed != self.observer, what, "observed", self.observed, "another robot than the observer")
        for field, robot in (("observer", self.observer), ("observed", self.observed)):
            owner, number = getattr(self, f"{field}_anchor")
            _check(owner == robot, what, f"{field}_anchor", owner, f"one of {robot}")
            _check_count(number, what, f"{field}_anchor")
        _check(self.measurement.range <= FARTHEST, what, "range", self.measurement.range, f"at most {FARTHEST:g} m")

    @property
    def key(self) -> Key:
        """(sighting, observer, number)."""
        return Key(self.kind, self.observer, self.number)


Record = VertexRecord | EdgeRecord | MapRecord | AnchorRecord | SightingRecord


def check_name(name: Any, what: str, field: str) -> None:
    """Refuse a robot's name that is not fit for a file name on every system."""
    fit = (
        isinstance(name, str)
        and 0 < len(name) <= LONGEST_NAME
        and name.isprintable()
        and not set(name) & set('/\\:*?"<>|')
        and name == name.strip(" .")
    )
    _check(fit, what, field, name, f"a name of at most {LONGEST_NAME} letters, digits or - _ .")


def check_frame(what: str, shape: tuple[int, ...], resolution: float, origin: npt.ArrayLike) -> None:
    """Refuse a grid whose shape, resolution (metres) or origin (metres) is out of bounds."""
    sides = f"two sides of 1 to {LARGEST_GRID} cells"
    _check(len(shape) == 2 and all(1 <= side <= LARGEST_GRID for side in shape), what, "shape", shape, sides)
    _check(FINEST <= resolution <= COARSEST, what, "resolution", resolution, f"{FINEST:g} to {COARSEST:g} m")
    _check_array(np.asarray(origin), (2,), np.float64, what, "origin")


def _what(record: Record) -> str:
    return f"{record.key} version {reprlib.repr(record.version)}"


def _check(good: bool, what: str, field: str, value: Any, must: str) -> None:
    if not good:
        text = value if isinstance(value, str) and value.isprintable() and len(value) < 100 else reprlib.repr(value)
        raise RecordError(f"{what}: {field} is {text}; must be {must}")


def _check_header(record: Record) -> None:
    what = _what(record)
    check_name(record.key.robot, what, "robot")
    _check_count(record.key.number, what, "number")
    _check_count(record.version, what, "version")
    _check_real(record.time, LATEST, what, "time")


def _check_count(value: Any, what: str, field: str) -> None:
    good = type(value) is int and 0 <= value <= LARGEST_NUMBER
    _check(good, what, field, value, f"a whole number from 0 to {LARGEST_NUMBER}")


def _check_real(value: Any, limit: float, what: str, field: str) -> None:
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= limit  # false for NaN
    _check(good, what, field, value, f"a number within plus and minus {limit:g}")


def _check_vertex(vertex: VertexId, what: str, field: str) -> None:
    check_name(vertex.robot, what, field)
    _check_count(vertex.index, what, field)


def _check_pose(pose: gtsam.Pose2, what: str, field: str) -> None:
    try:
        check_pose(pose, what)
    except FactorError as error:
        raise RecordError(str(error)) from error
    _check(max(abs(pose.x()), abs(pose.y())) <= FARTHEST, what, field, (pose.x(), pose.y()), f"within {FARTHEST:g} m")


def _check_array(array: npt.NDArray[Any], shape: tuple[int, ...], dtype: Any, what: str, field: str) -> None:
    good = array.shape == shape and array.dtype == dtype
    _check(good, what, field, f"{array.dtype} {array.shape}", f"{np.dtype(dtype)} {shape}")
    # A sum is finite if and only if all are, overflow aside, and needs no second array.
    bad = not np.isfinite(array.sum()) or (array.size > 0 and max(-array.min(), array.max()) > FARTHEST)
    _check(not bad, what, field, "not finite or too large", f"numbers within plus and minus {FARTHEST:g}")
