"""Records to bytes and back (msgpack): a flat row of fields, numbers as they are, a map as ``map_codec`` packs it.

Bytes come from others: every field is checked, and nothing is made that the bounds of ``records`` do not allow.
"""

import reprlib
import struct
from typing import Any

import gtsam
import msgpack
import numpy as np

from factors import Edge, EdgeId, FactorError, UncertainPose, VertexId
from factors.sighting import Sighting
from frontend.local_map import Bends
from frontend.records import FloatArray
from mrtm.team.checks import MOST_PLACES, RecordError
from mrtm.team.map_codec import PackedMap, pack_map, unpack_map
from mrtm.team.records import (
    TOLD_EDGES,
    AnchorRecord,
    EdgeRecord,
    Kind,
    MapRecord,
    Record,
    SightingRecord,
    VertexRecord,
)

LARGEST_RECORD = 2**20 - 2**10
"""Bytes; a map of a kilometre's walls stays far below."""

KINDS = tuple(Kind)
"""A kind's place here stands for it in a row."""

_LONGEST_ROW = 16
_UPPER = np.triu_indices(3)
_POSE = struct.Struct("<9d")
_BENDS, _BEND = np.dtype("<f4"), 8 * 4  # of each place x, y, and the upper half of its covariance
_SIGHTING, _SIGHTING_WITHOUT_HEADING = struct.Struct("<6d"), struct.Struct("<4d")


def pack(record: Record) -> bytes:
    """The record's bytes.

    Raises:
        RecordError: if they are more than LARGEST_RECORD.
    """
    robot = record.key.robot
    header = [KINDS.index(record.kind), robot, record.key.number, record.version, float(record.time)]
    data: bytes = msgpack.packb(header + _body(record, robot))
    if len(data) > LARGEST_RECORD:
        raise RecordError(f"{record.key}: {len(data)} bytes packed; must be at most {LARGEST_RECORD}")
    return data


def unpack(data: bytes) -> Record:
    """The record that ``pack`` packed, as all who have these bytes see it.

    Raises:
        RecordError: naming the record and the field, if the bytes are not those of a valid record.
    """
    if len(data) > LARGEST_RECORD:
        raise RecordError(f"record of {len(data)} bytes; must be at most {LARGEST_RECORD}")
    try:
        row = _Row(msgpack.unpackb(data, max_array_len=_LONGEST_ROW))
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise RecordError(f"record is not msgpack: {error}") from error
    try:
        record = _record(row)
    except FactorError as error:
        raise RecordError(f"{row.what}: {error}") from error
    row.end()
    return record


def _body(record: Record, robot: str) -> list[Any]:
    match record:
        case VertexRecord():
            return [record.scans]
        case EdgeRecord(edge=edge):
            ends = [_pack_vertex(edge.tail, robot), _pack_vertex(edge.head, robot)]
            return [TOLD_EDGES.index(edge.kind), *ends, _pack_pose(edge.measurement, edge.covariance)]
        case AnchorRecord():
            return [_pack_vertex(record.vertex, robot), _pack_pose(*record.pose)]
        case SightingRecord():
            anchors = [record.observer_anchor[1], record.observed_anchor[1]]
            return [record.observed, *anchors, _pack_sighting(record.measurement)]
        case MapRecord():
            return [*pack_map(record.grid, record.cloud, record.normals), _pack_bends(record.bends)]


def _record(row: "_Row") -> Record:
    kind = KINDS[row.index("kind", len(KINDS))]
    row.what = f"{kind} record"
    robot, number, version, time = row.text("robot"), row.count("number"), row.count("version"), row.real("time")
    row.what = f"{kind} {reprlib.repr(robot)[1:-1]}:{number} version {version}"
    match kind:
        case Kind.VERTEX:
            return VertexRecord(VertexId(robot, number), version, time, row.count("scans"))
        case Kind.EDGE:
            edge_kind = TOLD_EDGES[row.index("edge kind", len(TOLD_EDGES))]
            tail, head = row.vertex("tail", robot), row.vertex("head", robot)
            edge = Edge(EdgeId(robot, number), version, edge_kind, tail, head, *row.pose("measurement"))
            return EdgeRecord(edge, time)
        case Kind.ANCHOR:
            vertex = row.vertex("vertex", robot)
            return AnchorRecord(robot, number, version, time, vertex, row.pose("pose"))
        case Kind.SIGHTING:
            observed = row.text("observed")
            mine, theirs = row.count("observer_anchor"), row.count("observed_anchor")
            measurement = _unpack_sighting(row.data("measurement", _SIGHTING.size, _SIGHTING_WITHOUT_HEADING.size))
            anchors = (robot, mine), (observed, theirs)
            return SightingRecord(robot, number, version, time, observed, measurement, *anchors)
        case Kind.MAP:
            sides = row.count("height"), row.count("width")
            frame = row.real("resolution"), row.real("origin x"), row.real("origin y")
            columns = [row.data(name) for name in PackedMap._fields[5:]]
            grid, cloud, normals = unpack_map(PackedMap(*sides, *frame, *columns), row.what)
            return MapRecord(VertexId(robot, number), version, time, grid, cloud, normals, row.bends("bends"))


