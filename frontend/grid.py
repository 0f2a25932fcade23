"""The local metric map of a particle: log-odds cells, and the surface elements found in the occupied ones.

A cell holds log-odds in steps of 1/UNIT nat (int8) and, for matching below the size of a cell, a *surfel*: the mean of
the endpoints that fell into the cell and the mean of their normals. ``index`` names for every cell the nearest surfel
within REACH cells (0: none), so that finding the surface of an endpoint is one look-up.

Particle filters need many maps of the same fixed size: ``Maps`` holds them as stacked arrays. A map is laid out in
tiles of 64 x 64 cells, each a page of memory or two: tiles that no beam ever touched cost no memory, and no time when
maps are copied or cleared.
"""

import math
import mmap
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from frontend.records import FloatArray

UNIT = 20.0  # steps of the log-odds per nat
HIT = 17  # log-odds of "occupied" given a hit: 0.85 nat (p = 0.70)
MISS = 8  # log-odds of "free" given a beam that passed: 0.4 nat (p = 0.40)
LIMIT = 100  # clamp: 5 nat (p = 0.993), so that a changed world is believed after a dozen beams
DEAD = -40  # a surfel whose cell falls below this was something that moved away
REACH = 5  # cells around a surfel that point to it: the basin of the matcher
MAX_HITS = 100  # endpoints after which a surfel's mean moves no slower

N, X, Y, NX, NY = range(5)  # columns of the surfel table

SHIFT = 6  # a tile is 2**SHIFT cells wide
TILE = 1 << SHIFT
FRACTION = 44  # binary digits of a cell in the fixed-point numbers that walk along a beam
FARTHEST = 1 << 18  # cells from a map's corner to a sensor that those numbers can hold


Layers = tuple[npt.NDArray[np.int8], npt.NDArray[np.uint16], npt.NDArray[np.float32], float]


