import json

import gtsam
import numpy as np
import pytest

from factors import Edge, EdgeId, EdgeKind, FactorError, VertexId

A, B = VertexId("red", 3), VertexId("red", 10)


def make(pose: gtsam.Pose2 | None = None, covariance: object = None, head: VertexId = B, version: int = 0) -> Edge:
    matrix = np.diag([0.01, 0.02, 0.003]) if covariance is None else np.asarray(covariance, dtype=np.float64)
    return Edge(EdgeId("red", 7), version, EdgeKind.LOOP, A, head, pose or gtsam.Pose2(1.0, 2.0, 3.0), matrix)


def test_names_read_well_and_order_by_number() -> None:
    assert str(make()) == "edge red#7 version 0 (loop red:3 -> red:10)"
    assert sorted([B, A]) == [A, B]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_refuses_a_measurement_that_is_not_finite(place: int, value: float) -> None:
    coordinates = [1.0, 2.0, 3.0]
    coordinates[place] = value
    with pytest.raises(FactorError, match=r"edge red#7 version 0 .*pose is not finite"):
        make(gtsam.Pose2(*coordinates))


@pytest.mark.parametrize(
    ("covariance", "why"),
    [
        (np.diag([1.0, np.nan, 1.0]), "not finite"),
        (np.diag([1.0, np.inf, 1.0]), "not finite"),
        (np.diag([1.0, 0.0, 1.0]), "not positive definite"),
        (np.diag([1.0, -0.1, 1.0]), "not positive definite"),
        (np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), "not positive definite"),
        (np.array([[1.0, 0.5, 0.0], [0.4, 1.0, 0.0], [0.0, 0.0, 1.0]]), "not symmetric"),
        (np.eye(2), "shape"),
        (np.ones(3), "shape"),
        (np.diag([1e-20, 1e-20, 1e-20]), "out of bounds"),
        (np.diag([1e12, 1e12, 1e12]), "out of bounds"),
        (np.diag([1e9, 1e-9, 1.0]), "not positive definite"),
    ],
)
def test_refuses_a_bad_covariance(covariance: object, why: str) -> None:
    with pytest.raises(FactorError, match=f"edge red#7 version 0 .*{why}"):
        make(covariance=covariance)


def test_refuses_a_vertex_joined_to_itself_and_a_negative_version() -> None:
    with pytest.raises(FactorError, match="same vertex"):
        make(head=A)
    with pytest.raises(FactorError, match="version -1"):
        make(version=-1)


def test_keeps_its_own_covariance() -> None:
    matrix = np.diag([0.01, 0.02, 0.003])
    edge = make(covariance=matrix)
    matrix[0, 0] = -1.0
    assert edge.covariance[0, 0] == 0.01
    with pytest.raises(ValueError, match="read-only"):
        edge.covariance[0, 0] = 2.0


def test_survives_json() -> None:
    edge = make(gtsam.Pose2(1 / 3, -2 / 7, np.pi / 5), np.diag([1 / 3, 1 / 7, 1 / 11]) + 0.01)
    back = Edge.from_dict(json.loads(json.dumps(edge.to_dict())))
    assert (back.id, back.version, back.kind) == (edge.id, edge.version, edge.kind)
    assert (back.tail, back.head) == (edge.tail, edge.head)
    assert back.measurement.equals(edge.measurement, 1e-14)
    np.testing.assert_array_equal(back.covariance, edge.covariance)


@pytest.mark.parametrize("change", [{"kind": "teleport"}, {"measurement": [1.0]}, {"tail": None}])
def test_refuses_data_that_are_not_an_edge(change: dict[str, object]) -> None:
    with pytest.raises(FactorError, match="not an edge"):
        Edge.from_dict(make().to_dict() | change)
