"""Scan-to-map matching: Gauss-Newton on point-to-line distances, and a correlative search where that cannot start.

An endpoint is compared with the nearest surfel of the map: across the surface only where the surfel is a line, in both
directions where it is a corner or a post. So a corridor leaves the direction along it free, and the Hessian says so.
"""

import math

import numpy as np
from numba import njit

from frontend.grid import NX, NY, TILE, N, X, Y, at

MAX_ITERATIONS = 15
FIRST_GATE = 0.30  # metres: how far from a surfel an endpoint may lie in the first iteration,
LAST_GATE = 0.10  # and in the last
GATE_SHRINK = 0.6  # per iteration
COHERENCE = 0.6  # length of a surfel's mean normal above which it is a line
FACING = 0.5  # cosine between the normals of an endpoint and its surfel below which they are different surfaces
POST = 2.0  # a corner's endpoints scatter this many times wider than a wall's
CORE = 2.0  # Geman-McClure: residuals beyond this many sigma lose their say
STEP_XY = 2e-4  # metres and
STEP_THETA = 5e-5  # radians: the iteration has converged
FREE = -10  # log-odds (steps) below which a cell is known to be free

GONE, SPOT, LINE = range(3)  # what a surfel is to the matcher


@njit(cache=True, nogil=True, fastmath=True)
def match(log_odds, index, surfels, resolution, hits, start, prior, information, sigma, hessian):  # type: ignore[no-untyped-def]
    """Find the pose near ``start`` that fits ``hits`` to the map, weighed against a prior on the pose.

    Args:
        start: (3,) pose, overwritten by the result.
        prior: (3,) pose the motion model expects.
        information: (3, 3) of the prior, in map coordinates; its tail is heavy (Cauchy), as odometry may lie.
        sigma: standard deviation of an endpoint across a wall, metres.
        hessian: (3, 3) out: information of the scan alone at the result, map coordinates.

    Returns:
        (fit, near, free, log_likelihood): the sum over endpoints of how well the map explains each (0 to 1); how many
        have a surfel; how many lie in free space instead; and the log-likelihood relative to that of a perfect fit.
        Endpoints in unknown space count for nothing.
    """
    columns = rows = len(index) * TILE
    inv = 1.0 / resolution
    half_u = 0.5 * columns
    half_v = 0.5 * rows
    x, y = start[0], start[1]
    turn = start[2] - prior[2]  # both on the same side of pi
    theta = prior[2] + turn - 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
    weight_line = 1.0 / (sigma * sigma)
    weight_post = weight_line / (POST * POST)
    core = 1.0 / (CORE * CORE)
    gate = FIRST_GATE
    last = False
    # A pass has three loops, so that the first and the third, which are arithmetic only, become vector instructions.
    n = len(hits)
    hx = np.empty(n)
    hy = np.empty(n)
    for i in range(n):
        hx[i] = hits[i, 0]
        hy[i] = hits[i, 1]
    rx = np.empty(n)
    ry = np.empty(n)
    us = np.empty(n, np.int32)
    vs = np.empty(n, np.int32)
    # The surfel that each endpoint met last: mostly it meets the same one in the next pass.
    met = np.zeros(n, np.int64)
    sx = np.empty(n)
    sy = np.empty(n)
    snx = np.empty(n)
    sny = np.empty(n)
    kind = np.empty(n, np.int8)
    # Pairs of an endpoint and a line: distance, its gradient by x, y and theta; and the squared ones of all pairs.
    e = np.empty(n)
    j0 = np.empty(n)
    j1 = np.empty(n)
    j2 = np.empty(n)
    squares = np.empty(n)
    iteration = 0
    while True:
        final = last or iteration == MAX_ITERATIONS
        c = math.cos(theta)
        s = math.sin(theta)
        for i in range(n):
            rx[i] = c * hx[i] - s * hy[i]
            ry[i] = s * hx[i] + c * hy[i]
            us[i] = np.int32((rx[i] + x) * inv + half_u)
            vs[i] = np.int32((ry[i] + y) * inv + half_v)
        a00 = a01 = a02 = a11 = a12 = a22 = 0.0
        b0 = b1 = b2 = 0.0
        lines = 0
        posts = 0
        free = 0
        gate2 = gate * gate
        for i in range(n):
            u = us[i]
            v = vs[i]
            if u < 0 or v < 0 or u >= columns or v >= rows:
                continue
            k = at(index, v, u)
            if k > 0:
                if k != met[i]:
                    met[i] = k
                    sx[i] = surfels[k, X]
                    sy[i] = surfels[k, Y]
                    nx = surfels[k, NX]
                    ny = surfels[k, NY]
                    length = math.sqrt(nx * nx + ny * ny)
                    kind[i] = GONE if surfels[k, N] <= 0.0 else LINE if length > COHERENCE else SPOT
                    if kind[i] == LINE:
                        snx[i] = nx / length
                        sny[i] = ny / length
                dx = rx[i] + x - sx[i]
                dy = ry[i] + y - sy[i]
                d2 = dx * dx + dy * dy
                if kind[i] != GONE and d2 < gate2:
                    if kind[i] == SPOT:
                        m = d2 * weight_post
                        w = 1.0 / (1.0 + m * core)
                        w = weight_post * w * w
                        a00 += w
                        a02 -= w * ry[i]
                        a11 += w
                        a12 += w * rx[i]
                        a22 += w * (rx[i] * rx[i] + ry[i] * ry[i])
                        b0 += w * dx
                        b1 += w * dy
                        b2 += w * (rx[i] * dy - ry[i] * dx)
                        posts += 1
                        squares[n - posts] = m
                        continue
                    nx = snx[i]
                    ny = sny[i]
                    p = hits[i, 2]
                    q = hits[i, 3]
                    if (p == 0.0 and q == 0.0) or (c * p - s * q) * nx + (s * p + c * q) * ny > FACING:
                        e[lines] = nx * dx + ny * dy
                        j0[lines] = nx
                        j1[lines] = ny
                        j2[lines] = ny * rx[i] - nx * ry[i]
                        lines += 1
                        continue
            if final and at(log_odds, v, u) < FREE:
                free += 1
        for i in range(lines):
            m = e[i] * e[i] * weight_line
            squares[i] = m
            w = 1.0 / (1.0 + m * core)
            w = weight_line * w * w
            a00 += w * j0[i] * j0[i]
            a01 += w * j0[i] * j1[i]
            a02 += w * j0[i] * j2[i]
            a11 += w * j1[i] * j1[i]
            a12 += w * j1[i] * j2[i]
            a22 += w * j2[i] * j2[i]
            b0 += w * j0[i] * e[i]
            b1 += w * j1[i] * e[i]
            b2 += w * j2[i] * e[i]
        if final:
            break
        e0 = x - prior[0]
        e1 = y - prior[1]
        e2 = theta - prior[2]
        i0 = information[0, 0] * e0 + information[0, 1] * e1 + information[0, 2] * e2
        i1 = information[1, 0] * e0 + information[1, 1] * e1 + information[1, 2] * e2
        i2 = information[2, 0] * e0 + information[2, 1] * e1 + information[2, 2] * e2
        w = 1.0 / (1.0 + (e0 * i0 + e1 * i1 + e2 * i2) / 9.0)
        a00 += w * information[0, 0]
        a01 += w * information[0, 1]
        a02 += w * information[0, 2]
        a11 += w * information[1, 1]
        a12 += w * information[1, 2]
        a22 += w * information[2, 2]
        b0 += w * i0
        b1 += w * i1
        b2 += w * i2
        c00 = a11 * a22 - a12 * a12
        c01 = a02 * a12 - a01 * a22
        c02 = a01 * a12 - a02 * a11
        det = a00 * c00 + a01 * c01 + a02 * c02
        iteration += 1
        if det <= 0.0:
            last = True
            continue
        d0 = (c00 * b0 + c01 * b1 + c02 * b2) / det
        d1 = (c01 * b0 + (a00 * a22 - a02 * a02) * b1 + (a01 * a02 - a00 * a12) * b2) / det
        d2 = (c02 * b0 + (a01 * a02 - a00 * a12) * b1 + (a00 * a11 - a01 * a01) * b2) / det
        x -= d0
        y -= d1
        theta -= d2
        if gate <= LAST_GATE and abs(d0) < STEP_XY and abs(d1) < STEP_XY and abs(d2) < STEP_THETA:
            last = True
        gate = max(LAST_GATE, gate * GATE_SHRINK)
    start[0] = x
    start[1] = y
    start[2] = theta
    hessian[0, 0] = a00
    hessian[0, 1] = hessian[1, 0] = a01
    hessian[0, 2] = hessian[2, 0] = a02
    hessian[1, 1] = a11
    hessian[1, 2] = hessian[2, 1] = a12
    hessian[2, 2] = a22
    squares[lines : lines + posts] = squares[n - posts :]
    fit = 0.0
    log_likelihood = -0.5 / core * free
    for i in range(lines + posts):
        m = squares[i]
        fit += 1.0 / (1.0 + 0.25 * m)
        log_likelihood -= 0.5 * m / (1.0 + m * core)
    return fit, lines + posts, free, log_likelihood