def _pack_vertex(vertex: VertexId, robot: str) -> int | list[Any]:
    """Its index alone if it is the writer's own."""
    return vertex.number if vertex.robot == robot else [vertex.robot, vertex.number]


def _pack_pose(pose: gtsam.Pose2, covariance: FloatArray) -> bytes:
    return _POSE.pack(pose.x(), pose.y(), pose.theta(), *covariance[_UPPER])


def _pack_bends(bends: Bends) -> bytes:
    rows, columns = _UPPER
    upper = bends.covariances[:, rows, columns]
    return np.column_stack([bends.places, upper]).astype(_BENDS).tobytes()


def _pack_sighting(sighting: Sighting) -> bytes:
    near = sighting.range, sighting.bearing, sighting.sigma_range, sighting.sigma_bearing
    if sighting.heading is None:
        return _SIGHTING_WITHOUT_HEADING.pack(*near)
    return _SIGHTING.pack(*near, sighting.heading, sighting.sigma_heading)


def _unpack_sighting(data: bytes) -> Sighting:
    form = _SIGHTING if len(data) == _SIGHTING.size else _SIGHTING_WITHOUT_HEADING
    distance, bearing, sigma_range, sigma_bearing, *rest = form.unpack(data)
    heading, sigma_heading = rest if rest else (None, None)
    return Sighting(distance, bearing, heading, sigma_range, sigma_bearing, sigma_heading)


class _Row:
    """Hands out the fields of a row in order, each of the type that is asked for; ``what`` is named in errors."""

    def __init__(self, content: Any) -> None:
        self.what = "record"
        if not isinstance(content, list):
            raise RecordError(f"record is {reprlib.repr(content)}; must be a list of fields")
        self._fields = content
        self._next = 0

    def count(self, name: str) -> int:
        value = self._take(name)
        if type(value) is int:
            return value
        raise self._refused(name, value, "a whole number")

    def index(self, name: str, size: int) -> int:
        value = self.count(name)
        if 0 <= value < size:
            return value
        raise self._refused(name, value, f"below {size}")

    def real(self, name: str) -> float:
        value = self._take(name)
        if type(value) is float:
            return value
        raise self._refused(name, value, "a number")

    def text(self, name: str) -> str:
        value = self._take(name)
        if type(value) is str:
            return value
        raise self._refused(name, value, "text")

    def data(self, name: str, *sizes: int) -> bytes:
        value = self._take(name)
        if type(value) is bytes and (not sizes or len(value) in sizes):
            return value
        raise self._refused(name, value, f"{' or '.join(map(str, sizes)) or 'some'} bytes")

    def vertex(self, name: str, robot: str) -> VertexId:
        match self._take(name):
            case int(index):
                return VertexId(robot, index)
            case [str(other), int(index)]:
                return VertexId(other, index)
            case value:
                raise self._refused(name, value, "an index, or robot and index")

    def pose(self, name: str) -> UncertainPose:
        x, y, theta, *upper = _POSE.unpack(self.data(name, _POSE.size))
        covariance = np.empty((3, 3))
        covariance[_UPPER] = upper
        covariance.T[_UPPER] = upper
        return UncertainPose(gtsam.Pose2(x, y, theta), covariance)

    def bends(self, name: str) -> Bends:
        data = self.data(name)
        if len(data) % _BEND or len(data) > MOST_PLACES * _BEND:
            raise self._refused(name, data, f"at most {MOST_PLACES} places of {_BEND} bytes")
        numbers = np.frombuffer(data, _BENDS).astype(np.float64).reshape(-1, 8)
        (rows, columns), covariances = _UPPER, np.empty((len(numbers), 3, 3))
        covariances[:, rows, columns] = covariances[:, columns, rows] = numbers[:, 2:]
        return Bends(numbers[:, :2], covariances)

    def end(self) -> None:
        if self._next != len(self._fields):
            raise RecordError(f"{self.what}: has {len(self._fields)} fields; must be {self._next}")

    def _take(self, name: str) -> Any:
        if self._next == len(self._fields):
            raise RecordError(f"{self.what}: {name} is missing")
        self._next += 1
        return self._fields[self._next - 1]

    def _refused(self, name: str, value: Any, must: str) -> RecordError:
        return RecordError(f"{self.what}: {name} is {reprlib.repr(value)}; must be {must}")
