"""Points of the plane sorted into square buckets, so that kernels find the nearest of them that faces alike."""

import math
from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from frontend.records import FloatArray

SIDE = 0.15  # metres, of a bucket


@dataclass(frozen=True, slots=True, eq=False)
class Buckets:
    """Points that know which way they face, in the order of their buckets.

    Attributes:
        points: (n, 2) metres.
        normals: (n, 2) of length one.
        low: (2,) corner of the first bucket.
        starts: (rows, columns + 1) index of the first point of each bucket, and that after a row's last.
    """

    points: FloatArray
    normals: FloatArray
    low: FloatArray
    starts: npt.NDArray[np.int64]

    @classmethod
    def of(cls, points: FloatArray, normals: FloatArray) -> "Buckets":
        """Sort points (n, 2) and their normals (n, 2)."""
        low = points.min(axis=0) if len(points) else np.zeros(2)
        column, row = np.floor((points - low) / SIDE).astype(np.int64).T
        columns, rows = (int(column.max()) + 1, int(row.max()) + 1) if len(points) else (1, 1)
        order = np.argsort(row * columns + column, kind="stable")
        ends = np.cumsum(np.bincount(row * columns + column, minlength=rows * columns)).reshape(rows, columns)
        before = np.concatenate([[0], ends[:-1, -1]])
        return cls(points[order], normals[order], low, np.column_stack([before, ends]))


@numba.njit(cache=True, inline="always")
def nearest(points, normals, low, starts, x, y, nx, ny, reach, facing):  # type: ignore[no-untyped-def]
    """Index of the point nearest to (x, y), within ``reach``, whose normal has a cosine of ``facing`` or more with
    (nx, ny); -1 if there is none."""
    rows, columns = starts.shape[0], starts.shape[1] - 1
    left = max(0, int(math.floor((x - reach - low[0]) / SIDE)))
    right = min(columns - 1, int(math.floor((x + reach - low[0]) / SIDE)))
    found, least = -1, reach * reach
    if left <= right:
        bottom = max(0, int(math.floor((y - reach - low[1]) / SIDE)))
        top = min(rows - 1, int(math.floor((y + reach - low[1]) / SIDE)))
        for row in range(bottom, top + 1):
            for i in range(starts[row, left], starts[row, right + 1]):
                dx, dy = points[i, 0] - x, points[i, 1] - y
                square = dx * dx + dy * dy
                if square < least and normals[i, 0] * nx + normals[i, 1] * ny > facing:
                    found, least = i, square
    return found
