"""Records to bytes and back; bytes of others, whatever they are."""

from dataclasses import replace
from typing import Any

import gtsam
import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors import VertexId
from frontend.local_map import Bends
from mrtm.team import codec
from mrtm.team.checks import RecordError
from mrtm.team.codec import pack, unpack
from mrtm.team.records import AnchorRecord, EdgeRecord, Kind, MapRecord, SightingRecord, VertexRecord
from tests.mrtm.record_examples import record_of, room_map

SMALL = [Kind.VERTEX, Kind.EDGE, Kind.ANCHOR, Kind.SIGHTING]


def same_pose(a: gtsam.Pose2, b: gtsam.Pose2) -> bool:
    return (a.x(), a.y()) == (b.x(), b.y()) and abs(a.theta() - b.theta()) < 1e-15


@pytest.mark.parametrize("kind", SMALL)
@pytest.mark.parametrize("number", [0, 3, 2**31 - 1])
def test_small_records_come_back_exactly_in_less_than_120_bytes(kind: Kind, number: int) -> None:
    record = record_of(kind, "longnamed", number - 1 if number > 3 else number, version=5)
    data = pack(record)
    assert len(data) < 120
    again = unpack(data)
    assert type(again) is type(record)
    assert (again.key, again.version, again.time) == (record.key, record.version, record.time)
    match record, again:
        case VertexRecord(), VertexRecord():
            assert again == record
        case SightingRecord(), SightingRecord():
            assert again == record
        case EdgeRecord(edge=a), EdgeRecord(edge=b):
            assert (a.id, a.version, a.kind, a.tail, a.head) == (b.id, b.version, b.kind, b.tail, b.head)
            assert same_pose(a.measurement, b.measurement)
            np.testing.assert_array_equal(a.covariance, b.covariance)
        case AnchorRecord(), AnchorRecord():
            assert again.vertex == record.vertex
            assert same_pose(record.pose.pose, again.pose.pose)
            np.testing.assert_array_equal(record.pose.covariance, again.pose.covariance)


def test_how_sure_the_parts_of_a_map_are_comes_back_in_single_precision() -> None:
    record = record_of(Kind.MAP)
    again = unpack(pack(record))
    assert isinstance(record, MapRecord)
    assert isinstance(again, MapRecord)
    np.testing.assert_allclose(again.bends.places, record.bends.places, rtol=1e-7)
    np.testing.assert_allclose(again.bends.covariances, record.bends.covariances, rtol=1e-7)
    bare = replace(record, bends=Bends())
    assert len(pack(record)) - len(pack(bare)) == 2 * 32
    assert unpack(pack(bare)).bends.places.shape == (0, 2)  # type: ignore[union-attr]


def test_places_that_are_cut_off_are_refused() -> None:
    fields = msgpack.unpackb(pack(record_of(Kind.MAP)))
    for bad in (fields[-1][:-1], fields[-1] * 40):
        with pytest.raises(RecordError, match=r"bends is .* at most 64 places of 32 bytes"):
            unpack(msgpack.packb([*fields[:-1], bad]))


def test_the_vertex_of_another_robot_keeps_its_name() -> None:
    """To be refused by name where the robot's own map is made."""
    record = record_of(Kind.EDGE)
    assert isinstance(record, EdgeRecord)
    again = unpack(pack(EdgeRecord(replace(record.edge, tail=VertexId("grün", 9)), 1.0)))
    assert isinstance(again, EdgeRecord)
    assert again.edge.tail == VertexId("grün", 9)


def test_the_same_record_has_the_same_bytes() -> None:
    for kind in Kind:
        assert pack(record_of(kind)) == pack(record_of(kind))
    assert pack(room_map()) == pack(unpack(pack(room_map())))


def test_a_record_too_large_to_travel_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    data = pack(room_map())
    monkeypatch.setattr(codec, "LARGEST_RECORD", len(data) - 1)
    for attempt in (lambda: pack(room_map()), lambda: unpack(data)):
        with pytest.raises(RecordError, match=f"{len(data)} bytes"):
            attempt()


