"""What a finished local map can still give to the poses it was made of.

Inside a vertex a pose is only as good as the filter was at that time, with half a map. Once the map is whole, every
scan is matched against it again and the matches are tied together by odometry; then poses and map are adjusted
together, and the map is drawn anew from the better poses.
"""

import math

import numpy as np
from numba import njit, prange

from frontend import se2
from frontend.adjust import Adjusted, adjust
from frontend.grid import TILE, Maps, at, insert
from frontend.matching import match
from frontend.parameters import FilterParameters
from frontend.points import Points
from frontend.records import FloatArray

ROUNDS = 3  # of drawing the map and matching against it, at most
SETTLED = 0.02  # metres: no further round if no pose moved more
LEASH = np.diag([1.0 / 0.05**2, 1.0 / 0.05**2, 1.0 / 0.03**2])  # information that keeps a match near where it starts
TAIL = 9.0  # squared Mahalanobis distance at which odometry has half its weight
SMOOTHING_STEPS = 3  # Gauss-Newton steps
OBJECTION = 1.0  # log-likelihood of the scans, as the filter weighs them, that being tracked back must not cost
DRAW_DISTANCE = 0.10  # metres or
DRAW_ANGLE = 0.10  # radians between the scans that the map is drawn from


@njit(cache=True, nogil=True, parallel=True)
def _match_all(log_odds, index, surfels, resolution, hits, ends, poses, information, sigma, hessians, log_likelihoods):  # type: ignore[no-untyped-def]  # fmt: skip
    for i in prange(len(poses)):
        first = ends[i - 1] if i else 0
        scan = hits[first : ends[i]]
        prior = poses[i].copy()
        _, _, _, log_likelihoods[i] = match(
            log_odds, index, surfels, resolution, scan, poses[i], prior, information, sigma, hessians[i]
        )


@njit(cache=True, nogil=True)
def _track_back(log_odds, index, surfels, resolution, hits, ends, poses, increments, variances, sigma):  # type: ignore[no-untyped-def]
    """Replace every pose but the last by the best match about where odometry has it, seen from the one after it."""
    information, hessian = np.zeros((3, 3)), np.empty((3, 3))
    for i in range(len(poses) - 2, -1, -1):
        theta = poses[i + 1, 2] - increments[i + 1, 2]
        c = math.cos(theta)
        s = math.sin(theta)
        poses[i, 0] = poses[i + 1, 0] - c * increments[i + 1, 0] + s * increments[i + 1, 1]
        poses[i, 1] = poses[i + 1, 1] - s * increments[i + 1, 0] - c * increments[i + 1, 1]
        poses[i, 2] = theta
        for k in range(3):
            information[k, k] = 1.0 / variances[i + 1, k]
        scan = hits[ends[i - 1] if i else 0 : ends[i]]
        match(log_odds, index, surfels, resolution, scan, poses[i], poses[i].copy(), information, sigma, hessian)


@njit(cache=True, nogil=True)
def _smooth(poses, matched, hessians, motions, variances, out):  # type: ignore[no-untyped-def]
    """One Gauss-Newton step of the chain: scan matches as unary, odometry as binary factors; block tridiagonal.

    A binary factor has a Cauchy tail, as odometry may lie.
    """
    n = len(poses)
    diagonal = np.zeros((n, 3, 3))
    upper = np.zeros((n, 3, 3))
    right = np.zeros((n, 3))
    for i in range(n):
        e = poses[i] - matched[i]
        diagonal[i] += hessians[i]
        right[i] -= hessians[i] @ e
    for i in range(1, n):
        theta = poses[i - 1, 2]
        c = math.cos(theta)
        s = math.sin(theta)
        dx = poses[i, 0] - poses[i - 1, 0]
        dy = poses[i, 1] - poses[i - 1, 1]
        e = np.empty(3)
        e[0] = c * dx + s * dy - motions[i, 0]
        e[1] = c * dy - s * dx - motions[i, 1]
        t = poses[i, 2] - poses[i - 1, 2] - motions[i, 2]
        e[2] = t - 2.0 * math.pi * math.floor((t + math.pi) / (2.0 * math.pi))
        a = np.zeros((3, 3))
        a[0, 0] = -c
        a[0, 1] = -s
        a[0, 2] = c * dy - s * dx
        a[1, 0] = s
        a[1, 1] = -c
        a[1, 2] = -c * dx - s * dy
        a[2, 2] = -1.0
        b = np.zeros((3, 3))
        b[0, 0] = c
        b[0, 1] = s
        b[1, 0] = -s
        b[1, 1] = c
        b[2, 2] = 1.0
        w = np.zeros((3, 3))
        q = 0.0
        for k in range(3):
            q += e[k] * e[k] / variances[i, k]
        scale = 1.0 / (1.0 + q / TAIL)
        for k in range(3):
            w[k, k] = scale / variances[i, k]
        diagonal[i - 1] += a.T @ w @ a
        diagonal[i] += b.T @ w @ b
        upper[i - 1] += a.T @ w @ b
        right[i - 1] -= a.T @ (w @ e)
        right[i] -= b.T @ (w @ e)
    for i in range(1, n):
        f = np.linalg.solve(diagonal[i - 1], upper[i - 1]).T
        diagonal[i] -= f @ upper[i - 1]
        right[i] -= f @ right[i - 1]
    step = np.linalg.solve(diagonal[n - 1], right[n - 1])
    out[n - 1] = poses[n - 1] + step
    for i in range(n - 2, -1, -1):
        step = np.linalg.solve(diagonal[i], right[i] - upper[i] @ step)
        out[i] = poses[i] + step


