"""What the particle filter leaves behind when the robot leaves a vertex: a grid, the scans it was made of, a cloud."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from frontend import se2
from frontend.grid import NX, NY, UNIT, Maps, N, X, Y
from frontend.records import FloatArray

NEAR = 3.0  # metres: poses of a map nearer than this all tell about the same of its error


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

    def extended(self, poses: FloatArray, covariances: FloatArray) -> "Bends":
        """These and those of (n, 3) ``poses`` the map was drawn at; (n, 3, 3) ``covariances`` in their own frames."""
        carry = se2.adjoint(poses)
        carried = carry @ covariances @ np.swapaxes(carry, -1, -2)
        carried = 0.5 * (carried + np.swapaxes(carried, -1, -2))
        return Bends(np.concatenate([self.places, poses[:, :2]]), np.concatenate([self.covariances, carried]))

    def shares(self, points: FloatArray) -> FloatArray:
        """(n, k) how much of what lies at (n, 2) ``points`` was drawn from each place: from the nearer ones more.

        There must be a place. The shares of a point sum to 1.
        """
        square = np.square(points[:, None] - self.places).sum(axis=-1)
        weights = 1.0 / np.square(NEAR**2 + square)
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def errors(self, shares: FloatArray) -> FloatArray:
        """(n, 3, 3), as ``covariances``, of what was drawn from the places in (n, k) ``shares``."""
        parts = shares[:, :, None] * self.roots().reshape(-1, 9)
        shape = (len(shares), -1, 3)
        return np.asarray(parts.reshape(shape).swapaxes(-1, -2) @ (self.together() @ parts).reshape(shape))

    def roots(self) -> FloatArray:
        """(k, 3, 3) symmetric roots of the covariances."""
        variances, axes = np.linalg.eigh(self.covariances)
        return np.asarray((axes * np.sqrt(np.maximum(variances, 0.0))[:, None, :]) @ np.swapaxes(axes, -1, -2))

    def together(self) -> FloatArray:
        """(k, k) how far the errors of two places are one, from 0 to 1.

        Errors gather on the way from the origin, and those of two places go together as far as their ways do: as in
        Brownian motion of several parameters (P. Levy, "Processus stochastiques et mouvement brownien", 1948).
        """
        common = self._common(self.places)
        way = np.maximum(np.diagonal(common), 1e-6)
        together = common / np.sqrt(way[:, None] * way)
        np.fill_diagonal(together, 1.0)
        return np.asarray(together)

    def following(self, points: FloatArray) -> FloatArray:
        """(n, k) by how much what lies at (n, 2) ``points`` is expected to move with each place: none at the origin.

        The mean of that Brownian motion, given what it is at the places.
        """
        whole = self._common(self.places) + 1e-6 * np.eye(len(self.places))
        return np.asarray(np.linalg.solve(whole, self._common(points).T).T)

    def _common(self, points: FloatArray) -> FloatArray:
        """(n, k) metres that the ways to (n, 2) ``points`` and to the places have in common."""
        ways = np.linalg.norm(points, axis=1)[:, None] + np.linalg.norm(self.places, axis=1)
        return np.asarray(0.5 * (ways - np.linalg.norm(points[:, None] - self.places, axis=-1)))


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
