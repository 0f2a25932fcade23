"""How far sightings lie from a prediction: the kernels shared by the vote of a pair and the joint solution.

Poses are (3,) x, y, theta, covariances (3, 3) in the frame of the child, as everywhere.
"""

import math

import numpy as np
from numba import njit

from mrtm.joint.sightings.hypotheses import BoolArray, FloatArray, IntArray, Measurements

GATE_FULL, GATE_POSITION = 16.266, 13.816
"""chi2 at 99.9 % of 3 and of 2 degrees of freedom."""


_FALSE_AREA = math.pi * 10.0**2  # m^2


def gates(full: BoolArray) -> FloatArray:
    """(n,) the 99.9 % gate of each sighting."""
    return np.where(full, GATE_FULL, GATE_POSITION)


def share_passing(spread: FloatArray, full: BoolArray, gate: FloatArray) -> FloatArray:
    """(n,) share of random false ones that would pass ``gate`` (n,): its volume over that of where they may lie.

    Args:
        spread: (n,) sqrt(det) of the innovation's covariance.
        full: (n,) whether it has three dimensions, else two.
    """
    ball = np.where(full, 4.0 / 3.0 * math.pi * gate**1.5 / (2.0 * math.pi), math.pi * gate)
    return np.asarray(ball * spread / _FALSE_AREA)


def innovations(sightings: Measurements, predicted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What the sightings say against ``predicted`` (n, 3) tail_T_head.

    Returns:
        residual (n, 3) and its derivative (n, 3, 3) by a change of tail_T_head in the frame of head. With a heading,
        ``Log(predicted^-1 measured)``; without, measured minus predicted position, and a third row of zeros.
    """
    n = len(sightings)
    residual, derivative = np.zeros((n, 3)), np.zeros((n, 3, 3))
    s = sightings
    _innovations(s.full, s.measured, s.tail_anchor, s.head_anchor, predicted, residual, derivative)
    return residual, derivative


def votes(
    sightings: Measurements,
    tail: IntArray,
    head: IntArray,
    offset: FloatArray,
    covariance: FloatArray,
    relative: FloatArray,
    covariances: FloatArray,
    first: int,
) -> FloatArray:
    """chi2 of every sighting of a pair of robots under every proposed offset; infinite where clearly out of its gate.

    A proposal is the pose ``offset`` (k, 3) of vertex ``head`` (k,) of one robot seen from ``tail`` (k,) of the other,
    with ``covariance`` (k, 3, 3). Carrying it to the vertices of a sighting adds the robots' own drift: ``relative``
    (m, m, 3) and ``covariances`` (m, m, 3, 3) between vertices of the same robot; rows before ``first`` are the one's.

    Returns:
        (k, n).
    """
    s = sightings
    order = np.lexsort((s.head, s.tail))
    chi2 = np.empty((len(tail), len(s)))
    _votes(
        order, s.tail, s.head, s.full, s.measured, s.noise, s.tail_anchor, s.head_anchor,
        tail, head, offset, covariance, relative, covariances, first, chi2,
    )  # fmt: skip
    return chi2


@njit(cache=True, inline="always")
def _wrap(angle):  # type: ignore[no-untyped-def]
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@njit(cache=True)
def compose(a, b, out):  # type: ignore[no-untyped-def]
    c, s = math.cos(a[2]), math.sin(a[2])
    x, y = a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1]
    out[2] = _wrap(a[2] + b[2])
    out[0], out[1] = x, y


@njit(cache=True)
def between(a, b, out):  # type: ignore[no-untyped-def]
    c, s = math.cos(a[2]), math.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    out[2] = _wrap(b[2] - a[2])
    out[0], out[1] = c * dx + s * dy, c * dy - s * dx


@njit(cache=True)
def _log(pose, out):  # type: ignore[no-untyped-def]
    theta = pose[2]
    half = 0.5 * theta
    k = 1.0 - half * half / 3.0 if abs(half) < 1e-4 else half / math.tan(half)
    x, y = pose[0], pose[1]
    out[0], out[1], out[2] = k * x + half * y, k * y - half * x, theta


@njit(cache=True)
def _carry(pose, covariance, out):  # type: ignore[no-untyped-def]
    """Ad(pose^-1) covariance Ad(pose^-1)': from the frame before ``pose`` to the frame after it."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x = -(c * pose[0] + s * pose[1])
    y = s * pose[0] - c * pose[1]
    # The rows of Ad(T) are (cos, -sin, y), (sin, cos, -x), (0, 0, 1) of T; here T = pose^-1.
    a00, a01, a02 = c, s, y
    a10, a11, a12 = -s, c, -x
    p00, p01, p02, p11, p12, p22 = (
        covariance[0, 0], covariance[0, 1], covariance[0, 2], covariance[1, 1], covariance[1, 2], covariance[2, 2],
    )  # fmt: skip
    b0, b1, b2 = a00 * p00 + a01 * p01 + a02 * p02, a00 * p01 + a01 * p11 + a02 * p12, a00 * p02 + a01 * p12 + a02 * p22
    d0, d1, d2 = a10 * p00 + a11 * p01 + a12 * p02, a10 * p01 + a11 * p11 + a12 * p12, a10 * p02 + a11 * p12 + a12 * p22
    out[0, 0] = b0 * a00 + b1 * a01 + b2 * a02
    out[0, 1] = out[1, 0] = b0 * a10 + b1 * a11 + b2 * a12
    out[0, 2] = out[2, 0] = b2
    out[1, 1] = d0 * a10 + d1 * a11 + d2 * a12
    out[1, 2] = out[2, 1] = d2
    out[2, 2] = p22


@njit(cache=True)
def innovation(full, measured, tail_anchor, head_anchor, predicted, pose, r, h):  # type: ignore[no-untyped-def]
    if full:
        between(predicted, measured, pose)
        _log(pose, r)
        h[:] = 0.0
        h[0, 0] = h[1, 1] = h[2, 2] = 1.0
        return
    between(tail_anchor, predicted, pose)
    turn = pose[2]
    compose(pose, head_anchor, pose)
    r[0], r[1], r[2] = measured[0] - pose[0], measured[1] - pose[1], 0.0
    # A step (x, y, theta) of the head vertex moves the robot in it by (x - theta b, y + theta a), in the vertex' frame.
    c, s = math.cos(turn), math.sin(turn)
    a, b = head_anchor[0], head_anchor[1]
    h[0, 0], h[0, 1], h[0, 2] = c, -s, -c * b - s * a
    h[1, 0], h[1, 1], h[1, 2] = s, c, -s * b + c * a
    h[2, 0] = h[2, 1] = h[2, 2] = 0.0


@njit(cache=True)
def _innovations(full, measured, tail_anchor, head_anchor, predicted, residual, derivative):  # type: ignore[no-untyped-def]
    pose = np.empty(3)
    for j in range(len(full)):
        innovation(full[j], measured[j], tail_anchor[j], head_anchor[j], predicted[j], pose, residual[j], derivative[j])


@njit(cache=True)
def _chi2(r, s, full):  # type: ignore[no-untyped-def]
    """r' S^-1 r by cofactors; of the first two if not ``full``. Infinite if surely out of the gate."""
    if r[0] * r[0] + r[1] * r[1] > GATE_FULL * (s[0, 0] + s[1, 1]):
        return np.inf  # beyond the gate even along the longest axis
    if not full:
        det = s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1]
        if det <= 0.0:
            return np.inf  # too long and thin for double precision
        return (r[0] * r[0] * s[1, 1] - 2.0 * r[0] * r[1] * s[0, 1] + r[1] * r[1] * s[0, 0]) / det
    c00 = s[1, 1] * s[2, 2] - s[1, 2] * s[1, 2]
    c01 = s[0, 2] * s[1, 2] - s[0, 1] * s[2, 2]
    c02 = s[0, 1] * s[1, 2] - s[0, 2] * s[1, 1]
    c11 = s[0, 0] * s[2, 2] - s[0, 2] * s[0, 2]
    c12 = s[0, 1] * s[0, 2] - s[0, 0] * s[1, 2]
    c22 = s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1]
    det = s[0, 0] * c00 + s[0, 1] * c01 + s[0, 2] * c02
    if det <= 0.0:
        return np.inf
    q = r[0] * (c00 * r[0] + 2.0 * (c01 * r[1] + c02 * r[2])) + r[1] * (c11 * r[1] + 2.0 * c12 * r[2])
    return (q + c22 * r[2] * r[2]) / det