@njit(cache=True, nogil=True)
def _far_from(known, resolution, pose, hits, out):  # type: ignore[no-untyped-def]
    """Copy the hits that no surfel of the ``known`` index is near; returns how many."""
    columns = rows = len(known) * TILE
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    n = 0
    for i in range(len(hits)):
        u = int((pose[0] + c * hits[i, 0] - s * hits[i, 1]) / resolution + 0.5 * columns)
        v = int((pose[1] + s * hits[i, 0] + c * hits[i, 1]) / resolution + 0.5 * rows)
        if u < 0 or v < 0 or u >= columns or v >= rows or at(known, v, u) == 0:
            out[n] = hits[i]
            n += 1
    return n


@njit(cache=True, nogil=True)
def _draw(log_odds, index, surfels, count, touched, resolution, hits, ends, clear, clear_ends, sensor, poses, known):  # type: ignore[no-untyped-def]
    """Draw scans taken at ``poses``; with a ``known`` index (else of size 0) only what is far from its surfels."""
    last = -1
    new = np.empty_like(hits[: ends.max() if known.size else 0])
    for i in range(len(poses)):
        if last >= 0:
            dx = poses[i, 0] - poses[last, 0]
            dy = poses[i, 1] - poses[last, 1]
            turn = poses[i, 2] - poses[last, 2]
            turn = abs(turn - 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi)))
            if dx * dx + dy * dy < DRAW_DISTANCE * DRAW_DISTANCE and turn < DRAW_ANGLE:
                continue
        last = i
        first = ends[i - 1] if i else 0
        clear_first = clear_ends[i - 1] if i else 0
        scan = hits[first : ends[i]]
        if known.size:
            scan = new[: _far_from(known, resolution, poses[i], scan, new)]
        count = insert(
            log_odds, index, surfels, count, touched, resolution, poses[i],
            scan, clear[clear_first : clear_ends[i]], sensor,
        )  # fmt: skip
    return count


def _drawn(
    base: Maps | None, packed: "_Packed", poses: FloatArray, parameters: FilterParameters, only_new: bool = False
) -> Maps:
    maps = Maps.empty(1, parameters.map_width, parameters.resolution)
    known = np.empty((0, 0, 0, 0), np.uint16)
    if base is not None:
        maps.copy_from(base, np.zeros(1, np.int64))
        if only_new:
            known = base.index[0]
    m = maps
    m.counts[0] = _draw(
        m.log_odds[0], m.index[0], m.surfels[0], m.counts[0], m.touched[0], m.resolution,
        packed.hits, packed.ends, packed.clear, packed.clear_ends, packed.sensor, poses, known,
    )  # fmt: skip
    return maps


class _Packed:
    """Many scans in one piece, as the kernels take them."""

    def __init__(self, points: list[Points]) -> None:
        self.hits = np.concatenate([p.hits for p in points])
        self.ends = np.cumsum([len(p.hits) for p in points])
        self.clear = np.concatenate([p.clear for p in points])
        self.clear_ends = np.cumsum([len(p.clear) for p in points])
        self.sensor = points[0].sensor


