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

FREE = -0.6
"""Log-odds below which a cell is free: about where a cell of a picture turns free (p = 0.35). A map that has travelled
has FREE_VOTE there (``mrtm.joint.fusion``), which must lie below."""

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
        kinds = np.empty(grid.log_odds.shape, np.uint8)
        _sort(grid.log_odds, CLEAR / grid.resolution, NEAR / grid.resolution, kinds)
        step = -(-len(local_map.cloud) // _MOST_POINTS) or 1
        rows, columns = np.nonzero(np.abs(grid.log_odds[::_AREA_STEP, ::_AREA_STEP]) > UNKNOWN)
        area = grid.origin + grid.resolution * (_AREA_STEP * np.column_stack([columns, rows]) + 0.5)
        points, normals = local_map.cloud[::step], local_map.normals[::step]
        return cls(kinds, grid.resolution, grid.origin, points.astype(np.float64), normals.astype(np.float64), area)


def agreement(a: Lookup, b: Lookup, a_T_b: FloatArray) -> Agreement:
    """Compare two maps at one relative pose (3,), both ways."""
    points, hits, conflicts = counts(a, b, a_T_b[None])[0]
    total = max(int(points), 1)
    return Agreement(overlap(a, b, a_T_b), int(hits) / total, int(conflicts) / total, int(points))


def overlap(a: Lookup, b: Lookup, a_T_b: FloatArray) -> float:
    """Area known in both, m^2."""
    cells: int = _known(a.kinds, a.resolution, a.origin, b.area, a_T_b)
    return cells * (_AREA_STEP * b.resolution) ** 2


def scores(a: Lookup, b: Lookup, poses: FloatArray, least: int = LEAST_POINTS, thinned: int = 1) -> FloatArray:
    """(k,) hits less conflicts, -1 to 1, at relative poses (k, 3); -1 where fewer than ``least`` points are known.

    Of the points one in ``thinned`` is looked up, and stands for so many.
    """
    found = counts(a, b, poses, thinned)
    enough = thinned * found[:, 0] >= least
    return np.where(enough, (found[:, 1] - found[:, 2]) / np.maximum(found[:, 0], 1), -1.0)


def known(a: Lookup, points: FloatArray, pose: FloatArray) -> npt.NDArray[np.bool_]:
    """(n,) whether points (n, 2), given in a frame at ``pose`` (3,) in that of ``a``, lie in its known space."""
    at = se2.compose(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]
    column, row = np.floor((at - a.origin) / a.resolution).astype(np.int64).T
    height, width = a.kinds.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    inside[inside] = a.kinds[row[inside], column[inside]] != _UNKNOWN
    return np.asarray(inside)


def counts(a: Lookup, b: Lookup, poses: FloatArray, thinned: int = 1) -> npt.NDArray[np.int64]:
    """(k, 3) points, one in ``thinned`` of both maps, that fall into known space, on surfaces, into clear space of the
    other, at a_T_b (k, 3)."""
    found = np.zeros((len(poses), 3), np.int64)
    _count(a.kinds, a.resolution, a.origin, b.points[::thinned], poses, found)
    _count(b.kinds, b.resolution, b.origin, a.points[::thinned], np.ascontiguousarray(se2.inverse(poses)), found)
    return found


@njit(cache=True)
def _count(kinds, resolution, origin, points, poses, counts):  # type: ignore[no-untyped-def]
    rows, columns = kinds.shape
    for k in range(len(poses)):
        c, s = math.cos(poses[k, 2]) / resolution, math.sin(poses[k, 2]) / resolution
        x0, y0 = (poses[k, 0] - origin[0]) / resolution, (poses[k, 1] - origin[1]) / resolution
        for i in range(len(points)):
            u = x0 + c * points[i, 0] - s * points[i, 1]
            v = y0 + s * points[i, 0] + c * points[i, 1]
            if 0.0 <= u < columns and 0.0 <= v < rows:
                kind = kinds[int(v), int(u)]
                counts[k, 0] += kind != _UNKNOWN
                counts[k, 1] += kind == _SURFACE
                counts[k, 2] += kind == _CLEAR


@njit(cache=True)
def _known(kinds, resolution, origin, points, pose):  # type: ignore[no-untyped-def]
    """How many of the points lie in known space."""
    rows, columns = kinds.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x0, y0 = pose[0] - origin[0], pose[1] - origin[1]
    found = 0
    for i in range(len(points)):
        u = math.floor((x0 + c * points[i, 0] - s * points[i, 1]) / resolution)
        v = math.floor((y0 + s * points[i, 0] + c * points[i, 1]) / resolution)
        if 0 <= u < columns and 0 <= v < rows:
            found += kinds[v, u] != _UNKNOWN
    return found


@njit(cache=True)
def _sort(log_odds, clear, near, kinds):  # type: ignore[no-untyped-def]
    """Around occupied cells nothing is clearly free within ``clear`` cells, and all is surface within ``near``."""
    rows, columns = kinds.shape
    for row in range(rows):
        for column in range(columns):
            value = log_odds[row, column]
            kinds[row, column] = _CLEAR if value <= FREE else _UNKNOWN if abs(value) <= UNKNOWN else _OTHER
    side = int(clear + 1e-6)
    for row in range(rows):
        for column in range(columns):
            if log_odds[row, column] <= 0.0:
                continue
            for v in range(max(0, row - side), min(rows, row + side + 1)):
                for u in range(max(0, column - side), min(columns, column + side + 1)):
                    square = (v - row) ** 2 + (u - column) ** 2
                    if square <= near * near + 1e-6:
                        kinds[v, u] = _SURFACE
                    elif square <= clear * clear + 1e-6 and kinds[v, u] == _CLEAR:
                        kinds[v, u] = _OTHER
