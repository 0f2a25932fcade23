"""The E step of the EM: soft correspondences between the surfaces of local maps, folded into quadratic forms.

A transform a_T_b moves every point linearly in ``v = (cos, sin, x, y)``. So all that one pair of maps has to say at
given responsibilities is one form ``v' Q v / 2 - q' v + const``: points are visited in the E step, never in the M step.

The forms hold distances across surfels only. Along a wall its surfels add up to the same density everywhere, so that
the sum of their pulls along it is nothing, but each by itself holds its point where it is and slows the EM down; and
at the ends of walls they would pull unlike ends together.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from frontend.records import FloatArray

IntArray = npt.NDArray[np.int64]

ALONG = 2.0
"""A surfel is this much longer along the surface than it is thick: its neighbours overlap, whichever were sampled."""

FACING = 10.0
"""Concentration (von Mises) of the normals of one surface, about 18 degrees. Walls are thin: without it the back of a
wall in the next room passes for its front."""

CLUTTER = 2.5
"""Standard deviations from a surface at which a point is as likely to be clutter as to belong to it."""

REACH = 3.0
"""Standard deviations beyond which a surfel explains nothing."""


@dataclass(frozen=True, slots=True)
class Surfels:
    """The surfaces of k local maps at one scale, sorted into buckets.

    Attributes:
        sigma: metres, how far off a surface its points are.
        spacing: metres between surfels along a surface.
        first: (k + 1,) index of each map's first surfel.
        points, normals: (n, 2) in the local frame of their map, ordered by bucket.
        low: (k, 2) corner of each map's buckets.
        shape: (k, 2) buckets in x and y.
        table: (k,) each map's first entry in ``starts``.
        starts: index of each bucket's first surfel.
    """

    sigma: float
    spacing: float
    first: IntArray
    points: FloatArray
    normals: FloatArray
    low: FloatArray
    shape: IntArray
    table: IntArray
    starts: IntArray

    @staticmethod
    def of(surfaces: Sequence[tuple[FloatArray, FloatArray]], sigma: float, cell: float) -> "Surfels":
        """Sample points and normals (each (m, 2)) of every map about every ``sigma``, but no closer than ``cell``."""
        side = REACH * sigma
        spacing = max(sigma, cell)
        first, table = [0], [0]
        parts, lows, shapes, starts = [], [], [], []
        for points, normals in surfaces:
            if spacing > cell:
                keep = _sample(points, normals, spacing)
                points, normals = points[keep], normals[keep]
            low = points.min(axis=0) if len(points) else np.zeros(2)
            column, row = np.floor((points - low) / side).astype(np.int64).T
            width, height = (int(column.max()) + 1, int(row.max()) + 1) if len(points) else (1, 1)
            bucket = row * width + column
            order = np.argsort(bucket, kind="stable")
            counts = np.bincount(bucket, minlength=width * height)
            starts.append(first[-1] + np.concatenate([[0], np.cumsum(counts)]))
            parts.append((points[order], normals[order]))
            lows.append(low)
            shapes.append((width, height))
            first.append(first[-1] + len(points))
            table.append(table[-1] + len(starts[-1]))
        return Surfels(
            sigma,
            spacing,
            np.array(first),
            np.concatenate([p for p, _ in parts]),
            np.concatenate([n for _, n in parts]),
            np.array(lows),
            np.array(shapes),
            np.array(table[:-1]),
            np.concatenate(starts),
        )


def expect(surfels: Surfels, pairs: IntArray, poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Which surfel of map a each surfel of map b belongs to, for pairs (p, 2) of maps a, b at a_T_b (p, 3).

    Returns:
        The negative expected log-likelihood as forms Q (p, 4, 4) and q (p, 4), ``v' Q v / 2 - q' v``, and (p,) the
        log-likelihood of b's surfels given a, over that of all being clutter.
    """
    # So much density do the surfels of an endless straight wall add up to on it, in units of a single one's peak.
    on_wall = ALONG * surfels.sigma * np.sqrt(2.0 * np.pi) / surfels.spacing
    clutter = on_wall * np.exp(-0.5 * CLUTTER**2)
    s = surfels
    forms: tuple[FloatArray, FloatArray, FloatArray] = _expect(
        s.sigma, clutter, s.first, s.points, s.normals, s.low, s.shape, s.table, s.starts, pairs, poses
    )
    return forms


