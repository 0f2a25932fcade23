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
from frontend.grid import NX, NY, TILE, Maps, N, X, Y, at
from frontend.matching import CORE, FACING, LAST_GATE
from frontend.records import FloatArray

IntArray = npt.NDArray[np.int64]

STEP_DISTANCE = 0.2  # metres or
STEP_ANGLE = 0.2  # radians between the poses that are adjusted,
MOST_POSES = 120  # or more, if they would be more than this
ROUNDS = 3  # Gauss-Newton steps
SETTLED = 5e-4  # metres and radians: no further step if no pose moved more
DAMPING = 1.0 / 0.1**2  # information that keeps each step near where it starts
PINNED = 1e8  # information that holds the first pose
LOOSE = 1e-4  # information every pose has of its own, against singular systems
TAIL = 9.0  # squared Mahalanobis distance at which odometry has half its weight
STRAIGHT = 0.6  # length of the mean normal of a surfel that is of one wall, not of a corner
WALL = 0.5  # metres to both sides over which a wall's direction is found
PARALLEL = 0.8  # cosine between normals, and
FLAT = 0.03  # metres off the line, within which surfels are of one wall
LEAST_SURFELS = 4  # that make a wall,
LEAST_SPREAD = 0.05  # metres, and how far along it they scatter at least
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


@njit(cache=True, nogil=True)
def _normals(index, surfels, count, resolution, out):  # type: ignore[no-untyped-def]
    """Unit normals (count, 2) of the surfels that are lines, of the wall through each and its neighbours; else zero.

    A surfel's own normal is off by a few hundredths of a radian: over a long wall that would add up to information on
    the place along it, of which there is none.
    """
    rows = columns = len(index) * TILE
    inv = 1.0 / resolution
    steps = int(WALL * inv)
    for k in range(1, count):
        out[k] = 0.0
        length = math.sqrt(surfels[k, NX] ** 2 + surfels[k, NY] ** 2)
        if surfels[k, N] <= 0.0 or length <= STRAIGHT:
            continue
        nx = surfels[k, NX] / length
        ny = surfels[k, NY] / length
        out[k, 0] = nx
        out[k, 1] = ny
        total = sa = sd = saa = sad = 0.0
        found = 0
        last = 0
        for t in range(-steps, steps + 1):
            u = int((surfels[k, X] - t * ny * resolution) * inv + 0.5 * columns)
            v = int((surfels[k, Y] + t * nx * resolution) * inv + 0.5 * rows)
            if u < 0 or v < 0 or u >= columns or v >= rows:
                continue
            j = at(index, v, u)
            if j == 0 or j == last or surfels[j, N] <= 0.0:
                continue
            last = j
            agree = surfels[j, NX] * nx + surfels[j, NY] * ny
            dx = surfels[j, X] - surfels[k, X]
            dy = surfels[j, Y] - surfels[k, Y]
            d = nx * dx + ny * dy
            a = nx * dy - ny * dx
            if agree < PARALLEL or abs(d) > FLAT + 0.1 * abs(a):
                continue
            w = min(surfels[j, N], 10.0)
            found += 1
            total += w
            sa += w * a
            sd += w * d
            saa += w * a * a
            sad += w * a * d
        if found < LEAST_SURFELS:
            continue
        spread = saa - sa * sa / total
        if spread < LEAST_SPREAD * LEAST_SPREAD * total:
            continue
        slope = (sad - sa * sd / total) / spread
        scale = 1.0 / math.sqrt(1.0 + slope * slope)
        out[k, 0] = scale * (nx + slope * ny)
        out[k, 1] = scale * (ny - slope * nx)