EDGE = msgpack.unpackb(pack(record_of(Kind.EDGE)))
NAN = np.full(9, np.nan).tobytes()
FLAT = np.array([1, 2, 3, 1, 0, 0, 0, 0, 1.0]).tobytes()  # a covariance of rank 2

# Fields of an edge: kind, robot, number, version, time, edge kind, tail, head, measurement.
BAD: list[tuple[int, Any, str]] = [
    (0, 5, "kind is 5"),
    (0, -1, "kind is -1"),
    (0, True, "kind is True"),
    (0, "edge", "kind"),
    (1, b"red", "robot"),
    (1, "a/b", "robot is a/b"),
    (1, None, "robot"),
    (2, 1.0, "number is 1.0"),
    (2, -1, "number is -1"),
    (2, 2**63, "number"),
    (3, None, "version"),
    (4, 12, "time is 12"),
    (4, float("nan"), "time is nan"),
    (5, 3, "edge kind is 3"),
    (6, ["red", 1, 2], "tail"),
    (6, [1, "red"], "tail"),
    (6, 2, "tail and head are the same"),
    (7, ["", 1], "head"),
    (8, b"", "measurement"),
    (8, FLAT[:-1], "measurement"),
    (8, NAN, "edge red:3 version 0: .*pose is not finite"),
    (8, FLAT, "edge red:3 version 0: .*positive definite"),
]


@pytest.mark.parametrize(("place", "value", "complaint"), BAD)
def test_a_bad_field_is_refused_by_name(place: int, value: Any, complaint: str) -> None:
    row = list(EDGE)
    row[place] = value
    with pytest.raises(RecordError, match=complaint):
        unpack(msgpack.packb(row))


def test_fields_too_few_or_too_many_are_refused() -> None:
    for length in range(len(EDGE)):
        with pytest.raises(RecordError, match="missing"):
            unpack(msgpack.packb(EDGE[:length]))
    with pytest.raises(RecordError, match="10 fields; must be 9"):
        unpack(msgpack.packb([*EDGE, 1]))


def test_a_sighting_checks_itself() -> None:
    row = msgpack.unpackb(pack(record_of(Kind.SIGHTING)))
    row[8] = np.array([-1.0, 0.0, 0.1, 0.1]).tobytes()
    with pytest.raises(RecordError, match=r"sighting red:3 version 0: .*range -1.0 is not positive"):
        unpack(msgpack.packb(row))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x91",
        b"\xdd\xff\xff\xff\xff",
        b"\x91" * 100000,
        b"\x81\x90\x01",
        b"\xc7\x03\xff123",
        b"\x90\x90",
    ],
)
def test_what_is_not_a_row_is_refused(data: bytes) -> None:
    with pytest.raises(RecordError):
        unpack(data)


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=80),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(list(Kind)), st.data())
def test_any_field_replaced_by_anything_is_a_record_or_refused(kind: Kind, data: st.DataObject) -> None:
    row = msgpack.unpackb(pack(record_of(kind)))
    row[data.draw(st.integers(0, len(row) - 1))] = data.draw(plain)
    is_a_record_or_refused(msgpack.packb(row))


@given(st.sampled_from(list(Kind)), st.data())
def test_any_bytes_changed_are_a_record_or_refused(kind: Kind, data: st.DataObject) -> None:
    raw = bytearray(pack(record_of(kind) if kind != Kind.MAP or data.draw(st.booleans()) else room_map()))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    is_a_record_or_refused(bytes(raw[: data.draw(st.none() | st.integers(0, len(raw)))]))


def is_a_record_or_refused(raw: bytes) -> None:
    complaint, record = "", None
    try:
        record = unpack(raw)
    except RecordError as error:
        complaint = str(error)
    assert "\n" not in complaint
    assert len(complaint) < 500
    if record is not None:
        again = unpack(pack(record))
        assert (again.key, again.version, again.time) == (record.key, record.version, record.time)
