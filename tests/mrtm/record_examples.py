"""Records for tests: one of each kind, at will; and local maps drawn of simulated scans."""

from functools import cache

import gtsam
import numpy as np
import numpy.typing as npt

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId
from factors.sighting import Sighting
from frontend.local_map import Bends, Grid, contents
from mrtm.team.records import (
    AnchorRecord,
    EdgeRecord,
    Kind,
    MapRecord,
    Record,
    SightingRecord,
    VertexRecord,
)
from tests.frontend.simulated import room

ROBOTS = ("amber", "blue", "coral", "dun", "ecru")

COVARIANCE = np.array([[4e-4, 1e-5, 2e-6], [1e-5, 9e-4, -3e-6], [2e-6, -3e-6, 1e-5]])


def record_of(kind: Kind, robot: str = "red", number: int = 3, version: int = 0, value: float = 0.5) -> Record:
    """A record of any kind; ``value`` sets apart the contents of two of one key and version."""
    time = 12.0 + value
    match kind:
        case Kind.VERTEX:
            return VertexRecord(VertexId(robot, number), version, time, 250)
        case Kind.EDGE:
            ends = VertexId(robot, 1), VertexId(robot, 2)
            pose = gtsam.Pose2(value, -2.0, 0.3)
            return EdgeRecord(Edge(EdgeId(robot, number), version, EdgeKind.LOOP, *ends, pose, COVARIANCE), time)
        case Kind.ANCHOR:
            pose = gtsam.Pose2(1.0, value, -3.0)
            return AnchorRecord(robot, number, version, time, VertexId(robot, 4), UncertainPose(pose, COVARIANCE))
        case Kind.SIGHTING:
            seen = Sighting(3.0 + value, 0.2, None if number % 2 else -2.5, 0.1, 0.02, None if number % 2 else 0.05)
            anchors = (robot, number), ("grey", number + 1)
            return SightingRecord(robot, number, version, time, "grey", seen, *anchors)
        case Kind.MAP:
            log_odds = np.zeros((3, 5), np.float32)
            log_odds[1, 1:3], log_odds[1, 3] = -2.0, 4.0
            points, normals = np.array([[1.18, 2.07]]), np.array([[-1.0, 0.0]])
            bends = Bends(np.array([[1.0, value], [4.0, -2.5]]), np.stack([COVARIANCE, np.diag([0.25, 0.0, 0.0])]))
            drawn = grid_of(log_odds), points, normals, bends
            return MapRecord(VertexId(robot, number), version, time, *drawn)


def grid_of(log_odds: npt.ArrayLike, origin: tuple[float, float] = (1.0, 2.0)) -> Grid:
    """A grid of 5 cm cells."""
    return Grid(np.asarray(log_odds, np.float32), 0.05, np.array(origin))


@cache
def room_map(robot: str = "red", index: int = 0, version: int = 1) -> MapRecord:
    """The local map that the filter would leave of a simulated room."""
    return MapRecord(VertexId(robot, index), version, 40.0, *contents(room()[2]))