@njit(cache=True, nogil=True)
def _observe(index, surfels, normals, resolution, hits, starts, ends, poses, sigma, scan, surfel, jacobian, error, weight):  # type: ignore[no-untyped-def]  # noqa: E501  # fmt: skip
    """The endpoints that lie on a line: scan, surfel, (3,) derivative of the distance by the pose, distance, robust
    weight in units of ``1 / sigma**2``. Returns how many."""
    rows = columns = len(index) * TILE
    inv = 1.0 / resolution
    core = 1.0 / (sigma * sigma * CORE * CORE)
    n = 0
    for i in range(len(poses)):
        x, y, theta = poses[i]
        c = math.cos(theta)
        s = math.sin(theta)
        for q in range(starts[i], ends[i]):
            rx = c * hits[q, 0] - s * hits[q, 1]
            ry = s * hits[q, 0] + c * hits[q, 1]
            u = int((rx + x) * inv + 0.5 * columns)
            v = int((ry + y) * inv + 0.5 * rows)
            if u < 0 or v < 0 or u >= columns or v >= rows:
                continue
            k = at(index, v, u)
            if k <= 0 or surfels[k, N] <= 0.0:
                continue
            dx = rx + x - surfels[k, X]
            dy = ry + y - surfels[k, Y]
            nx = normals[k, 0]
            ny = normals[k, 1]
            if dx * dx + dy * dy >= LAST_GATE * LAST_GATE or (nx == 0.0 and ny == 0.0):
                continue
            hx = c * hits[q, 2] - s * hits[q, 3]
            hy = s * hits[q, 2] + c * hits[q, 3]
            if (hx != 0.0 or hy != 0.0) and hx * nx + hy * ny <= FACING:
                continue
            e = nx * dx + ny * dy
            w = 1.0 / (1.0 + e * e * core)
            scan[n] = i
            surfel[n] = k
            jacobian[n, 0] = nx
            jacobian[n, 1] = ny
            jacobian[n, 2] = ny * rx - nx * ry
            error[n] = e
            weight[n] = w * w
            n += 1
    return n


