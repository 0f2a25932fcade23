"""Whether two local maps agree where a pose lets them overlap: what the walls say of a sighting.

Surface points of each map are looked up in the other: on a surface, in space that is clearly free, or neither.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.ndimage import distance_transform_edt

from frontend import se2
from frontend.local_map import Grid

FloatArray = npt.NDArray[np.float64]


class SurfaceMap(Protocol):
    """What is needed of a local map."""

    @property
    def grid(self) -> Grid:
        """Log-odds."""

    @property
    def cloud(self) -> FloatArray:
        """(m, 2) points of surfaces."""

    @property
    def normals(self) -> FloatArray:
        """(m, 2) their normals, zero where none is known."""


class Decision(StrEnum):
    """What two maps say of a pose."""

    AGREES = "agrees"
    CONTRADICTS = "contradicts"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True)
class Agreement:
    """How two local maps fit.

    Attributes:
        overlap: area known in both, m^2.
        hits: share of the surface points of each that fall into known space of the other and lie on its surfaces.
        conflicts: share of them that lie in clearly free space of the other.
        points: how many they are.
    """

    overlap: float
    hits: float
    conflicts: float
    points: int


NEAR = 0.1
"""A point that lies so near, metres, to an occupied cell is on its surface."""

CLEAR = 0.25
"""A free cell is clearly free only so far, metres, from any surface."""

FREE = -1.5
"""Log-odds down from which a cell is free: those of a free cell of a map that has travelled (FREE_VOTE)."""

UNKNOWN = 0.01
"""Log-odds up to here are what rounding leaves of nothing."""

LEAST_POINTS = 150
"""Points in known space of the other map below which a comparison says nothing."""

_UNKNOWN, _SURFACE, _CLEAR, _OTHER = range(4)
_MOST_POINTS = 1500  # of a map that are looked up
_AREA_STEP = 4  # cells between those that measure the overlap


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Lookup:
    """A local map made ready for many comparisons.

    Attributes:
        kinds: (height, width) uint8: unknown, surface, clearly free, or other.
        resolution, origin: those of its grid.
        points, normals: (k, 2) a selection of its cloud.
        area: (n, 2) centres of a thinned selection of its known cells.
    """

    kinds: npt.NDArray[np.uint8]
    resolution: float
    origin: FloatArray
    points: FloatArray
    normals: FloatArray
    area: FloatArray

    @classmethod
    def of(cls, local_map: SurfaceMap) -> "Lookup":
        """Sort the cells of a local map."""
        grid = local_map.grid
        known, occupied = np.abs(grid.log_odds) > UNKNOWN, grid.log_odds > 0.0
        if occupied.any():
            distance = distance_transform_edt(~occupied, sampling=grid.resolution)
        else:
            distance = np.full(grid.log_odds.shape, np.inf)
        kinds = np.where(known, _OTHER, _UNKNOWN).astype(np.uint8)
        kinds[(grid.log_odds <= FREE) & (distance > CLEAR)] = _CLEAR
        kinds[distance <= NEAR] = _SURFACE
        step = -(-len(local_map.cloud) // _MOST_POINTS) or 1
        rows, columns = np.nonzero(known[::_AREA_STEP, ::_AREA_STEP])
        area = grid.origin + grid.resolution * (_AREA_STEP * np.column_stack([columns, rows]) + 0.5)
        points, normals = local_map.cloud[::step], local_map.normals[::step]
        return cls(kinds, grid.resolution, grid.origin, points.astype(np.float64), normals.astype(np.float64), area)


def agreement(a: Lookup, b: Lookup, a_T_b: FloatArray) -> Agreement:
    """Compare two maps at one relative pose (3,), both ways."""
    points, hits, conflicts = _counts(a, b, a_T_b[None])[0]
    total = max(int(points), 1)
    return Agreement(overlap(a, b, a_T_b), int(hits) / total, int(conflicts) / total, int(points))


def overlap(a: Lookup, b: Lookup, a_T_b: FloatArray) -> float:
    """Area known in both, m^2."""
    return int(np.count_nonzero(known(a, b.area, a_T_b))) * (_AREA_STEP * b.resolution) ** 2


def scores(a: Lookup, b: Lookup, poses: FloatArray, least: int = LEAST_POINTS) -> FloatArray:
    """(k,) hits less conflicts, -1 to 1, at relative poses (k, 3); -1 where fewer than ``least`` points are known."""
    counts = _counts(a, b, poses)
    return np.where(counts[:, 0] >= least, (counts[:, 1] - counts[:, 2]) / np.maximum(counts[:, 0], 1), -1.0)


def known(a: Lookup, points: FloatArray, pose: FloatArray) -> npt.NDArray[np.bool_]:
    """(n,) whether points (n, 2), given in a frame at ``pose`` (3,) in that of ``a``, lie in its known space."""
    at = se2.compose(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]
    column, row = np.floor((at - a.origin) / a.resolution).astype(np.int64).T
    height, width = a.kinds.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    inside[inside] = a.kinds[row[inside], column[inside]] != _UNKNOWN
    return np.asarray(inside)


def _counts(a: Lookup, b: Lookup, poses: FloatArray) -> npt.NDArray[np.int64]:
    """(k, 3) points that fall into known space, on surfaces, into clear space, of both maps, at a_T_b (k, 3)."""
    counts = np.zeros((len(poses), 3), np.int64)
    _count(a.kinds, a.resolution, a.origin, b.points, poses, counts)
    _count(b.kinds, b.resolution, b.origin, a.points, np.ascontiguousarray(se2.inverse(poses)), counts)
    return counts


@njit(cache=True)
def _count(kinds, resolution, origin, points, poses, counts):  # type: ignore[no-untyped-def]
    rows, columns = kinds.shape
    for k in range(len(poses)):
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        x0, y0 = poses[k, 0] - origin[0], poses[k, 1] - origin[1]
        for i in range(len(points)):
            u = math.floor((x0 + c * points[i, 0] - s * points[i, 1]) / resolution)
            v = math.floor((y0 + s * points[i, 0] + c * points[i, 1]) / resolution)
            if 0 <= u < columns and 0 <= v < rows:
                kind = kinds[v, u]
                counts[k, 0] += kind != _UNKNOWN
                counts[k, 1] += kind == _SURFACE
                counts[k, 2] += kind == _CLEAR
