"""A local map in a few kilobytes: what joint maps are fused from and aligned by, and no more.

- Cells keep one of five log-odds (VALUES): what a vote in ``mrtm.joint.fusion`` tells apart, cropped to what is known.
- Every occupied cell is a point of the cloud. One whose normal is known lies on the line that was seen, in ANGLES
  directions and in steps of 1/STEPS cell from the cell's centre, where the line is nearest to it: alignment point to
  line measures across the line, and where the point lay along it is not kept. One without is the cell's centre.
  Points in cells that are not occupied, which later beams went through, are left out.

Each column of numbers is arranged so that neighbours are alike, and compressed by itself (zstandard).
"""

import math
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt
import zstandard

from frontend.local_map import Grid
from frontend.records import FloatArray
from mrtm.joint.alignment.agreement import FREE
from mrtm.joint.fusion import FREE_VOTE, OCCUPIED_VOTE
from mrtm.team.checks import MOST_POINTS, RecordError, check_frame

Cells = npt.NDArray[np.uint8]

VALUES = np.array([-FREE_VOTE, 0.0, 0.85, 2.0, OCCUPIED_VOTE], np.float32)
"""Log-odds: free, unknown, occupied by one hit of the filter's, by some, by many."""

CUTS = (FREE, 0.2, 1.4, 3.0)
"""Borders between them."""

ANGLES = 64
STEPS = 8

