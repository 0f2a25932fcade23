"""The normal equations of ``adjust``: endpoints on lines that may move along their normals, and odometry."""

import math

import numpy as np
from numba import njit

from frontend.grid import NX, NY, TILE, N, X, Y, at
from frontend.matching import CORE, FACING, LAST_GATE

TAIL = 9.0  # squared Mahalanobis distance at which odometry has half its weight
STRAIGHT = 0.6  # length of the mean normal of a surfel that is of one wall, not of a corner
WALL = 0.5  # metres to both sides over which a wall's direction is found
PARALLEL = 0.8  # cosine between normals, and
FLAT = 0.03  # metres off the line, within which surfels are of one wall
LEAST_SURFELS = 4  # that make a wall,
LEAST_SPREAD = 0.05  # metres, and how far along it they scatter at least


@njit(cache=True, nogil=True)
def normals_of_walls(index, surfels, count, resolution, out):  # type: ignore[no-untyped-def]
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
def observe(index, surfels, normals, resolution, hits, starts, ends, poses, sigma, scan, surfel, jacobian, error, weight):  # type: ignore[no-untyped-def]  # noqa: E501  # fmt: skip
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
def reduce(scan, surfel, jacobian, error, weight, known, information, right):  # type: ignore[no-untyped-def]
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
def chain(poses, motions, variances, information, right):  # type: ignore[no-untyped-def]
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
