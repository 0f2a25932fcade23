"""Where one local map may lie on another: every pose the guess allows, scored (Olson 2009, "Real-time correlative
scan matching")."""

import math

import numba
import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter

from frontend import se2
from frontend.records import FloatArray
from mrtm.joint.alignment.surface import Surface, rotation

SIGMAS = 3.0  # of the guess searched to each side, and at least
BASIN_XY, BASIN_THETA = 0.3, 0.06  # metres and radians more: no guess is that good
MAX_XY, MAX_THETA = 8.0, 0.6  # metres and radians searched to each side at most
STEP = 0.2  # metres between two poses, at the middle of the overlap if they differ in heading
CELL = 0.1  # metres
POINTS = 400  # of b that are looked up
DIRECTIONS = 8  # of normals told apart
PEAKS = 10
WORTH = 0.3  # of the best score: lower peaks are not worth refining
PRIOR_WEIGHT = 0.01  # of the best score, for each unit of chi2 against the guess: decides between equals only


def hypotheses(a: Surface, b: Surface, guess: FloatArray, covariance: FloatArray) -> FloatArray:
    """Poses that bring surfaces of ``b`` onto surfaces of ``a`` that face alike, best first.

    Args:
        guess: (3,) a_T_b.
        covariance: (3, 3) of the guess, in the frame of b.

    Returns:
        (k, 3) a_T_b, not refined: within a step and a half of an optimum; k may be 0.
    """
    sigma_theta = math.sqrt(covariance[2, 2])
    # Position, given heading: of a map far from the root most of its uncertainty comes with the heading's.
    lever = covariance[:2, 2] / covariance[2, 2]
    conditional = covariance[:2, :2] - np.outer(lever, covariance[:2, 2])
    reach = min(MAX_XY, SIGMAS * math.sqrt(max(0.0, np.linalg.eigvalsh(conditional)[1])) + BASIN_XY)
    reach_theta = min(MAX_THETA, SIGMAS * sigma_theta + BASIN_THETA)
    chosen, radius = _near_overlap(a, b, guess, reach, reach_theta)
    if len(chosen) == 0:
        return np.empty((0, 3))
    step_theta = STEP / max(radius, 2.0)
    side = math.ceil(reach_theta / step_theta)
    turns: FloatArray = step_theta * np.arange(-side, side + 1, dtype=np.float64)
    shifts = (rotation(guess[2]) @ np.outer(lever, turns)).T
    points, normals = b.points[chosen], b.normals[chosen]
    field, origin = _field(a)
    half = math.ceil(reach / STEP)
    scores = np.empty((len(turns), 2 * half + 1, 2 * half + 1), np.int32)
    _score(field, (guess[:2] - origin) / CELL, points / CELL, np.arctan2(normals[:, 1], normals[:, 0]),
           guess[2] + turns, shifts / CELL, round(STEP / CELL), scores)  # fmt: skip
    return _peaks(scores, guess, turns, shifts, conditional, sigma_theta)


