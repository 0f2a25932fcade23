"""The local metric map of a particle: log-odds cells, and the surface elements found in the occupied ones.

A cell holds log-odds in steps of 1/UNIT nat (int8) and, for matching below the size of a cell, a *surfel*: the mean of
the endpoints that fell into the cell and the mean of their normals. ``index`` names for every cell the nearest surfel
within REACH cells (0: none), so that finding the surface of an endpoint is one look-up.

Particle filters need many maps of the same fixed size: ``Maps`` holds them as stacked arrays. Pages of the stack that
no beam ever touched cost no memory.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit, prange

UNIT = 20.0  # steps of the log-odds per nat
HIT = 17  # log-odds of "occupied" given a hit: 0.85 nat (p = 0.70)
MISS = 8  # log-odds of "free" given a beam that passed: 0.4 nat (p = 0.40)
LIMIT = 100  # clamp: 5 nat (p = 0.993), so that a changed world is believed after a dozen beams
DEAD = -40  # a surfel whose cell falls below this was something that moved away
REACH = 5  # cells around a surfel that point to it: the basin of the matcher
MAX_HITS = 100  # endpoints after which a surfel's mean moves no slower

N, X, Y, NX, NY = range(5)  # columns of the surfel table


@dataclass(frozen=True, slots=True)
class Maps:
    """A stack of P equal-sized maps, ``width`` x ``width`` cells, the frame's origin in the middle.

    Attributes:
        log_odds: (P, width, width) int8, row = y.
        index: (P, width, width) uint16, 1-based row of ``surfels``; 0 = none near.
        surfels: (P, capacity, 5) float32: hits, mean x, mean y, mean normal x, mean normal y. Row 0 is unused.
        counts: (P,) number of surfels, row 0 included.
        bounds: (P, 4) int64 touched cells: first row, end row, first column, end column.
        resolution: metres per cell.
    """

    log_odds: npt.NDArray[np.int8]
    index: npt.NDArray[np.uint16]
    surfels: npt.NDArray[np.float32]
    counts: npt.NDArray[np.int64]
    bounds: npt.NDArray[np.int64]
    resolution: float

    @staticmethod
    def empty(particles: int, width: float, resolution: float, capacity: int = 30000) -> "Maps":
        """``width`` in metres; ``capacity`` surfels a map."""
        cells = int(round(width / resolution))
        maps = Maps(
            np.zeros((particles, cells, cells), np.int8),
            np.zeros((particles, cells, cells), np.uint16),
            np.zeros((particles, capacity, 5), np.float32),
            np.ones(particles, np.int64),
            np.empty((particles, 4), np.int64),
            resolution,
        )
        maps.bounds[:] = (cells, 0, cells, 0)
        return maps

    def clear(self) -> None:
        """Forget everything."""
        for p in range(len(self.counts)):
            _clear(self.log_odds[p], self.index[p], self.bounds[p])
        self.counts[:] = 1

    def copy_from(self, source: "Maps", parents: npt.NDArray[np.int64]) -> None:
        """Make map p a copy of ``source`` map ``parents[p]``; ``source`` may be self if parents keep their place."""
        _copy_all(
            source.log_odds, source.index, source.surfels, source.counts, source.bounds,
            self.log_odds, self.index, self.surfels, self.counts, self.bounds, parents, source is self,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _clear(log_odds, index, bounds):  # type: ignore[no-untyped-def]
    if bounds[1] > bounds[0]:
        log_odds[bounds[0] : bounds[1], bounds[2] : bounds[3]] = 0
        index[bounds[0] : bounds[1], bounds[2] : bounds[3]] = 0
    bounds[0] = log_odds.shape[0]
    bounds[1] = 0
    bounds[2] = log_odds.shape[1]
    bounds[3] = 0


@njit(cache=True, nogil=True, parallel=True)
def _copy_all(lo_a, ix_a, su_a, n_a, bo_a, lo_b, ix_b, su_b, n_b, bo_b, parents, same):  # type: ignore[no-untyped-def]
    for p in prange(len(parents)):
        a = parents[p]
        if same and a == p:
            continue
        _clear(lo_b[p], ix_b[p], bo_b[p])
        r0, r1, c0, c1 = bo_a[a, 0], bo_a[a, 1], bo_a[a, 2], bo_a[a, 3]
        for r in range(r0, r1):
            lo_b[p, r, c0:c1] = lo_a[a, r, c0:c1]
            ix_b[p, r, c0:c1] = ix_a[a, r, c0:c1]
        su_b[p, : n_a[a]] = su_a[a, : n_a[a]]
        n_b[p] = n_a[a]
        bo_b[p] = bo_a[a]


@njit(cache=True, nogil=True)
def _is_at(surfels, k, u, v, inv, half_u, half_v):  # type: ignore[no-untyped-def]
    """Whether surfel k lies in the cell, and is not merely the nearest to it."""
    return int(surfels[k, X] * inv + half_u) == u and int(surfels[k, Y] * inv + half_v) == v


@njit(cache=True, nogil=True)
def _widen(bounds, rows, columns, x, y):  # type: ignore[no-untyped-def]
    """Take the cell at (x, y), or the nearest to it inside the map, into the bounds; cells, not metres."""
    u = int(min(max(x, 0.0), columns - 1.0))
    v = int(min(max(y, 0.0), rows - 1.0))
    bounds[0] = min(bounds[0], v)
    bounds[1] = max(bounds[1], v + 1)
    bounds[2] = min(bounds[2], u)
    bounds[3] = max(bounds[3], u + 1)


@njit(cache=True, nogil=True)
def _carve(log_odds, index, surfels, resolution, x0, y0, x1, y1, short):  # type: ignore[no-untyped-def]
    """Lower the cells from (x0, y0) towards (x1, y1), stopping ``short`` cells before the end; cells, not metres."""
    dx = x1 - x0
    dy = y1 - y0
    length = max(abs(dx), abs(dy))
    steps = int(length) - short
    if steps <= 0:
        return
    dx /= length
    dy /= length
    rows, columns = log_odds.shape
    for _ in range(steps):
        u = int(x0)
        v = int(y0)
        if 0 <= u < columns and 0 <= v < rows:
            value = log_odds[v, u]
            if value > -LIMIT:
                log_odds[v, u] = value - MISS
                if DEAD <= value < DEAD + MISS:
                    k = index[v, u]
                    if k > 0 and _is_at(surfels, k, u, v, 1.0 / resolution, 0.5 * columns, 0.5 * rows):
                        surfels[k, N] = 0.0
        x0 += dx
        y0 += dy


@njit(cache=True, nogil=True)
def insert(log_odds, index, surfels, count, bounds, resolution, pose, hits, clear, sensor):  # type: ignore[no-untyped-def]
    """Add one scan taken at ``pose`` to a map: cells that its beams passed become freer, those that they hit fuller.

    Returns the new number of surfels. ``bounds`` is widened in place.
    """
    rows, columns = log_odds.shape
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    inv = 1.0 / resolution
    half_u = 0.5 * columns
    half_v = 0.5 * rows
    x0 = (pose[0] + c * sensor[0] - s * sensor[1]) * inv + half_u
    y0 = (pose[1] + s * sensor[0] + c * sensor[1]) * inv + half_v
    for i in range(len(hits)):
        x1 = (pose[0] + c * hits[i, 0] - s * hits[i, 1]) * inv + half_u
        y1 = (pose[1] + s * hits[i, 0] + c * hits[i, 1]) * inv + half_v
        _carve(log_odds, index, surfels, resolution, x0, y0, x1, y1, 1)
        _widen(bounds, rows, columns, x1, y1)
    for i in range(len(clear)):
        x1 = (pose[0] + c * clear[i, 0] - s * clear[i, 1]) * inv + half_u
        y1 = (pose[1] + s * clear[i, 0] + c * clear[i, 1]) * inv + half_v
        _carve(log_odds, index, surfels, resolution, x0, y0, x1, y1, 0)
        _widen(bounds, rows, columns, x1, y1)
    _widen(bounds, rows, columns, x0, y0)
    for i in range(len(hits)):
        px = pose[0] + c * hits[i, 0] - s * hits[i, 1]
        py = pose[1] + s * hits[i, 0] + c * hits[i, 1]
        nx = c * hits[i, 2] - s * hits[i, 3]
        ny = s * hits[i, 2] + c * hits[i, 3]
        u = int(px * inv + half_u)
        v = int(py * inv + half_v)
        if u < REACH or v < REACH or u >= columns - REACH or v >= rows - REACH:
            continue
        log_odds[v, u] = min(LIMIT, log_odds[v, u] + HIT)
        k = index[v, u]
        if k > 0 and _is_at(surfels, k, u, v, inv, half_u, half_v):
            n = min(surfels[k, N] + 1.0, MAX_HITS)
            w = 1.0 / n
            surfels[k, N] = n
            surfels[k, X] += w * (px - surfels[k, X])
            surfels[k, Y] += w * (py - surfels[k, Y])
            surfels[k, NX] += w * (nx - surfels[k, NX])
            surfels[k, NY] += w * (ny - surfels[k, NY])
            continue
        if count >= len(surfels):
            continue
        k = count
        count += 1
        surfels[k, N] = 1.0
        surfels[k, X] = px
        surfels[k, Y] = py
        surfels[k, NX] = nx
        surfels[k, NY] = ny
        for dv in range(-REACH, REACH + 1):
            for du in range(-REACH, REACH + 1):
                if du * du + dv * dv > REACH * REACH:
                    continue
                j = index[v + dv, u + du]
                if j > 0 and not (du == 0 and dv == 0):
                    cx = (u + du + 0.5 - half_u) * resolution
                    cy = (v + dv + 0.5 - half_v) * resolution
                    old = (cx - surfels[j, X]) ** 2 + (cy - surfels[j, Y]) ** 2
                    if surfels[j, N] > 0.0 and old <= (cx - px) ** 2 + (cy - py) ** 2:
                        continue
                index[v + dv, u + du] = k
        bounds[0] = min(bounds[0], v - REACH)
        bounds[1] = max(bounds[1], v + REACH + 1)
        bounds[2] = min(bounds[2], u - REACH)
        bounds[3] = max(bounds[3], u + REACH + 1)
    return count
