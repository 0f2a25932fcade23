"""All local maps of a component in one grid, at the joint estimate (M12's picture of the whole)."""

import math
from collections.abc import Sequence

import gtsam
import numba
import numpy as np
import numpy.typing as npt

from frontend.local_map import Grid, LocalMap
from frontend.records import FloatArray

Log = npt.NDArray[np.float32]

OCCUPIED_VOTE = 4.0
"""The most log-odds one local map can give for a cell being occupied."""

FREE_VOTE = 1.5
"""The most log-odds one local map can give for a cell being free.

Local maps fit to about a cell. Where they differ by one, a wall of one is free space of another; with these limits it
stays a wall if more than FREE_VOTE / (OCCUPIED_VOTE + FREE_VOTE), about a quarter, of the maps that see the cell say
so. A person who stood still in one map, or a second wall of one map that slipped, is outvoted."""

MOST_CELLS = 1e8
"""Of a joint grid, half a kilometre square at 0.05 m; over more ground its cells are coarser."""

UNKNOWN = 0.01
"""Log-odds up to here are what rounding leaves of nothing."""

LIMIT = 20.0
"""Fused log-odds stay within plus and minus this."""


def fuse(maps: Sequence[tuple[gtsam.Pose2, LocalMap]], resolution: float = 0.05, box: FloatArray | None = None) -> Grid:
    """Draw local maps into one grid that just holds everything known, or a given part of it.

    Every output cell asks each local map that covers it for the log-odds at its centre, interpolated between the four
    nearest cells, limited to a vote (see the constants), and sums the votes. Interpolation comes after the limit, so
    that a wall one cell wide survives any rotation and half-cell shift and grows to no more than two.

    Args:
        maps: the pose joint_T_local of each local map, and the map.
        resolution: metres per cell of the result, any positive value; much coarser than the local maps it misses walls.
        box: (2, 2) least and largest x, y of the part to draw, metres in the joint frame; the result just covers it.

    Returns:
        A grid in the joint frame; its origin is a multiple of the resolution, which is doubled as often as it takes for
        MOST_CELLS to do. Without a box of size (1, 1) if nothing is known.

    Raises:
        ValueError: ``resolution`` is not positive or a pose is not finite.
    """
    if not resolution > 0 or not math.isfinite(resolution):
        raise ValueError(f"resolution {resolution} m is not positive")
    placed = []
    for pose, local_map in maps:
        xytheta = np.array([pose.x(), pose.y(), pose.theta()])
        if not np.isfinite(xytheta).all():
            raise ValueError(f"pose {xytheta} of a local map is not finite")
        known = _crop(local_map.grid)
        if known is not None:
            placed.append((xytheta, known))
    unknown = Grid(np.zeros((1, 1), np.float32), resolution, np.zeros(2))
    if box is None and not placed:
        return unknown
    extent = np.concatenate([_corners(pose, grid) for pose, grid in placed]) if box is None else box
    resolution = drawable(extent, resolution)
    low = np.floor(extent.min(axis=0) / resolution + 1e-6)  # a border that is a multiple, give or take rounding
    width, height = (np.ceil(extent.max(axis=0) / resolution - 1e-6) - low).astype(int)
    origin = low * resolution
    total = np.zeros((height, width), np.float32)
    for at, grid in placed:
        _add(
            total,
            *_rows(at, grid, origin, resolution, height),
            grid.log_odds,
            *_affine(at, grid, origin, resolution),
        )
    np.clip(total, -LIMIT, LIMIT, out=total)
    fused = Grid(total, resolution, origin)
    return fused if box is not None else _crop(fused) or unknown


def drawable(points: FloatArray, resolution: float) -> float:
    """Metres a cell, doubled as often as it takes for a grid around ``points`` (n, 2) to have MOST_CELLS at most."""
    spans = np.ptp(points, axis=0)
    while float(np.prod(np.maximum(spans / resolution, 1.0))) > MOST_CELLS:
        resolution *= 2.0
    return resolution


def _crop(grid: Grid) -> Grid | None:
    """The known part of a grid, None if there is none."""
    known = np.abs(grid.log_odds) > UNKNOWN
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if len(rows) == 0:
        return None
    part = grid.log_odds[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    origin = grid.origin + grid.resolution * np.array([columns[0], rows[0]], np.float64)
    return Grid(np.ascontiguousarray(part, np.float32), grid.resolution, origin)


def _corners(pose: FloatArray, grid: Grid) -> FloatArray:
    """Joint coordinates (4, 2) of the corners of a grid at ``pose``, half a cell out: interpolation reaches so far."""
    height, width = grid.log_odds.shape
    x = grid.origin[0] + grid.resolution * np.array([-0.5, width + 0.5, width + 0.5, -0.5])
    y = grid.origin[1] + grid.resolution * np.array([-0.5, -0.5, height + 0.5, height + 0.5])
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.column_stack([pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y])


def _rows(pose: FloatArray, grid: Grid, origin: FloatArray, resolution: float, height: int) -> tuple[int, int]:
    """The output rows a local map can reach."""
    y = (_corners(pose, grid)[:, 1] - origin[1]) / resolution
    return max(math.floor(y.min()), 0), min(math.ceil(y.max()), height)


def _affine(pose: FloatArray, grid: Grid, origin: FloatArray, resolution: float) -> tuple[float, float, float, float]:
    """Column and row of ``grid`` at the centre of output cell (0, 0), and their change from one column to the next.

    The change from one row to the next is that turned by a right angle.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = origin + 0.5 * resolution - pose[:2]
    column = (cos * dx + sin * dy - grid.origin[0]) / grid.resolution - 0.5
    row = (-sin * dx + cos * dy - grid.origin[1]) / grid.resolution - 0.5
    scale = resolution / grid.resolution
    return column, row, scale * cos, -scale * sin


@numba.njit(cache=True, parallel=True)
def _add(
    total: Log, first: int, last: int, source: Log, column0: float, row0: float, step_column: float, step_row: float
) -> None:
    """Add the votes of one local map to the output rows ``first`` to ``last``; each row is one thread's own."""
    height, width = source.shape
    for y in numba.prange(first, last):
        column_start, row_start = column0 - step_row * y, row0 + step_column * y
        low, high = 0.0, float(total.shape[1] - 1)
        # The stretch of this output row that lies within one cell of the source, in each source axis.
        for start, step, size in ((column_start, step_column, width), (row_start, step_row, height)):
            if abs(step) > 1e-12:
                a, b = (-1.0 - start) / step, (size - start) / step
                low, high = max(low, min(a, b)), min(high, max(a, b))
            elif start <= -1.0 or start >= size:
                high = -1.0
        for x in range(math.ceil(low), math.floor(high) + 1):
            column, row = column_start + step_column * x, row_start + step_row * x
            c, r = math.floor(column), math.floor(row)
            u, v = column - c, row - r
            vote = 0.0
            for i in range(2):
                for j in range(2):
                    if 0 <= r + i < height and 0 <= c + j < width:
                        weight = (v if i else 1.0 - v) * (u if j else 1.0 - u)
                        vote += weight * min(max(source[r + i, c + j], -FREE_VOTE), OCCUPIED_VOTE)
            total[y, x] += vote