def _sample(points: FloatArray, normals: FloatArray, spacing: float) -> IntArray:
    """Indices of one point a square of side ``spacing`` and quarter of directions, the one nearest to their mean."""
    quarter = np.floor(np.arctan2(normals[:, 1], normals[:, 0]) / (np.pi / 2) + 0.5).astype(np.int64) % 4
    keys = np.column_stack([np.floor(points / spacing).astype(np.int64), quarter])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.reshape(-1)
    counts = np.bincount(group)
    mean = np.column_stack([np.bincount(group, points[:, k]) / counts for k in (0, 1)])
    off = ((points - mean[group]) ** 2).sum(axis=1)
    order = np.lexsort((off, group))
    return order[np.concatenate([[0], np.cumsum(counts)[:-1]])] if len(points) else order


@numba.njit(cache=True, parallel=True, fastmath=True)
def _expect(
    sigma: float,
    clutter: float,
    first: Any,
    points: Any,
    normals: Any,
    low: Any,
    shape: Any,
    table: Any,
    starts: Any,
    pairs: Any,
    poses: Any,
) -> Any:
    n = len(pairs)
    quadratic, linear, gain = np.zeros((n, 4, 4)), np.zeros((n, 4)), np.zeros(n)
    side = REACH * sigma
    across = 1.0 / sigma**2  # weight along the normal ...
    along = across / ALONG**2  # ... and along the surface
    span = int(np.ceil(ALONG))
    for p in numba.prange(n):
        a, b = pairs[p, 0], pairs[p, 1]
        cos, sin = np.cos(poses[p, 2]), np.sin(poses[p, 2])
        width, height = shape[a, 0], shape[a, 1]
        form = np.zeros((4, 4))
        pull = np.zeros(4)
        total = 0.0
        for j in range(first[b], first[b + 1]):
            x, y = points[j, 0], points[j, 1]
            px, py = cos * x - sin * y + poses[p, 0], sin * x + cos * y + poses[p, 1]
            nx, ny = normals[j, 0], normals[j, 1]
            mx, my = cos * nx - sin * ny, sin * nx + cos * ny
            column, row = int(np.floor((px - low[a, 0]) / side)), int(np.floor((py - low[a, 1]) / side))
            left, right = max(column - span, 0), min(column + span, width - 1)
            if left > right:
                continue
            density = 0.0
            wxx = wxy = wyy = wx = wy = ux = uy = 0.0
            for r in range(max(row - span, 0), min(row + span, height - 1) + 1):
                line = table[a] + r * width
                for i in range(starts[line + left], starts[line + right + 1]):
                    dx, dy = px - points[i, 0], py - points[i, 1]
                    ax, ay = normals[i, 0], normals[i, 1]
                    off, beside = ax * dx + ay * dy, ax * dy - ay * dx
                    half = 0.5 * (across * off * off + along * beside * beside)
                    if half > 0.5 * REACH**2:
                        continue
                    e = np.exp(-half + FACING * (ax * mx + ay * my - 1.0))
                    density += e
                    # The surfel's weight across itself, and that times its centre.
                    cxx, cxy, cyy = across * ax * ax, across * ax * ay, across * ay * ay
                    wxx += e * cxx
                    wxy += e * cxy
                    wyy += e * cyy
                    wx += e * (cxx * points[i, 0] + cxy * points[i, 1])
                    wy += e * (cxy * points[i, 0] + cyy * points[i, 1])
                    ux += e * ax
                    uy += e * ay
            if density == 0.0:
                continue
            total += np.log1p(density / clutter)
            share = 1.0 / (density + clutter)
            wxx, wxy, wyy, wx, wy = share * wxx, share * wxy, share * wyy, share * wx, share * wy
            ux, uy = share * FACING * ux, share * FACING * uy
            # The point moves to (x cos - y sin + tx, y cos + x sin + ty): rows (x, -y, 1, 0) and (y, x, 0, 1).
            form[0, 0] += wxx * x * x + 2.0 * wxy * x * y + wyy * y * y
            form[0, 1] += (wyy - wxx) * x * y + wxy * (x * x - y * y)
            form[1, 1] += wxx * y * y - 2.0 * wxy * x * y + wyy * x * x
            form[0, 2] += wxx * x + wxy * y
            form[0, 3] += wxy * x + wyy * y
            form[1, 2] += wxy * x - wxx * y
            form[1, 3] += wyy * x - wxy * y
            form[2, 2] += wxx
            form[2, 3] += wxy
            form[3, 3] += wyy
            pull[0] += wx * x + wy * y + ux * nx + uy * ny
            pull[1] += wy * x - wx * y + uy * nx - ux * ny
            pull[2] += wx
            pull[3] += wy
        for k in range(4):
            for m in range(k):
                form[k, m] = form[m, k]
        quadratic[p] = form
        linear[p] = pull
        gain[p] = total
    return quadratic, linear, gain