_UNKNOWN, _OCCUPIED = 1, 2  # in VALUES; from _OCCUPIED on it is occupied
_TURN = 2.0 * math.pi / ANGLES
_DIRECTIONS = np.column_stack([np.cos(_TURN * np.arange(ANGLES)), np.sin(_TURN * np.arange(ANGLES))])
_HALF = 0.499  # of a cell: a point that has travelled is found in its cell again
_FARTHEST = _HALF * np.abs(_DIRECTIONS).sum(axis=1)  # a line of each direction passes from the centre, cells
_LAST = np.floor(STEPS * _FARTHEST).astype(np.int64)  # and steps; on the other side one more, as floor counts
_MOST = int(_LAST.max()) + 1  # added to a step to make it positive
_TRITS = np.array([1, 3, 9, 27])
_TRITS_OF: Cells = (np.arange(81)[:, None] // _TRITS % 3).astype(np.uint8)


class PackedMap(NamedTuple):
    """A grid and its cloud, as they travel.

    Attributes:
        height, width: cells.
        resolution, x, y: metres; the corner of cell [0, 0].
        cells: free, unknown or occupied; a byte is four cells of a column, one above the other.
        levels: how occupied the occupied cells are, four a byte.
        flags: a bit for each occupied cell: its normal is known.
        angles: directions of the normals, less the one before in Z-order.
        offsets: steps along the normals.
    """

    height: int
    width: int
    resolution: float
    x: float
    y: float
    cells: bytes
    levels: bytes
    flags: bytes
    angles: bytes
    offsets: bytes


def pack_map(grid: Grid, cloud: FloatArray, normals: FloatArray) -> PackedMap:
    """Keep of a local map what the module says; ``cloud`` (m, 2) metres, ``normals`` (m, 2) unit or zero."""
    values, corner = _crop(np.digitize(grid.log_odds, CUTS).astype(np.uint8))
    height, width = values.shape
    origin = grid.origin + grid.resolution * corner
    occupied = values >= _OCCUPIED
    strips = np.pad(np.minimum(values, _OCCUPIED), ((0, -height % 4), (0, 0))).reshape(-1, 4, width)
    known, at, angles, steps = _surface(occupied, (cloud - origin) / grid.resolution, normals)
    order = _z_order(at)
    turns = np.diff(angles[order], prepend=0) % ANGLES
    return PackedMap(
        height,
        width,
        float(grid.resolution),
        float(origin[0]),
        float(origin[1]),
        _deflate(_pack_trits(strips.transpose(0, 2, 1))),
        _deflate(_pack_trits(values[occupied] - _OCCUPIED)),
        _deflate(np.packbits(known)),
        _deflate(turns.astype(np.uint8)),
        _deflate((steps[order] + _MOST).astype(np.uint8)),
    )


def unpack_map(packed: PackedMap, what: str) -> tuple[Grid, FloatArray, FloatArray]:
    """The grid, cloud and normals; ``pack_map`` of them gives ``packed`` again.

    Raises:
        RecordError: naming ``what`` and the field, if it is not what ``pack_map`` makes. Nothing is allocated that the
            bounds of a grid do not allow.
    """
    height, width, resolution = packed.height, packed.width, packed.resolution
    origin = np.array([packed.x, packed.y])
    check_frame(what, (height, width), resolution, origin)
    strips = _trits(packed.cells, 4 * -(-height // 4) * width, what, "cells")
    log_odds = np.empty((height, width), np.float32)
    count = _lay_out(strips, _TRITS_OF, VALUES, log_odds)
    if count > MOST_POINTS:
        raise RecordError(f"{what}: cells has {count} occupied ones; must be at most {MOST_POINTS}")
    at = np.empty((count, 2), np.int64)
    _raise(_trits(packed.levels, count, what, "levels"), _TRITS_OF, VALUES, log_odds, at)

    flags = _inflate(packed.flags, -(-count // 8), what, "flags")
    known = np.unpackbits(flags, count=count).astype(bool)
    order = np.flatnonzero(known)[_z_order(at[known])]
    turns = _inflate(packed.angles, len(order), what, "angles")
    angles = np.cumsum(turns, dtype=np.int64) % ANGLES
    steps = _inflate(packed.offsets, len(order), what, "offsets").astype(np.int64) - _MOST
    if np.any(np.abs(steps + 0.5) > _LAST[angles] + 0.5):
        raise RecordError(f"{what}: offsets has a point outside of its cell")

    normals = np.zeros((count, 2))
    normals[order] = _DIRECTIONS[angles]
    points = at[:, ::-1] + 0.5
    points[order] += _on_line(steps, angles)
    return Grid(log_odds, resolution, origin), origin + resolution * points, normals


def _crop(values: Cells) -> tuple[Cells, FloatArray]:
    """The part of the cells that is known, one cell if there is none; column and row where it begins."""
    known = values != _UNKNOWN
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if len(rows) == 0:
        return values[:1, :1], np.zeros(2)
    part = values[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return part, np.array([columns[0], rows[0]], np.float64)


def _surface(
    occupied: npt.NDArray[np.bool_], points: FloatArray, normals: FloatArray
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """What is known of the surface in the occupied cells, from ``points`` (m, 2) in cells.

    Returns:
        (occupied,) whether the normal is known; (k, 2) row and column of those cells, in the order of the rows; (k,)
        their directions and (k,) steps along them.
    """
    height, width = occupied.shape
    column, row = np.floor(points).astype(np.int64).T
    usable = (row >= 0) & (row < height) & (column >= 0) & (column < width) & normals.any(axis=1)
    usable[usable] = occupied[row[usable], column[usable]]
    cells, first = np.unique(row[usable] * width + column[usable], return_index=True)
    points, normals = points[usable][first], normals[usable][first]
    at = np.column_stack([cells // width, cells % width])
    angles = np.rint(np.arctan2(normals[:, 1], normals[:, 0]) / _TURN).astype(np.int64) % ANGLES
    along = np.einsum("ij,ij->i", points - at[:, ::-1] - 0.5, _DIRECTIONS[angles])
    steps = np.clip(np.floor(STEPS * along).astype(np.int64), -_LAST[angles] - 1, _LAST[angles])
    return np.isin(np.flatnonzero(occupied), cells), at, angles, steps


def _on_line(steps: npt.NDArray[np.int64], angles: npt.NDArray[np.int64]) -> FloatArray:
    """(k, 2) the point of each line that is nearest to the centre of its cell and within it; from there, in cells."""
    distances = np.clip((steps + 0.5) / STEPS, -_FARTHEST[angles], _FARTHEST[angles])
    normals = _DIRECTIONS[angles]
    foot = distances[:, None] * normals
    points: FloatArray = foot.clip(-_HALF, _HALF)
    outside = np.flatnonzero((points != foot).any(axis=1))  # slide along the line to the border
    short = np.abs(normals[outside]).argmin(axis=1)
    rest = distances[outside] - np.einsum("ij,ij->i", points[outside], normals[outside])
    points[outside, short] += rest / normals[outside, short]
    return points


def _z_order(at: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
    """The order along Morton's curve of cells (k, 2), which keeps neighbours together."""
    code = np.zeros(len(at), np.int64)
    for bit in range(12):
        code |= ((at[:, 1] >> bit & 1) << 2 * bit) | ((at[:, 0] >> bit & 1) << 2 * bit + 1)
    return np.argsort(code)


def _pack_trits(values: Cells) -> Cells:
    values = np.pad(values.ravel(), (0, -values.size % 4))
    packed: Cells = (values.reshape(-1, 4) @ _TRITS).astype(np.uint8)
    return packed


def _trits(data: bytes, count: int, what: str, field: str) -> Cells:
    """Bytes of four trits each, so many of these in all."""
    packed = _inflate(data, -(-count // 4), what, field)
    if np.any(packed >= len(_TRITS_OF)):
        raise RecordError(f"{what}: {field} has a byte of {packed.max()}; must be below {len(_TRITS_OF)}")
    return packed


@numba.njit(cache=True)
def _lay_out(strips, trits_of, values, log_odds):  # type: ignore[no-untyped-def]
    """Free, unknown and occupied cells of a grid from its strips; how many are occupied."""
    height, width = log_odds.shape
    count = 0
    for row in range(height):
        first, place = row // 4 * width, row % 4
        for column in range(width):
            kind = trits_of[strips[first + column], place]
            log_odds[row, column] = values[kind]
            count += kind == _OCCUPIED
    return count


@numba.njit(cache=True)
def _raise(levels, trits_of, values, log_odds, at):  # type: ignore[no-untyped-def]
    """Give the occupied cells their levels, and list their rows and columns."""
    n = 0
    for row in range(log_odds.shape[0]):
        for column in range(log_odds.shape[1]):
            if log_odds[row, column] > 0.0:
                log_odds[row, column] = values[_OCCUPIED + trits_of[levels[n // 4], n % 4]]
                at[n, 0], at[n, 1] = row, column
                n += 1


def _deflate(column: Cells) -> bytes:
    return zstandard.ZstdCompressor(level=19).compress(column.tobytes())


def _inflate(data: bytes, size: int, what: str, field: str) -> Cells:
    """The ``size`` bytes that ``data`` must hold; their number is compared before room is made for them."""
    try:
        claimed = zstandard.get_frame_parameters(data).content_size
        if claimed != size:
            raise RecordError(f"{what}: {field} claims {claimed} bytes; must be {size}")
        content = zstandard.ZstdDecompressor().decompress(data, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise RecordError(f"{what}: {field} is not a whole zstandard frame: {error}") from error
    if len(content) != size:
        raise RecordError(f"{what}: {field} has {len(content)} bytes; must be {size}")
    return np.frombuffer(content, np.uint8)
