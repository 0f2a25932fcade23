"""What the particle filter leaves behind when the robot leaves a vertex: a grid, the scans it was made of, a cloud."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from frontend.grid import NX, NY, UNIT, Maps, N, X, Y
from frontend.records import FloatArray


@dataclass(frozen=True, slots=True)
class Grid:
    """An occupancy grid in some frame.

    Attributes:
        log_odds: (height, width) float32, row = y, column = x; 0 where nothing is known, positive where occupied.
        resolution: metres per cell.
        origin: (2,) coordinates, in the grid's frame, of the outer corner of cell [0, 0].
    """

    log_odds: npt.NDArray[np.float32]
    resolution: float
    origin: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Bends:
    """How sure the parts of a local map are against its origin.

    A map's scans are drawn at poses that drift along walls that say nothing there: what lies about one place may be
    slipped against what lies about another, and no fit of surfaces shows it.

    Attributes:
        places: (k, 2) metres, local frame; none if nothing is known.
        covariances: (k, 3, 3) of the motion, in the tangent space at the map's origin, by which what lies about each
            place may be off.
    """

    places: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    covariances: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))


@dataclass(frozen=True, slots=True)
class LocalMap:
    """The metric map of one vertex, in the vertex's ``local`` frame.

    Attributes:
        grid: log-odds occupancy grid of the best particle.
        scans: (n,) indices of the scans taken in this vertex, into the robot's log, ascending.
        times: (n,) their times, seconds.
        poses: (n, 3) local_T_robot at each of them.
        cloud: (m, 2) points of surfaces, at most one a cell, metres.
        normals: (m, 2) their unit normals, towards where they were seen from; zero where none is known.
        bends: how sure its parts are.
    """

    grid: Grid
    scans: npt.NDArray[np.int64]
    times: FloatArray
    poses: FloatArray
    cloud: FloatArray
    normals: FloatArray
    bends: Bends = field(default_factory=Bends)


def contents(maps: Maps) -> tuple[Grid, FloatArray, FloatArray]:
    """Grid, cloud (m, 2) and normals (m, 2), as of ``LocalMap``, of the first map of a stack."""
    log_odds, corner = maps.known(0)
    if not log_odds.size:  # a blind laser leaves nothing: one unknown cell
        log_odds = np.zeros((1, 1), np.int8)
    surfels = maps.surfels[0, 1 : maps.counts[0]].astype(np.float64)
    surfels = surfels[surfels[:, N] > 0]
    normals = surfels[:, NX : NY + 1]
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return (
        Grid(log_odds.astype(np.float32) / UNIT, maps.resolution, corner),
        surfels[:, X : Y + 1],
        np.where(lengths > 0.5, normals / np.maximum(lengths, 0.5), 0.0),
    )
