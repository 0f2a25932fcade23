"""Poses and map of one visit adjusted together, and how well the poses are then known.

Matching scans against a map that is drawn from their own poses cannot see the map bend, and makes each pose look as
certain as if the map were the truth. Here every surfel may also move, along its normal, and the poses are those that
least squares finds for both at once: bundle adjustment with lines for points. A surfel enters linearly and is
eliminated (Schur complement), which leaves a system of the poses alone; its inverse is their covariance, with the map's
uncertainty in it. What two poses see in common ties them; where they see nothing in common, the chain of poses between
them and odometry do.

Only surfels that are lines take part: the end of a wall or a post lies wherever the last beam happened to hit it, and
along a bare corridor such points would hold falsely.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from frontend import se2
from frontend.adjust_equations import chain, normals_of_walls, observe, reduce
from frontend.grid import NX, NY, Maps, N, X, Y
from frontend.records import FloatArray
from frontend.skyline import factorise, marginals, solve

IntArray = npt.NDArray[np.int64]

STEP_DISTANCE = 0.2  # metres or
STEP_ANGLE = 0.2  # radians between the poses that are adjusted,
MOST_POSES = 120  # or more, if they would be more than this
ROUNDS = 3  # Gauss-Newton steps
SETTLED = 5e-4  # metres and radians: no further step if no pose moved more
DAMPING = 1.0 / 0.1**2  # information that keeps each step near where it starts
PINNED = 1e8  # information that holds the first pose
LOOSE = 1e-4  # information every pose has of its own, against singular systems
USUAL = 50.0  # endpoints that scatter as expected, taken for granted
INFLATION = 1.7  # of the scans' covariance for what is linearised and discretised; from simulated truth
# What the errors of neighbouring endpoints share is found by looking together at the residuals of
PATCH = 0.5  # metres of wall and
SERIES = 3  # successive poses.
LEAST_SEEN = 4  # a surfel seen less often has no residual to speak of
FORGETTING = 0.6  # metres driven after which such an error is another; from real logs' normalised innovations
ARM = 5.0  # metres to the walls, at which an error turns the robot


@dataclass(frozen=True, slots=True)
class Adjusted:
    """Attributes:
    poses: (n, 3) of all scans.
    chosen: (m,) indices of the poses that were adjusted; the first and the last are. The others follow them.
    covariances: (m, 3, 3) of each, in its own tangent frame.
    sigma: metres; how far endpoints scatter about their surfels, as if they were independent.
    """

    poses: FloatArray
    chosen: IntArray
    covariances: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True)
class _System:
    scans: FloatArray  # (3m, 3m) lower triangle, in units of 1 / sigma**2
    right: FloatArray  # (3m,) the same
    squares: float
    freedom: float
    surfel: IntArray
    scan: IntArray
    error: FloatArray
    weight: FloatArray


def adjust(
    hits: npt.NDArray[np.float32], ends: IntArray, poses: FloatArray, increments: FloatArray, variances: FloatArray,
    maps: Maps, known: int, sigma: float,
) -> Adjusted:  # fmt: skip
    """Adjust the poses of a visit together with the surfels of its map.

    Args:
        hits: (q, 4) endpoints of the n scans as in ``Points``, one scan after the other.
        ends: (n,) where each scan ends in them.
        poses: (n, 3) local_T_robot, good to a few centimetres.
        increments: (n, 3) odometry from the scan before; the first is not used.
        variances: (n, 3) of the increments, robot frame.
        maps: what was drawn from the poses, a stack of one.
        known: so many surfels at the beginning of the map are what earlier visits left, undisturbed; they hold the
            poses in their frame. Without any (0) the first pose keeps its place.
        sigma: metres, expected standard deviation of an endpoint across its wall.
    """
    chosen = _choose(poses)
    starts = np.where(chosen > 0, ends[chosen - 1], 0)
    odometry = _accumulated(increments)
    motions = se2.between(odometry[chosen[:-1]], odometry[chosen[1:]])
    spread = np.diff(np.cumsum(variances, axis=0)[chosen], axis=0)
    prior = np.zeros(int(maps.counts[0]))
    prior[:known] = np.maximum(maps.surfels[0, :known, N], 0.0)

    normals = np.empty((len(prior), 2))
    normals_of_walls(maps.index[0], maps.surfels[0], len(prior), maps.resolution, normals)

    def system(at: FloatArray) -> _System:
        size = 3 * len(chosen)
        scan, surfel = np.empty(len(hits), np.int64), np.empty(len(hits), np.int64)
        jacobian, error, weight = np.empty((len(hits), 3)), np.empty(len(hits)), np.empty(len(hits))
        n = observe(
            maps.index[0], maps.surfels[0], normals, maps.resolution, hits, starts, ends[chosen], at, sigma,
            scan, surfel, jacobian, error, weight,
        )  # fmt: skip
        information, right = np.zeros((size, size)), np.zeros(size)
        squares, weights, free = reduce(
            scan[:n], surfel[:n], jacobian[:n], error[:n], weight[:n], prior, information, right
        )
        freedom = max(0.0, weights - free - size)
        return _System(information, right, squares, freedom, surfel[:n], scan[:n], error[:n], weight[:n])

    def anchored(at: FloatArray, scans: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        total, right = scans.copy(), right.copy()
        total[np.diag_indices_from(total)] += LOOSE
        if not known:
            total[range(3), range(3)] += PINNED
        chain(at, motions, spread, total, right)
        return total, right

    at = poses[chosen]
    for _ in range(ROUNDS):
        s = system(at)
        total, right = anchored(at, s.scans / sigma**2, s.right / sigma**2)
        total[np.diag_indices_from(total)] += DAMPING
        solve(total, factorise(total), right)
        step = right.reshape(-1, 3)
        at = at + step
        if np.abs(step).max() < SETTLED:
            break
    if not known:
        at = se2.compose(poses[0], se2.between(at[0], at))
    s = system(at)
    variance = (s.squares + USUAL * sigma**2) / (s.freedom + USUAL)
    effect = _design_effect(s, maps.surfels[0, : len(prior)].astype(np.float64))
    information, _ = anchored(at, s.scans / (INFLATION * effect * variance), s.right)
    covariances = marginals(information, factorise(information), at[:, 2])
    # Of independent errors nothing is shared; the more the residuals go together, the more of them bends the map.
    covariances += _bending(at, variance * (1.0 - 1.0 / effect))
    return Adjusted(_moved(poses, chosen, at), chosen, covariances, math.sqrt(variance * effect))


def _bending(poses: FloatArray, common: float) -> FloatArray:
    """(m, 3, 3) what errors of variance ``common`` (m^2) that neighbouring endpoints share do to each pose.

    The map bends: every FORGETTING metres from the first pose there are other walls with other errors, which move and
    turn all that comes after.
    """
    offset = poses[:, :2] - poses[0, :2]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    rate = common / FORGETTING
    turning = rate / ARM**2
    angle = np.arctan2(offset[:, 1], offset[:, 0]) - poses[:, 2] + 0.5 * np.pi
    across = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(poses))], axis=1)
    heading = np.broadcast_to([0.0, 0.0, 1.0], across.shape)
    plane = np.diag([1.0, 1.0, 0.0])

    def outer(a: FloatArray, b: FloatArray, scale: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("mi,mj->mij", a, b) * scale[:, None, None])

    both = outer(across, heading, turning * distance**2 / 2.0)
    return np.asarray(
        plane * (rate * distance)[:, None, None]
        + outer(across, across, turning * distance**3 / 3.0)
        + both + np.transpose(both, (0, 2, 1))
        + outer(heading, heading, turning * distance)
    )  # fmt: skip


def _design_effect(s: _System, surfels: FloatArray) -> float:
    """How many endpoints count as one (L. Kish, "Survey Sampling", 1965); 1 for independent noise.

    The variance of sums of residuals that are near each other in space and time, over what it would be if they were
    independent.
    """
    count = len(surfels)
    mean = np.bincount(s.surfel, s.weight * s.error, count) / np.maximum(np.bincount(s.surfel, s.weight, count), 1e-9)
    often = np.bincount(s.surfel, minlength=count)[s.surfel] >= LEAST_SEEN
    r = np.where(often, s.weight * (s.error - mean[s.surfel]), 0.0)
    patch = np.floor(surfels[:, X] / PATCH) * 4096 + np.floor(surfels[:, Y] / PATCH)
    facing = np.round(np.arctan2(surfels[:, NY], surfels[:, NX]) / (np.pi / 4)) % 8
    key = ((patch * 8 + facing)[s.surfel] * 1000 + s.scan // SERIES).astype(np.int64)
    _, group = np.unique(key, return_inverse=True)
    squares = float((r**2).sum())
    return max(1.0, float((np.bincount(group, r) ** 2).sum()) / squares) if squares > 0.0 else 1.0


def _choose(poses: FloatArray) -> IntArray:
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T) / STEP_DISTANCE
    steps += np.abs(se2.wrap(np.diff(poses[:, 2]))) / STEP_ANGLE
    way = np.concatenate([[0.0], np.cumsum(steps)])
    marks = np.floor(way / max(1.0, way[-1] / MOST_POSES))
    keep = np.concatenate([[True], np.diff(marks) > 0.0])
    keep[-1] = True
    return np.flatnonzero(keep)


@njit(cache=True, nogil=True)
def _accumulated(increments):  # type: ignore[no-untyped-def]
    poses = np.zeros_like(increments)
    for i in range(1, len(increments)):
        c = math.cos(poses[i - 1, 2])
        s = math.sin(poses[i - 1, 2])
        poses[i, 0] = poses[i - 1, 0] + c * increments[i, 0] - s * increments[i, 1]
        poses[i, 1] = poses[i - 1, 1] + s * increments[i, 0] + c * increments[i, 1]
        poses[i, 2] = poses[i - 1, 2] + increments[i, 2]
    return poses


def _moved(poses: FloatArray, chosen: IntArray, at: FloatArray) -> FloatArray:
    """All poses, the chosen ones ``at`` (m, 3), those between them moved by what lies between their moves."""
    new = poses.copy()
    new[chosen] = at
    others = np.setdiff1d(np.arange(len(poses)), chosen)
    before = np.searchsorted(chosen, others, side="right") - 1
    a, z = chosen[before], chosen[before + 1]
    part = (others - a) / (z - a)
    from_a = se2.compose(new[a], se2.between(poses[a], poses[others]))
    from_z = se2.compose(new[z], se2.between(poses[z], poses[others]))
    between = from_z - from_a
    between[:, 2] = se2.wrap(between[:, 2])
    new[others] = from_a + part[:, None] * between
    new[:, 2] = se2.wrap(new[:, 2])
    return new