@dataclass(frozen=True, slots=True)
class Maps:
    """A stack of P equal-sized square maps of T x T tiles, the frame's origin in the middle.

    The cell in row v (y) and column u (x) of a map is ``[v >> SHIFT, u >> SHIFT, v % TILE, u % TILE]``.

    Attributes:
        log_odds: (P, T, T, TILE, TILE) int8.
        index: (P, T, T, TILE, TILE) uint16, 1-based row of ``surfels``; 0 = none near.
        surfels: (P, capacity, 5) float32: hits, mean x, mean y, mean normal x, mean normal y. Row 0 is unused.
        counts: (P,) number of surfels, row 0 included.
        touched: (P, T, T) tiles that may hold something; all others are zero.
        resolution: metres per cell.
    """

    log_odds: npt.NDArray[np.int8]
    index: npt.NDArray[np.uint16]
    surfels: npt.NDArray[np.float32]
    counts: npt.NDArray[np.int64]
    touched: npt.NDArray[np.bool_]
    resolution: float

    @staticmethod
    def empty(particles: int, width: float, resolution: float, capacity: int = 30000) -> "Maps":
        """Maps at least ``width`` metres wide, in whole tiles; ``capacity`` surfels a map."""
        tiles = -(-round(width / resolution) // TILE)
        return Maps(
            _blank((particles, tiles, tiles, TILE, TILE), np.int8),
            _blank((particles, tiles, tiles, TILE, TILE), np.uint16),
            _blank((particles, capacity, 5), np.float32),
            np.ones(particles, np.int64),
            np.zeros((particles, tiles, tiles), np.bool_),
            resolution,
        )

    def clear(self) -> None:
        """Forget everything."""
        for p in range(len(self.counts)):
            _clear(self.log_odds[p], self.index[p], self.touched[p])
        self.counts[:] = 1

    def copy_from(self, source: "Maps", parents: npt.NDArray[np.int64]) -> None:
        """Make map p a copy of ``source`` map ``parents[p]``; ``source`` may be self if parents keep their place."""
        _copy_all(
            source.log_odds, source.index, source.surfels, source.counts, source.touched,
            self.log_odds, self.index, self.surfels, self.counts, self.touched, parents, source is self,
        )  # fmt: skip

    def layers(self, p: int) -> Layers:
        """Map ``p`` as the kernels of ``matching`` take it: log-odds, index, surfels, resolution."""
        return self.log_odds[p], self.index[p], self.surfels[p], self.resolution

    def known(self, p: int) -> tuple[npt.NDArray[np.int8], FloatArray]:
        """The part of map ``p`` that holds anything: log-odds (rows, columns), and (2,) x, y of its outer corner."""
        cells = in_rows(self.log_odds[p])
        rows, columns = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
        if not len(rows):
            return cells[:0, :0], np.zeros(2)
        part = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        return part, (np.array([columns[0], rows[0]]) - 0.5 * len(cells)) * self.resolution


def in_rows(layer: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A layer of tiles (..., T, T, TILE, TILE) as an array of cells (..., rows, columns): a copy."""
    cells = layer.shape[-4] * TILE
    return layer.swapaxes(-3, -2).reshape(*layer.shape[:-4], cells, cells)


def _blank(shape: tuple[int, ...], dtype: type[Any]) -> npt.NDArray[Any]:
    """Zeros that take memory by the page when they are written to, where the system can be told so."""
    if not hasattr(mmap, "MADV_NOHUGEPAGE"):
        return np.zeros(shape, dtype)
    memory = mmap.mmap(-1, math.prod(shape) * np.dtype(dtype).itemsize, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    memory.madvise(mmap.MADV_NOHUGEPAGE)  # numpy would ask for huge ones: a single cell would cost two megabytes
    return np.frombuffer(memory, dtype).reshape(shape)


@njit(cache=True, nogil=True)
def _clear(log_odds, index, touched):  # type: ignore[no-untyped-def]
    for tv in range(len(touched)):
        for tu in range(len(touched)):
            if touched[tv, tu]:
                log_odds[tv, tu] = 0
                index[tv, tu] = 0
                touched[tv, tu] = False


@njit(cache=True, nogil=True, parallel=True)
def _copy_all(lo_a, ix_a, su_a, n_a, to_a, lo_b, ix_b, su_b, n_b, to_b, parents, same):  # type: ignore[no-untyped-def]
    for p in prange(len(parents)):
        a = parents[p]
        if same and a == p:
            continue
        _clear(lo_b[p], ix_b[p], to_b[p])
        for tv in range(len(to_a[a])):
            for tu in range(len(to_a[a])):
                if to_a[a, tv, tu]:
                    lo_b[p, tv, tu] = lo_a[a, tv, tu]
                    ix_b[p, tv, tu] = ix_a[a, tv, tu]
                    to_b[p, tv, tu] = True
        su_b[p, : n_a[a]] = su_a[a, : n_a[a]]
        n_b[p] = n_a[a]


@njit(cache=True, nogil=True)
def at(layer, v, u):  # type: ignore[no-untyped-def]
    """The cell in row v and column u of a map's layer."""
    return layer[v >> SHIFT, u >> SHIFT, v & (TILE - 1), u & (TILE - 1)]


@njit(cache=True, nogil=True)
def _is_at(surfels, k, u, v, inv, half_u, half_v):  # type: ignore[no-untyped-def]
    """Whether surfel k lies in the cell, and is not merely the nearest to it."""
    return int(surfels[k, X] * inv + half_u) == u and int(surfels[k, Y] * inv + half_v) == v


@njit(cache=True, nogil=True)
def _carve(log_odds, index, surfels, touched, resolution, x0, y0, x1, y1, short):  # type: ignore[no-untyped-def]
    """Lower the cells from (x0, y0) towards (x1, y1), stopping ``short`` cells before the end; cells, not metres.

    ``log_odds`` and ``index`` are flat. The beam takes steps of one cell along its longer axis, tile by tile.
    """
    dx = x1 - x0
    dy = y1 - y0
    length = max(abs(dx), abs(dy))
    steps = int(length) - short
    if steps <= 0:
        return
    tiles = len(touched)
    one = float(1 << FRACTION)
    step_x = int(math.floor(dx / length * one + 0.5))
    step_y = int(math.floor(dy / length * one + 0.5))
    x = int(math.floor(x0 * one + 0.5))
    y = int(math.floor(y0 * one + 0.5))
    pace_x = 1.0 / abs(step_x) if step_x != 0 else np.inf
    pace_y = 1.0 / abs(step_y) if step_y != 0 else np.inf
    while steps > 0:
        tu = x >> (SHIFT + FRACTION)
        tv = y >> (SHIFT + FRACTION)
        # Steps to the first cell beyond this tile; one too few, where rounding makes it so, does no harm.
        way_x = ((tu + 1) << (SHIFT + FRACTION)) - x if step_x > 0 else x + 1 - (tu << (SHIFT + FRACTION))
        way_y = ((tv + 1) << (SHIFT + FRACTION)) - y if step_y > 0 else y + 1 - (tv << (SHIFT + FRACTION))
        here = min(steps, int(min(way_x * pace_x, way_y * pace_y) * (1.0 - 1e-15)) + 1)
        steps -= here
        if tu < 0 or tv < 0 or tu >= tiles or tv >= tiles:
            x += here * step_x
            y += here * step_y
            continue
        touched[tv, tu] = True
        # Cell (v, u) of this tile is number first + v * TILE + u of the map.
        first = ((tv * tiles + tu) << 2 * SHIFT) - (tv << 2 * SHIFT) - (tu << SHIFT)
        for _ in range(here):
            cell = np.uint64(first + ((y >> FRACTION) << SHIFT) + (x >> FRACTION))
            value = log_odds[cell]
            log_odds[cell] = value - MISS * (value > -LIMIT)
            if DEAD <= value < DEAD + MISS:
                k = index[cell]
                half = 0.5 * tiles * TILE
                if k > 0 and _is_at(surfels, k, x >> FRACTION, y >> FRACTION, 1.0 / resolution, half, half):
                    surfels[k, N] = 0.0
            x += step_x
            y += step_y


@njit(cache=True, nogil=True)
def _claim(index, surfels, k, tiles, resolution, v, u, px, py):  # type: ignore[no-untyped-def]
    """Name the new surfel ``k`` at (px, py) in cell (v, u) as the nearest, where it is, in a flat ``index``."""
    half = 0.5 * tiles * TILE
    for row in range(v - REACH, v + REACH + 1):
        first = (row >> SHIFT) * (tiles << 2 * SHIFT) + ((row & (TILE - 1)) << SHIFT)
        reach = int(math.sqrt(REACH * REACH - (row - v) * (row - v)))
        cy = (row + 0.5 - half) * resolution
        for column in range(u - reach, u + reach + 1):
            cell = np.uint64(first + ((column >> SHIFT) << 2 * SHIFT) + (column & (TILE - 1)))
            j = index[cell]  # where that is 0, so are the hits of surfel 0
            cx = (column + 0.5 - half) * resolution
            old = (cx - surfels[j, X]) ** 2 + (cy - surfels[j, Y]) ** 2
            # Without a branch: which of the two is nearer nobody can predict.
            stays = (surfels[j, N] > 0.0) & (old <= (cx - px) ** 2 + (cy - py) ** 2)
            index[cell] = j if stays else k


@njit(cache=True, nogil=True)
def insert(log_odds, index, surfels, count, touched, resolution, pose, hits, clear, sensor):  # type: ignore[no-untyped-def]
    """Add one scan taken at ``pose`` to a map: cells that its beams passed become freer, those that they hit fuller.

    Returns the new number of surfels. ``touched`` is filled in.
    """
    columns = rows = len(touched) * TILE
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    inv = 1.0 / resolution
    half_u = 0.5 * columns
    half_v = 0.5 * rows
    x0 = (pose[0] + c * sensor[0] - s * sensor[1]) * inv + half_u
    y0 = (pose[1] + s * sensor[0] + c * sensor[1]) * inv + half_v
    if not (abs(x0) < FARTHEST and abs(y0) < FARTHEST):
        return count
    cells = log_odds.reshape(-1)
    owners = index.reshape(-1)
    for i in range(len(hits)):
        x1 = (pose[0] + c * hits[i, 0] - s * hits[i, 1]) * inv + half_u
        y1 = (pose[1] + s * hits[i, 0] + c * hits[i, 1]) * inv + half_v
        _carve(cells, owners, surfels, touched, resolution, x0, y0, x1, y1, 1)
    for i in range(len(clear)):
        x1 = (pose[0] + c * clear[i, 0] - s * clear[i, 1]) * inv + half_u
        y1 = (pose[1] + s * clear[i, 0] + c * clear[i, 1]) * inv + half_v
        _carve(cells, owners, surfels, touched, resolution, x0, y0, x1, y1, 0)
    for i in range(len(hits)):
        px = pose[0] + c * hits[i, 0] - s * hits[i, 1]
        py = pose[1] + s * hits[i, 0] + c * hits[i, 1]
        nx = c * hits[i, 2] - s * hits[i, 3]
        ny = s * hits[i, 2] + c * hits[i, 3]
        u = int(px * inv + half_u)
        v = int(py * inv + half_v)
        if u < REACH or v < REACH or u >= columns - REACH or v >= rows - REACH:
            continue
        touched[v >> SHIFT, u >> SHIFT] = True
        tile = ((v >> SHIFT) * len(touched) + (u >> SHIFT)) << 2 * SHIFT
        cell = tile + ((v & (TILE - 1)) << SHIFT) + (u & (TILE - 1))
        cells[cell] = min(LIMIT, cells[cell] + HIT)
        k = owners[cell]
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
        _claim(owners, surfels, k, len(touched), resolution, v, u, px, py)
        owners[cell] = k
        for corner_v in (v - REACH, v + REACH):
            for corner_u in (u - REACH, u + REACH):
                touched[corner_v >> SHIFT, corner_u >> SHIFT] = True
    return count