@njit(cache=True)
def _votes(  # type: ignore[no-untyped-def]
    order, tails, heads, full, measured, noise, tail_anchor, head_anchor,
    from_, to, offset, offset_covariance, relative, covariances, first, chi2,
):  # fmt: skip
    origin = np.zeros(3)
    z, w, t, pose, r = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    cz, ct, s, h, hc = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(from_)):
        last_tail, last_head = -1, -1
        for j in order:
            if tails[j] != last_tail or heads[j] != last_head:
                last_tail, last_head = tails[j], heads[j]
                near, far = from_[i], to[i]
                z[:], cz[:] = offset[i], offset_covariance[i]
                if (near < first) != (last_tail < first):
                    near, far = far, near
                    between(offset[i], origin, z)
                    _carry(z, offset_covariance[i], cz)
                compose(relative[last_tail, near], z, w)
                _carry(z, covariances[last_tail, near], ct)
                ct += cz
                compose(w, relative[far, last_head], t)
                _carry(relative[far, last_head], ct, s)
                ct[:] = s + covariances[far, last_head]
            if full[j]:
                turn = _wrap(measured[j, 2] - t[2])
                if turn * turn > GATE_FULL * (ct[2, 2] + noise[j, 2, 2]):
                    chi2[i, j] = np.inf
                    continue
                innovation(True, measured[j], tail_anchor[j], head_anchor[j], t, pose, r, h)
                s[:] = ct + noise[j]
            else:
                innovation(False, measured[j], tail_anchor[j], head_anchor[j], t, pose, r, h)
                for p in range(3):
                    for q in range(3):
                        hc[p, q] = h[p, 0] * ct[0, q] + h[p, 1] * ct[1, q] + h[p, 2] * ct[2, q]
                for p in range(3):
                    for q in range(3):
                        s[p, q] = noise[j, p, q] + hc[p, 0] * h[q, 0] + hc[p, 1] * h[q, 1] + hc[p, 2] * h[q, 2]
            chi2[i, j] = _chi2(r, s, full[j])
