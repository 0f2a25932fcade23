"""Rooms made of walls with two sides, and local maps of them whose true poses are known."""

from collections.abc import Sequence

import gtsam
import numpy as np

from factors import Edge, EdgeId, EdgeKind, VertexId
from frontend import se2
from frontend.local_map import Grid, LocalMap
from frontend.records import FloatArray

Wall = tuple[float, float, float, float]

# Closed rooms of 8 x 5 m beside each other, walls 0.12 m thick: each seen from inside, so its normals point inwards.
ROOMS = tuple((x, 0.0, x + 8.0, 5.0) for x in (0.0, 8.12, 16.24))
CORRIDOR: tuple[Wall, ...] = ((0.0, 0.0, 30.0, 0.0), (30.0, 2.0, 0.0, 2.0))
"""Two endless walls: seen from left to right, free space is on the left."""


def box_walls(box: tuple[float, float, float, float]) -> tuple[Wall, ...]:
    """The four walls of a room, anticlockwise: free space on the left, and a cupboard that breaks the symmetry."""
    a, b, c, d = box
    return (
        (a, b, c, b), (c, b, c, d), (c, d, a, d), (a, d, a, b),
        (a + 2.0, b + 1.5, a + 2.0, b + 0.6), (a + 2.0, b + 0.6, a + 3.2, b + 0.6),
    )  # fmt: skip


def surface(walls: Sequence[Wall], spacing: float = 0.05) -> tuple[FloatArray, FloatArray]:
    """Points (n, 2) along the walls and their normals, to the left."""
    points, normals = [], []
    for x0, y0, x1, y1 in walls:
        length = float(np.hypot(x1 - x0, y1 - y0))
        t = (np.arange(round(length / spacing)) + 0.5) * spacing / length
        points.append(np.column_stack([x0 + t * (x1 - x0), y0 + t * (y1 - y0)]))
        normals.append(np.tile([-(y1 - y0) / length, (x1 - x0) / length], (len(t), 1)))
    return np.concatenate(points), np.concatenate(normals)


def map_at(pose: gtsam.Pose2, walls: Sequence[Wall], noise: float, rng: np.random.Generator) -> LocalMap:
    """What is known of the walls from a vertex at joint_T_local; the grid is empty."""
    points, normals = surface(walls)
    points = points + rng.uniform(-0.025, 0.025, (len(points), 1)) * normals[:, ::-1] * [-1.0, 1.0]
    points = points + rng.normal(0.0, noise, (len(points), 1)) * normals
    xytheta = np.array([pose.x(), pose.y(), pose.theta()])
    local = se2.between(xytheta, np.column_stack([points, np.arctan2(normals[:, 1], normals[:, 0])]))
    return LocalMap(
        Grid(np.zeros((1, 1), np.float32), 0.05, np.zeros(2)),
        np.empty(0, np.int64),
        np.empty(0),
        np.empty((0, 3)),
        local[:, :2],
        np.column_stack([np.cos(local[:, 2]), np.sin(local[:, 2])]),
    )


def edge(number: int, tail: VertexId, head: VertexId, tail_T_head: gtsam.Pose2) -> Edge:
    """An inter-vertex edge with some covariance."""
    covariance = np.diag([0.1, 0.1, 0.05]) ** 2
    return Edge(EdgeId(tail.robot, number), 0, EdgeKind.INTER_VERTEX, tail, head, tail_T_head, covariance)


def distance(a: gtsam.Pose2, b: gtsam.Pose2) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    off = a.between(b)
    return float(np.hypot(off.x(), off.y())), float(np.degrees(abs(off.theta())))
