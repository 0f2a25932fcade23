"""How crisp a joint map is, whoever made it: what the local maps that see a place leave undecided about it.

Every local map gives each cell of the joint grid a probability of being occupied. The joint probability is their mean
(the linear opinion pool: M. Stone, "The opinion pool", 1961), and what counts is its entropy, over the cells that two
or more maps know. Maps that fit agree, cell by cell: the mean is as sure as they are. A wall that two maps put into
different cells becomes two half-grey ones. Unlike a sum of log-odds the mean cannot outvote a map, so nothing hides.

The measure knows no poses, points, normals or distances, so it is neither what the EM maximises nor what the on-line
alignment does. It says how much does not fit to within a cell, not how far it is off, and cannot see a bend that all
maps share: that is for the relations and the trajectory error.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numba
import numpy as np
import numpy.typing as npt
from scipy.special import entr

from frontend import se2
from frontend.local_map import Grid, LocalMap
from frontend.records import FloatArray
from mrtm.joint.fusion import drawable

Maps = Sequence[tuple[gtsam.Pose2, LocalMap]]

KNOWN = 1.4
"""Log-odds a map must have to say anything of a cell (p = 0.8): what one or two readings grazed is noise of its own."""


@dataclass(frozen=True, slots=True)
class Crispness:
    """Of the cells that two or more local maps know.

    Attributes:
        entropy: mean bits a cell, of the mean of the maps' probabilities; 0 is crisp. NaN if there is no such cell.
        disagreement: the part of it that comes from the maps' contradicting each other (their Jensen-Shannon
            divergence). The rest each map leaves undecided by itself, whatever the poses.
        area: m^2 of such cells.
    """

    entropy: float
    disagreement: float
    area: float


def crispness(maps: Maps, resolution: float = 0.05) -> Crispness:
    """Measure the joint map that local maps make at the poses joint_T_local.

    Args:
        resolution: metres between the places looked at; each map is asked for the cell the place is in.
    """
    corners = [_corners(pose, grid) for pose, local_map in maps if (grid := _known_part(local_map.grid)) is not None]
    if not corners:
        return Crispness(math.nan, math.nan, 0.0)
    box = np.concatenate(corners)
    resolution = drawable(box, resolution)
    entropy, disagreement = opinions(maps, np.array([box.min(axis=0), box.max(axis=0)]), resolution)
    cells = int(np.isfinite(entropy).sum())
    if cells == 0:
        return Crispness(math.nan, math.nan, 0.0)
    return Crispness(float(np.nanmean(entropy)), float(np.nanmean(disagreement)), cells * resolution**2)


def opinions(maps: Maps, box: FloatArray, resolution: float) -> tuple[FloatArray, FloatArray]:
    """Entropy and disagreement, bits, of each cell (row = y, column = x) of a part of the joint map.

    Args:
        box: (2, 2) least and largest x, y, metres.

    Returns:
        Two arrays (height, width), NaN where fewer than two maps know the cell.
    """
    width, height = np.maximum(np.ceil((box[1] - box[0]) / resolution), 1).astype(int)
    # Sums over the maps that know a cell: of probabilities, of their own entropies, and how many they are.
    sums = np.zeros((height, width, 3), np.float32)
    for pose, local_map in maps:
        grid = _known_part(local_map.grid)
        if grid is not None:
            local_T_joint = se2.inverse(np.array([pose.x(), pose.y(), pose.theta()]))
            own = _bits(1.0 / (1.0 + np.exp(-grid.log_odds.astype(np.float64)))).astype(np.float32)
            _add(sums, grid.log_odds, own, grid.resolution, grid.origin, local_T_joint, box[0], resolution)
    seen = np.where(sums[..., 2] >= 2.0, sums[..., 2], np.nan).astype(np.float64)
    entropy = _bits(sums[..., 0] / seen)
    return entropy, entropy - sums[..., 1] / seen


def _bits(p: FloatArray) -> npt.NDArray[Any]:
    return np.asarray((entr(p) + entr(1.0 - p)) / math.log(2.0))


def _known_part(grid: Grid) -> Grid | None:
    known = np.abs(grid.log_odds) > KNOWN
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if len(rows) == 0:
        return None
    part = np.ascontiguousarray(grid.log_odds[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])
    return Grid(part, grid.resolution, grid.origin + grid.resolution * np.array([columns[0], rows[0]], np.float64))


def _corners(pose: gtsam.Pose2, grid: Grid) -> FloatArray:
    height, width = grid.log_odds.shape
    local = grid.origin + grid.resolution * np.array([[0, 0], [width, 0], [0, height], [width, height]], np.float64)
    placed = se2.compose(np.array([pose.x(), pose.y(), pose.theta()]), np.column_stack([local, np.zeros(4)]))
    return np.asarray(placed[:, :2])


@numba.njit(cache=True, parallel=True)
def _add(
    sums: Any, log_odds: Any, own: Any, cell: float, origin: Any, local_T_joint: Any, low: Any, resolution: float
) -> None:
    """Add one map; each row of the result is one thread's own."""
    height, width = log_odds.shape
    cos, sin = np.cos(local_T_joint[2]), np.sin(local_T_joint[2])
    for row in numba.prange(sums.shape[0]):
        y = low[1] + (row + 0.5) * resolution
        for column in range(sums.shape[1]):
            x = low[0] + (column + 0.5) * resolution
            c = int(np.floor((cos * x - sin * y + local_T_joint[0] - origin[0]) / cell))
            r = int(np.floor((sin * x + cos * y + local_T_joint[1] - origin[1]) / cell))
            if 0 <= r < height and 0 <= c < width and abs(log_odds[r, c]) > KNOWN:
                sums[row, column, 0] += 1.0 / (1.0 + np.exp(-log_odds[r, c]))
                sums[row, column, 1] += own[r, c]
                sums[row, column, 2] += 1.0
