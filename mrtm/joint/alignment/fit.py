"""What two surfaces that lie on each other say of their relative pose, and how sure it is.

Three things make an alignment wrong. Points scatter about their wall: many points average that. Errors common to a
stretch of wall do not average within it. And each map is bent: the poses its scans were drawn at drift away from its
origin, most where little was in view and along directions in which the walls say nothing. That no fit shows; the map
itself knows of it (``Bends``).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from frontend import se2
from frontend.local_map import Bends
from frontend.records import FloatArray
from mrtm.joint.alignment.surface import Surface, partners, rotation

REACH = 0.15  # metres between the points of a pair
PATCH = 1.5  # metres of a wall that share an error
POINT, COMMON = 0.005, 0.003  # metres: least standard deviation of a point's own error, and of a patch's
NORMAL_NOISE = 0.01  # variance of a normal's direction, rad^2: makes a bare wall seem to say something along itself
FLOOR = 0.002  # metres: of every alignment, for slips within a map; from simulated pairs in six kinds of buildings
SAMPLE = 200  # points at which a map's error is looked up


@dataclass(frozen=True, slots=True)
class Fit:
    """How ``b`` lies on ``a`` at a pose.

    Attributes:
        pairs: points of b that have a partner in a.
        residual: rms distance of a point to its partner's line, metres.
        information: (3, 3) of the points alone, in the frame of b; singular along a corridor.
        drift: (3, 3) covariance that the bends of both maps add, in the frame of b.
        shares: (k,) of a's places and of b's, that the points were drawn from, as of ``Bends.shares``.
    """

    pairs: int
    residual: float
    information: FloatArray
    drift: FloatArray
    shares: tuple[FloatArray, FloatArray]


def fit(a: Surface, b: Surface, a_T_b: FloatArray) -> Fit:
    """Measure how ``b`` lies on ``a`` at (3,) ``a_T_b``, an optimum."""
    in_a, in_b = partners(a, b, a_T_b, REACH)
    if len(in_b) == 0:
        nowhere = np.zeros(len(a.bends.places)), np.zeros(len(b.bends.places))
        return Fit(0, np.inf, np.zeros((3, 3)), np.zeros((3, 3)), nowhere)
    b_T_a = se2.inverse(a_T_b)
    turn = rotation(b_T_a[2])
    points, lines = b.points[in_b], a.normals[in_a] @ turn.T
    residuals = np.einsum("ni,ni->n", lines, points - a.points[in_a] @ turn.T - b_T_a[:2])
    weights = _weights(residuals, _patches(points, b.normals[in_b]))
    jacobian = np.column_stack([lines, lines[:, 1] * points[:, 0] - lines[:, 0] * points[:, 1]])
    information = (jacobian * weights[:, None]).T @ jacobian
    # Normals that err by a little in any direction see a little in every direction: that much is not knowledge.
    x, y = weights @ points
    square = weights @ np.square(points).sum(axis=1)
    noise = np.array([[weights.sum(), 0.0, -y], [0.0, weights.sum(), x], [-y, x, square]])
    values, vectors = np.linalg.eigh(information - NORMAL_NOISE * noise)
    carried = se2.adjoint(b_T_a)
    shares = _shares(a.bends, a.points[in_a]), _shares(b.bends, points)
    drift = _drift(b.bends, shares[1]) + carried @ _drift(a.bends, shares[0]) @ carried.T
    drift[:2, :2] += FLOOR**2 * np.eye(2)
    residual = float(np.sqrt(np.mean(np.square(residuals))))
    return Fit(len(points), residual, (vectors * np.maximum(values, 0.0)) @ vectors.T, drift, shares)


def _patches(points: FloatArray, normals: FloatArray) -> npt.NDArray[np.int64]:
    """The patch (n,) each point belongs to: a square of the plane and one of eight directions."""
    direction = np.round(np.arctan2(normals[:, 1], normals[:, 0]) * 4.0 / np.pi).astype(np.int64) % 8
    column, row = np.floor((points - points.min(axis=0)) / PATCH).astype(np.int64).T
    return np.asarray(np.unique((row * (column.max() + 1) + column) * 8 + direction, return_inverse=True)[1])


def _weights(residuals: FloatArray, patch: npt.NDArray[np.int64]) -> FloatArray:
    """The information (n,) of each point, 1/m^2, of which a patch of n has n / (own^2 + n common^2).

    Own and common errors are told apart by how residuals vary within patches and between them.
    """
    count = np.bincount(patch)
    means = np.bincount(patch, residuals) / count
    own = np.square(residuals - means[patch]).sum() / max(1, len(residuals) - len(count))
    common = float(np.average(np.square(means), weights=count)) - own * len(count) / len(residuals)
    return np.asarray(1.0 / (max(POINT**2, own) + count * max(COMMON**2, common)))[patch]


def _shares(bends: Bends, points: FloatArray) -> FloatArray:
    """(k,) of a map's places that (n > 0, 2) ``points``, together, were drawn from."""
    return np.asarray(bends.shares(points[:: -(-len(points) // SAMPLE)]).mean(axis=0))


def _drift(bends: Bends, shares: FloatArray) -> FloatArray:
    """(3, 3) covariance, in the map's frame, of what was drawn from ``shares`` of its places against its origin."""
    return np.asarray(bends.errors(shares[None])[0]) if len(shares) else np.zeros((3, 3))
