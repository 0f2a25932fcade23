"""Local maps of made-up walls, as alignment takes them."""

from dataclasses import dataclass, field

import numpy as np

from frontend import se2
from frontend.local_map import Bends, Grid
from frontend.records import FloatArray
from mrtm.joint.alignment.surface import Surface

Wall = tuple[float, float, float, float]
RESOLUTION = 0.05


@dataclass(frozen=True)
class Made:
    """A local map as alignment needs it."""

    grid: Grid
    cloud: FloatArray
    normals: FloatArray
    bends: Bends = field(default_factory=Bends)


def seen(walls: list[Wall], frame: FloatArray, low: float, high: float, seed: int, noise: float = 0.008) -> Surface:
    """What ``made`` makes, prepared."""
    return Surface.of(made(walls, frame, low, high, seed, noise))


def made(walls: list[Wall], frame: FloatArray, low: float, high: float, seed: int, noise: float = 0.008) -> Made:
    """The map, with its origin at ``frame`` in the plan, of what lies between two x of the plan.

    Free space is to the left of each wall, and everything between the walls is known to be free.
    """
    rng = np.random.default_rng(seed)
    points, normals = [], []
    for x0, y0, x1, y1 in walls:
        length = float(np.hypot(x1 - x0, y1 - y0))
        along = (np.arange(0.0, length, RESOLUTION) + rng.uniform(0, RESOLUTION))[:, None]
        tangent = np.array([x1 - x0, y1 - y0]) / length
        normal = np.array([-tangent[1], tangent[0]])
        points.append((x0, y0) + along * tangent + rng.normal(0.0, noise, along.shape) * normal)
        normals.append(np.tile(normal, (len(along), 1)))
    cloud, facing = np.concatenate(points), np.concatenate(normals)
    inside = (cloud[:, 0] >= low) & (cloud[:, 0] <= high)
    cloud, facing = cloud[inside], facing[inside]
    xy = np.array([w[:2] for w in walls])
    bottom, top = xy[:, 1].min(), max(xy[:, 1].max(), max(w[3] for w in walls))
    x, y = np.meshgrid(np.arange(low, high, RESOLUTION / 2), np.arange(bottom, top, RESOLUTION / 2))
    free = se2.between(frame, np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))[:, :2]
    turned = np.column_stack([facing, np.zeros(len(facing))])
    local = se2.between(frame, np.column_stack([cloud, np.zeros(len(cloud))]))[:, :2]
    normal_local = se2.between(np.array([0.0, 0.0, frame[2]]), turned)[:, :2]
    origin = free.min(axis=0) - 1.0
    width, height = np.ceil((free.max(axis=0) + 1.0 - origin) / RESOLUTION).astype(int)
    log_odds = np.zeros((height, width), np.float32)
    for at, value in ((free, -4.0), (local, 4.0)):
        u, v = np.floor((at - origin) / RESOLUTION).astype(int).T
        log_odds[v, u] = value
    return Made(Grid(log_odds, RESOLUTION, origin), local, normal_local)


def unknown() -> Surface:
    """A map of nothing."""
    grid = Grid(np.zeros((1, 1), np.float32), RESOLUTION, np.zeros(2))
    return Surface.of(Made(grid, np.empty((0, 2)), np.empty((0, 2))))