def refine(
    points: list[Points], poses: FloatArray, increments: FloatArray, variances: FloatArray, base: Maps | None,
    parameters: FilterParameters,
) -> tuple[Adjusted, Maps]:  # fmt: skip
    """Better poses for the scans of one visit to a vertex, and the vertex's map drawn from them.

    Args:
        points: the n scans.
        poses: (n, 3) local_T_robot as the filter left them.
        increments: (n, 3) odometry from the scan before; the first is not used.
        variances: (n, 3) of the increments, robot frame.
        base: what earlier visits knew (a stack of one); it stays, and holds the new poses in its frame. Without it the
            first pose keeps its place.

    Returns:
        poses with their covariances in the map as it was, or from the first pose on, and the new map, a stack of one.
    """
    packed = _Packed(points)
    origin = poses[0]
    # What is known already is not drawn at first: a visit that began a little off would agree with itself.
    maps = _drawn(base, packed, poses, parameters, only_new=True)
    for _ in range(ROUNDS):
        before = poses
        poses = _matched(maps, packed, poses, increments, variances, parameters)
        if base is None:
            poses = se2.compose(origin, se2.between(poses[0], poses))
        maps = _drawn(base, packed, poses, parameters, only_new=True)
        if np.abs(poses - before)[:, :2].max() < SETTLED:
            break
    poses[:, 2] = se2.wrap(poses[:, 2])
    known = 0 if base is None else int(base.counts[0])
    adjusted = adjust(packed.hits, packed.ends, poses, increments, variances, maps, known, parameters.sigma)
    return adjusted, _drawn(base, packed, adjusted.poses, parameters)


def localise(
    points: list[Points], poses: FloatArray, increments: FloatArray, variances: FloatArray, known: Maps,
    parameters: FilterParameters,
) -> Adjusted:  # fmt: skip
    """Better poses for scans in a ``known`` map (a stack of one), which stays as it is; else as ``refine``."""
    packed = _Packed(points)
    poses = _tracked_back(known, packed, poses, increments, variances, parameters)
    for _ in range(ROUNDS):
        before = poses
        poses = _matched(known, packed, poses, increments, variances, parameters)
        if np.abs(poses - before)[:, :2].max() < SETTLED:
            break
    poses[:, 2] = se2.wrap(poses[:, 2])
    return adjust(packed.hits, packed.ends, poses, increments, variances, known, int(known.counts[0]), parameters.sigma)


def _matches(
    maps: Maps, packed: _Packed, poses: FloatArray, parameters: FilterParameters
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The first n scans against the map: poses (n, 3), their informations (n, 3, 3) and log-likelihoods (n,)."""
    matched, hessians, log_likelihoods = poses.copy(), np.empty((len(poses), 3, 3)), np.empty(len(poses))
    _match_all(
        maps.log_odds[0], maps.index[0], maps.surfels[0], maps.resolution,
        packed.hits, packed.ends, matched, LEASH, parameters.sigma, hessians, log_likelihoods,
    )  # fmt: skip
    return matched, hessians, log_likelihoods


def _tracked_back(
    known: Maps, packed: _Packed, poses: FloatArray, increments: FloatArray, variances: FloatArray,
    parameters: FilterParameters,
) -> FloatArray:  # fmt: skip
    """Poses (n, 3) in a known map, from the last of them back along odometry to the first, if that is likelier.

    A robot that comes in by where the map knows only one wall takes itself to be anywhere along it, preferably where
    more of what it sees is known. It jumps or slides to its place when it sees more; from there the way back is plain.
    Odometry alone, which may lie, does not decide: the scans must fit as well.
    """
    back = poses.copy()
    _track_back(
        known.log_odds[0], known.index[0], known.surfels[0], known.resolution,
        packed.hits, packed.ends, back, increments, variances, parameters.sigma,
    )  # fmt: skip
    ways = [_matched(known, packed, p, increments, variances, parameters) for p in (poses, back)]
    scans, odometry = np.empty(2), np.empty(2)  # log-likelihoods, as the filter weighs a particle
    for i, way in enumerate(ways):
        _, _, of_scans = _matches(known, packed, way, parameters)
        off = se2.between(se2.compose(way[:-1], increments[1:]), way[1:])
        scans[i] = parameters.independence * of_scans.sum()
        odometry[i] = -0.5 * TAIL * np.log1p((off**2 / variances[1:]).sum(axis=1) / TAIL).sum()
    likelier = scans[1] + odometry[1] > scans[0] + odometry[0]
    return ways[1] if likelier and scans[1] > scans[0] - OBJECTION else ways[0]


def _matched(
    maps: Maps, packed: _Packed, poses: FloatArray, increments: FloatArray, variances: FloatArray,
    parameters: FilterParameters,
) -> FloatArray:  # fmt: skip
    """Every scan matched against the map, and the chain (n, 3) that best agrees with the matches and with odometry."""
    matched, hessians, _ = _matches(maps, packed, poses, parameters)
    hessians += 1e-3 * np.eye(3)
    poses = matched
    for _ in range(SMOOTHING_STEPS):
        result = np.empty_like(poses)
        _smooth(poses, matched, hessians, increments, variances, result)
        poses = result
    return poses