def _near_overlap(
    a: Surface, b: Surface, guess: FloatArray, reach: float, reach_theta: float
) -> tuple[npt.NDArray[np.int64], float]:
    """An even choice of the points of ``b`` that may lie on ``a``, and their distance from b's origin (rms)."""
    placed = b.points @ rotation(guess[2]).T + guess[:2]
    slack = reach + reach_theta * np.hypot(b.points[:, 0], b.points[:, 1])
    low, high = a.points.min(axis=0, initial=np.inf), a.points.max(axis=0, initial=-np.inf)
    outside = np.maximum(np.maximum(low - placed, placed - high), 0.0).max(axis=1, initial=0.0)
    possible = np.flatnonzero(outside <= slack)
    chosen = possible[:: max(1, len(possible) // POINTS)]
    return chosen, float(np.sqrt(np.mean(np.square(b.points[chosen]).sum(axis=1)))) if len(chosen) else 0.0


def _field(a: Surface) -> tuple[npt.NDArray[np.uint8], FloatArray]:
    """(DIRECTIONS, height, width) how near a surface is that faces so, 0 to 2, and the corner of its first cell.

    A point counts in its own direction and the two beside it.
    """
    margin = 3 * CELL
    origin = a.points.min(axis=0) - margin
    width, height = np.ceil((a.points.max(axis=0) + margin - origin) / CELL).astype(int)
    field = np.zeros((DIRECTIONS, height, width), np.uint8)
    facing = np.floor(np.arctan2(a.normals[:, 1], a.normals[:, 0]) * DIRECTIONS / (2.0 * np.pi)).astype(np.int64)
    _draw(np.floor((a.points - origin) / CELL).astype(np.int64), facing, field)
    return field, origin


@numba.njit(cache=True, nogil=True)
def _draw(cells, facing, field):  # type: ignore[no-untyped-def]
    """Each point's share of the cells around it: full within a cell, half within two."""
    directions = len(field)
    for k in range(len(cells)):
        for i in range(-2, 3):
            for j in range(-2, 3):
                square = i * i + j * j
                if square <= 5:
                    share = 2 if square <= 2 else 1
                    for turn in range(-1, 2):
                        layer = field[(facing[k] + turn) % directions]
                        layer[cells[k, 1] + i, cells[k, 0] + j] = max(layer[cells[k, 1] + i, cells[k, 0] + j], share)


@numba.njit(cache=True, nogil=True)
def _score(field, centre, points, facing, thetas, shifts, step, scores):  # type: ignore[no-untyped-def]
    """Sum of the field under the points at every pose of the lattice; lengths in cells."""
    directions, height, width = field.shape
    size = scores.shape[1]
    half = size // 2
    for t in range(len(thetas)):
        layer = scores[t]
        layer[:] = 0
        c = math.cos(thetas[t])
        s = math.sin(thetas[t])
        for i in range(len(points)):
            angle = facing[i] + thetas[t]
            direction = int(math.floor(angle * directions / (2.0 * math.pi))) % directions
            u = int(math.floor(c * points[i, 0] - s * points[i, 1] + centre[0] + shifts[t, 0])) - half * step
            v = int(math.floor(s * points[i, 0] + c * points[i, 1] + centre[1] + shifts[t, 1])) - half * step
            first = max(0, -(u // step))
            last = min(size, (width - 1 - u) // step + 1)
            for y in range(size):
                row = v + y * step
                if 0 <= row < height:
                    for x in range(first, last):
                        layer[y, x] += field[direction, row, u + x * step]


def _peaks(
    scores: npt.NDArray[np.int32], guess: FloatArray, turns: FloatArray, shifts: FloatArray, conditional: FloatArray,
    sigma_theta: float,
) -> FloatArray:  # fmt: skip
    """The best poses of the lattice that no neighbour beats; ties go to the one nearest the guess."""
    half = scores.shape[1] // 2
    offset = STEP * np.arange(-half, half + 1)
    information = rotation(guess[2]) @ np.linalg.inv(conditional + 1e-6 * np.eye(2)) @ rotation(guess[2]).T
    x, y = np.meshgrid(offset, offset)
    chi2 = information[0, 0] * x * x + 2.0 * information[0, 1] * x * y + information[1, 1] * y * y
    chi2 = chi2[None] + np.square(turns / max(sigma_theta, 1e-6))[:, None, None]
    best = float(scores.max())
    if best <= 0.0:
        return np.empty((0, 3))
    value = scores - PRIOR_WEIGHT * best * np.minimum(chi2, 3.0 * SIGMAS**2)
    tops = np.flatnonzero((value == maximum_filter(value, 5, mode="constant", cval=-np.inf)) & (value > WORTH * best))
    tops = tops[np.argsort(-value.ravel()[tops], kind="stable")][:PEAKS]
    t, v, u = np.unravel_index(tops, value.shape)
    xy = guess[:2] + shifts[t] + np.column_stack([offset[u], offset[v]])
    return np.column_stack([xy, se2.wrap(guess[2] + turns[t])])
