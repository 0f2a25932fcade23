"""Records are valid by construction: every field is refused by name when it does not check."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from factors import EdgeKind, UncertainPose, VertexId
from factors.sighting import Sighting
from frontend.local_map import Bends, Grid
from mrtm.team import records, session_file
from mrtm.team.checks import RecordError, check_name
from mrtm.team.records import (
    AnchorRecord,
    EdgeRecord,
    Key,
    Kind,
    MapRecord,
    SightingRecord,
    VertexRecord,
)
from tests.mrtm.record_examples import COVARIANCE, record_of


@pytest.mark.parametrize("kind", Kind)
def test_a_key_names_kind_writer_and_number(kind: Kind) -> None:
    record = record_of(kind, "blue", 7, 2)
    assert record.key == Key(kind, "blue", 7)
    assert record.version == 2
    assert str(record.key) == f"{kind} blue:7"


def vertex(**changes: Any) -> None:
    record = record_of(Kind.VERTEX)
    assert isinstance(record, VertexRecord)
    replace(record, **changes)


def edge(**changes: Any) -> None:
    record = record_of(Kind.EDGE)
    assert isinstance(record, EdgeRecord)
    EdgeRecord(replace(record.edge, **changes), record.time)


def anchor(**changes: Any) -> None:
    record = record_of(Kind.ANCHOR)
    assert isinstance(record, AnchorRecord)
    replace(record, **changes)


def sighting(**changes: Any) -> None:
    record = record_of(Kind.SIGHTING)
    assert isinstance(record, SightingRecord)
    replace(record, **changes)


def local_map(**changes: Any) -> None:
    record = record_of(Kind.MAP)
    assert isinstance(record, MapRecord)
    replace(record, **changes)


def grid(
    shape: tuple[int, ...] = (2, 2), resolution: float = 0.05, value: float = 1.0, dtype: Any = np.float32
) -> Grid:
    return Grid(np.full(shape, value, dtype), resolution, np.zeros(2))


POINT = np.array([[1.0, 2.0]])

BAD: list[tuple[Callable[..., None], dict[str, Any], str]] = [
    (vertex, {"version": -1}, "version"),
    (vertex, {"version": True}, "version"),
    (vertex, {"version": 2**31}, "version"),
    (vertex, {"version": np.int64(1)}, "version"),
    (vertex, {"time": math.nan}, "time"),
    (vertex, {"time": math.inf}, "time"),
    (vertex, {"time": "12"}, "time"),
    (vertex, {"scans": -3}, "scans"),
    (vertex, {"scans": 2.0}, "scans"),
    (vertex, {"id": VertexId("red", -1)}, "number"),
    (vertex, {"id": VertexId("../etc", 1)}, "robot"),
    (vertex, {"id": VertexId("", 1)}, "robot"),
    (edge, {"kind": EdgeKind.FUSING}, "kind"),
    (edge, {"measurement": gtsam.Pose2(1e7, 0.0, 0.0)}, "measurement"),
    (edge, {"head": VertexId("a/b", 1)}, "head"),
    (edge, {"tail": VertexId("red", 2**40)}, "tail"),
    (anchor, {"pose": UncertainPose(gtsam.Pose2(math.nan, 0.0, 0.0), COVARIANCE)}, "pose"),
    (anchor, {"pose": UncertainPose(gtsam.Pose2(0.0, -1e9, 0.0), COVARIANCE)}, "pose"),
    (anchor, {"pose": UncertainPose(gtsam.Pose2(), -COVARIANCE)}, "covariance"),
    (anchor, {"pose": UncertainPose(gtsam.Pose2(), COVARIANCE[:2])}, "covariance"),
    (anchor, {"vertex": VertexId("red", -4)}, "vertex"),
    (anchor, {"vertex": VertexId("blue", 2)}, "vertex"),
    (sighting, {"observed": "red"}, "observed"),
    (sighting, {"observed": "no\nname"}, "observed"),
    (sighting, {"observer_anchor": ("blue", 3)}, "observer_anchor"),
    (sighting, {"observed_anchor": ("red", 3)}, "observed_anchor"),
    (sighting, {"observed_anchor": ("grey", -3)}, "observed_anchor"),
    (sighting, {"measurement": Sighting(1e9, 0.0, None, 0.1, 0.1, None)}, "range"),
    (sighting, {"measurement": Sighting(1.0, 0.0, 0.0, 1e155, 0.1, 0.1)}, "sigma_range"),
    (sighting, {"measurement": Sighting(1.0, 0.0, 0.0, 0.1, 1e-155, 0.1)}, "sigma_bearing"),
    (sighting, {"measurement": Sighting(1.0, 0.0, 0.0, 0.1, 0.1, 1e155)}, "sigma_heading"),
    (local_map, {"grid": grid((4, 4001))}, "shape"),
    (local_map, {"grid": grid((0, 4))}, "shape"),
    (local_map, {"grid": grid((4,))}, "shape"),
    (local_map, {"grid": grid(resolution=0.0)}, "resolution"),
    (local_map, {"grid": grid(resolution=math.nan)}, "resolution"),
    (local_map, {"grid": grid(value=math.nan)}, "log_odds"),
    (local_map, {"grid": grid(value=math.inf)}, "log_odds"),
    (local_map, {"grid": grid(dtype=np.float64)}, "log_odds"),
    (local_map, {"grid": replace(grid(), origin=np.array([0.0, math.nan]))}, "origin"),
    (local_map, {"grid": replace(grid(), origin=np.zeros(3))}, "origin"),
    (local_map, {"cloud": np.zeros((1, 3))}, "cloud"),
    (local_map, {"cloud": np.array([[math.nan, 0.0]])}, "cloud"),
    (local_map, {"cloud": np.array([[2e6, 0.0]])}, "cloud"),
    (local_map, {"normals": np.zeros((2, 2))}, "normals"),
    (local_map, {"normals": np.array([[0.5, 0.0]])}, "normal"),
    (local_map, {"bends": Bends(np.zeros((65, 2)), np.zeros((65, 3, 3)))}, "number of places"),
    (local_map, {"bends": Bends(np.zeros((1, 3)), COVARIANCE[None])}, "places"),
    (local_map, {"bends": Bends(np.full((1, 2), math.nan), COVARIANCE[None])}, "places"),
    (local_map, {"bends": Bends(np.zeros((2, 2)), COVARIANCE[None])}, "covariances of places"),
    (local_map, {"bends": Bends(np.zeros((1, 2)), np.full((1, 3, 3), math.inf))}, "covariances of places"),
    (local_map, {"bends": Bends(np.zeros((1, 2)), np.triu(np.ones((1, 3, 3))))}, "symmetric"),
    (local_map, {"bends": Bends(np.zeros((1, 2)), -COVARIANCE[None])}, "eigenvalues"),
]


@pytest.mark.parametrize(("make", "changes", "field"), BAD)
def test_a_bad_field_is_refused_by_name(make: Callable[..., None], changes: dict[str, Any], field: str) -> None:
    make()
    with pytest.raises(RecordError, match=rf"(?s)(red|etc|edge|vertex) ?.*\b{field}\b"):
        make(**changes)


def test_a_cloud_of_too_many_points_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(records, "MOST_POINTS", 2)
    local_map(cloud=np.repeat(POINT, 2, axis=0), normals=np.zeros((2, 2)))
    with pytest.raises(RecordError, match="number of points is 3"):
        local_map(cloud=np.repeat(POINT, 3, axis=0), normals=np.zeros((3, 2)))


def test_an_error_is_one_short_line() -> None:
    with pytest.raises(RecordError) as error:
        vertex(id=VertexId("a\nb" * 5000, 1))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300


def test_a_covariance_is_kept_as_a_copy_nobody_can_change() -> None:
    covariance = COVARIANCE.copy()
    record = AnchorRecord("red", 1, 0, 1.0, VertexId("red", 0), UncertainPose(gtsam.Pose2(), covariance))
    covariance[0, 0] = -1.0
    np.testing.assert_array_equal(record.pose.covariance, COVARIANCE)
    with pytest.raises(ValueError, match="read-only"):
        record.pose.covariance[0, 0] = -1.0


@given(st.text(max_size=70) | st.text("ab./ \\-_", max_size=5))
@example("a" * 64)
@example("a" * 65)
@example("\N{ROBOT FACE}" * 17)
@example("ein Roboter 2")
def test_names_are_those_of_a_session(name: str) -> None:
    def fits(check: Callable[[str], object]) -> bool:
        try:
            check(name)
        except (ValueError, RecordError):
            return False
        return True

    assert fits(lambda n: check_name(n, "test", "name")) == fits(session_file._file_name)
    assert not fits(session_file._file_name) or len(name.encode()) <= 64