@njit(cache=True, nogil=True)
def _near(peak, x, y, theta, step_xy, step_theta):  # type: ignore[no-untyped-def]
    """Whether a pose of the lattice is within two steps of a peak."""
    return (
        abs(peak[0] - x) <= 2.01 * step_xy
        and abs(peak[1] - y) <= 2.01 * step_xy
        and abs(peak[2] - theta) <= 2.01 * step_theta
    )


@njit(cache=True, nogil=True, fastmath=True)
def search(log_odds, index, surfels, resolution, hits, centre, reach_xy, step_xy, reach_theta, step_theta, information, stride, peaks, scores):  # type: ignore[no-untyped-def]  # noqa: E501  # fmt: skip
    """Correlative search: score all poses of a lattice around ``centre`` and keep the best local ones.

    The score of a pose is the fraction of endpoints near a surfel less that of endpoints in free space, less the
    prior's squared Mahalanobis distance (``information`` (3, 3), map coordinates) with a Cauchy tail.

    Args:
        peaks: (K, 3) out: best poses, best first, no two within two steps of each other.
        scores: (K,) out.

    Returns:
        number of peaks found.
    """
    columns = rows = len(index) * TILE
    inv = 1.0 / resolution
    half_u = 0.5 * columns
    half_v = 0.5 * rows
    n_xy = int(math.ceil(reach_xy / step_xy))
    n_theta = int(math.ceil(reach_theta / step_theta))
    size = len(peaks)
    found = 0
    used = (len(hits) + stride - 1) // stride
    if used == 0:
        return 0
    rx = np.empty(used, np.float32)
    ry = np.empty(used, np.float32)
    for it in range(-n_theta, n_theta + 1):
        theta = centre[2] + it * step_theta
        c = math.cos(theta)
        s = math.sin(theta)
        for i in range(used):
            rx[i] = (c * hits[i * stride, 0] - s * hits[i * stride, 1] + centre[0]) * inv + half_u
            ry[i] = (s * hits[i * stride, 0] + c * hits[i * stride, 1] + centre[1]) * inv + half_v
        for iy in range(-n_xy, n_xy + 1):
            for ix in range(-n_xy, n_xy + 1):
                ox = ix * step_xy * inv
                oy = iy * step_xy * inv
                near = 0
                free = 0
                for i in range(used):
                    u = int(rx[i] + ox)
                    v = int(ry[i] + oy)
                    if 0 <= u < columns and 0 <= v < rows:
                        k = at(index, v, u)
                        if k > 0:
                            near += 1
                        elif at(log_odds, v, u) < FREE:
                            free += 1
                e0 = ix * step_xy
                e1 = iy * step_xy
                e2 = it * step_theta
                q = (
                    information[0, 0] * e0 * e0 + information[1, 1] * e1 * e1 + information[2, 2] * e2 * e2
                    + 2.0 * (information[0, 1] * e0 * e1 + information[0, 2] * e0 * e2 + information[1, 2] * e1 * e2)
                )  # fmt: skip
                score = (near - free) / used - 0.05 * math.log(1.0 + q / 9.0)
                if found == size and score <= scores[size - 1]:
                    continue
                x = centre[0] + e0
                y = centre[1] + e1
                # A neighbour of a better peak is dropped; its own neighbours that are worse are.
                beaten = False
                for k in range(found):
                    if scores[k] >= score and _near(peaks[k], x, y, theta, step_xy, step_theta):
                        beaten = True
                        break
                if beaten:
                    continue
                kept = 0
                for k in range(found):
                    if not _near(peaks[k], x, y, theta, step_xy, step_theta):
                        peaks[kept] = peaks[k]
                        scores[kept] = scores[k]
                        kept += 1
                found = min(kept + 1, size)
                place = found - 1
                while place > 0 and scores[place - 1] < score:
                    scores[place] = scores[place - 1]
                    peaks[place] = peaks[place - 1]
                    place -= 1
                scores[place] = score
                peaks[place, 0] = x
                peaks[place, 1] = y
                peaks[place, 2] = theta
    return found