@njit(cache=True, nogil=True)
def _reduce(scan, surfel, jacobian, error, weight, known, information, right):  # type: ignore[no-untyped-def]
    """Add observations to the lower triangle of ``information`` (3m, 3m) and to ``right`` (3m,), surfels eliminated.

    Everything in units of ``1 / sigma**2``. ``known`` (count,) is the information that surfels have already. Returns
    the weighted square sum of the residuals, of the robust weights, and the number of surfels that were free.
    """
    count = len(known)
    starts = np.zeros(count + 1, np.int64)
    for q in range(len(surfel)):
        starts[surfel[q] + 1] += 1
    for k in range(count):
        starts[k + 1] += starts[k]
    order = np.empty(len(surfel), np.int64)
    place = starts[:-1].copy()
    for q in range(len(surfel)):
        order[place[surfel[q]]] = q
        place[surfel[q]] += 1
    seen_by = np.empty(len(right) // 3, np.int64)
    cross = np.empty((len(right) // 3, 3))
    squares = 0.0
    weights = 0.0
    free = 0
    for k in range(count):
        if starts[k + 1] == starts[k]:
            continue
        total = known[k]
        free += total == 0.0
        offset = 0.0
        n = 0
        for t in range(starts[k], starts[k + 1]):
            q = order[t]
            i = scan[q]
            if n == 0 or seen_by[n - 1] != i:
                seen_by[n] = i
                cross[n] = 0.0
                n += 1
            w = weight[q]
            total += w
            offset += w * error[q]
            squares += w * error[q] * error[q]
            weights += w
            for a in range(3):
                wj = w * jacobian[q, a]
                cross[n - 1, a] += wj
                right[3 * i + a] -= wj * error[q]
                for b in range(3):
                    information[3 * i + a, 3 * i + b] += wj * jacobian[q, b]
        squares -= offset * offset / total
        for p in range(n):
            i = 3 * seen_by[p]
            for a in range(3):
                part = cross[p, a] / total
                right[i + a] += part * offset
                for r in range(p + 1):
                    j = 3 * seen_by[r]
                    for b in range(3):
                        information[i + a, j + b] -= part * cross[r, b]
    return squares, weights, free


@njit(cache=True, nogil=True)
def _chain(poses, motions, variances, information, right):  # type: ignore[no-untyped-def]
    """Add odometry between successive poses; a Cauchy tail, as it may lie."""
    jacobian = np.zeros((3, 6))
    e = np.empty(3)
    for i in range(1, len(poses)):
        c = math.cos(poses[i - 1, 2])
        s = math.sin(poses[i - 1, 2])
        dx = poses[i, 0] - poses[i - 1, 0]
        dy = poses[i, 1] - poses[i - 1, 1]
        t = poses[i, 2] - poses[i - 1, 2] - motions[i - 1, 2]
        e[0] = c * dx + s * dy - motions[i - 1, 0]
        e[1] = c * dy - s * dx - motions[i - 1, 1]
        e[2] = t - 2.0 * math.pi * math.floor((t + math.pi) / (2.0 * math.pi))
        jacobian[0] = (-c, -s, c * dy - s * dx, c, s, 0.0)
        jacobian[1] = (s, -c, -c * dx - s * dy, -s, c, 0.0)
        jacobian[2] = (0.0, 0.0, -1.0, 0.0, 0.0, 1.0)
        q = 0.0
        for k in range(3):
            q += e[k] * e[k] / variances[i - 1, k]
        first = 3 * i - 3
        for k in range(3):
            w = 1.0 / (1.0 + q / TAIL) / variances[i - 1, k]
            for a in range(6):
                right[first + a] -= w * jacobian[k, a] * e[k]
                for b in range(6):
                    information[first + a, first + b] += w * jacobian[k, a] * jacobian[k, b]


@njit(cache=True, nogil=True, fastmath=True)
def _factorise(a):  # type: ignore[no-untyped-def]
    """Cholesky factor in place of the lower triangle; returns the first column of each row that is not zero.

    Not LAPACK's: it knows nothing of the zeros before a row's first entry, and its threads wait for each other.
    """
    n = len(a)
    first = np.empty(n, np.int64)
    for i in range(n):
        f = 0
        while a[i, f] == 0.0:
            f += 1
        first[i] = f
        for j in range(f, i):
            begin = max(f, first[j])
            total = a[i, j]
            for k in range(begin, j):
                total -= a[i, k] * a[j, k]
            a[i, j] = total / a[j, j]
        total = a[i, i]
        for k in range(f, i):
            total -= a[i, k] * a[i, k]
        a[i, i] = math.sqrt(total)
    return first


@njit(cache=True, nogil=True, fastmath=True)
def _solve(a, first, right):  # type: ignore[no-untyped-def]
    """The solution of the factorised system, in ``right``."""
    for i in range(len(a)):
        for k in range(first[i], i):
            right[i] -= a[i, k] * right[k]
        right[i] /= a[i, i]
    for i in range(len(a) - 1, -1, -1):
        right[i] /= a[i, i]
        for k in range(first[i], i):
            right[k] -= a[i, k] * right[i]


@njit(cache=True, nogil=True, fastmath=True)
def _marginals(a, first, headings):  # type: ignore[no-untyped-def]
    """(m, 3, 3) diagonal blocks of the inverse of the factorised system, each in the frame of its pose."""
    n = len(a)
    blocks = np.zeros((n // 3, 3, 3))
    inverse = np.zeros((n, n))
    for i in range(n):
        row = inverse[i]
        for k in range(first[i], i):
            for j in range(k + 1):
                row[j] -= a[i, k] * inverse[k, j]
        row[i] = 1.0
        for j in range(i + 1):
            row[j] /= a[i, i]
        for m in range(i // 3 + 1):
            for p in range(3):
                for q in range(3):
                    blocks[m, p, q] += row[3 * m + p] * row[3 * m + q]
    rotation = np.eye(3)
    for m in range(n // 3):
        c = math.cos(headings[m])
        s = math.sin(headings[m])
        rotation[0, 0] = rotation[1, 1] = c
        rotation[0, 1] = s
        rotation[1, 0] = -s
        blocks[m] = rotation @ blocks[m] @ rotation.T
    return blocks


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
    _normals(maps.index[0], maps.surfels[0], len(prior), maps.resolution, normals)

    def system(at: FloatArray) -> _System:
        size = 3 * len(chosen)
        scan, surfel = np.empty(len(hits), np.int64), np.empty(len(hits), np.int64)
        jacobian, error, weight = np.empty((len(hits), 3)), np.empty(len(hits)), np.empty(len(hits))
        n = _observe(
            maps.index[0], maps.surfels[0], normals, maps.resolution, hits, starts, ends[chosen], at, sigma,
            scan, surfel, jacobian, error, weight,
        )  # fmt: skip
        information, right = np.zeros((size, size)), np.zeros(size)
        squares, weights, free = _reduce(
            scan[:n], surfel[:n], jacobian[:n], error[:n], weight[:n], prior, information, right
        )
        freedom = max(0.0, weights - free - size)
        return _System(information, right, squares, freedom, surfel[:n], scan[:n], error[:n], weight[:n])

    def anchored(at: FloatArray, scans: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        total, right = scans.copy(), right.copy()
        total[np.diag_indices_from(total)] += LOOSE
        if not known:
            total[range(3), range(3)] += PINNED
        _chain(at, motions, spread, total, right)
        return total, right

    at = poses[chosen]
    for _ in range(ROUNDS):
        s = system(at)
        total, right = anchored(at, s.scans / sigma**2, s.right / sigma**2)
        total[np.diag_indices_from(total)] += DAMPING
        _solve(total, _factorise(total), right)
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
    covariances = _marginals(information, _factorise(information), at[:, 2])
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
