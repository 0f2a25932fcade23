"""Iterative closest points between the surfaces of two local maps, point to line (Chen and Medioni 1991)."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numba
import numpy as np

from frontend import se2
from frontend.records import FloatArray
from mrtm.joint.alignment.buckets import nearest
from mrtm.joint.alignment.surface import FACING, Surface


class Round(NamedTuple):
    """How partners are sought: within ``reach``, metres, for about ``points`` of the points that are moved."""

    reach: float
    points: int


COARSE = Round(0.5, 500), Round(0.3, 500), Round(0.15, 500)
FINE = Round(0.15, 10000)
SCALE = 0.17  # metres, of the robust kernel (Geman and McClure)
ITERATIONS = 15  # a round
STILL = 1e-4  # metres and radians a step: the end of a round
DAMPING = 1e-4  # of the points' weight: where nothing fixes a direction, nothing moves along it
LEAST = 30  # pairs of points below which there is nothing to align
FARTHEST = 1.0  # metres from the guess


def icp(a: Surface, b: Surface, guess: FloatArray, rounds: Iterable[Round]) -> FloatArray | None:
    """Move ``b`` onto ``a`` from a guess within half a metre and 0.2 rad; only points that face alike attract.

    Args:
        guess: (3,) a_T_b.

    Returns:
        (3,) a_T_b, or None where the surfaces have too little in common.
    """
    pose = np.array(guess, np.float64)
    for reach, most in rounds:
        step = -(-len(b.points) // most) or 1
        count = _round(a.points, a.normals, a.buckets.low, a.buckets.starts, b.points[::step], b.normals[::step],
                       reach, pose)  # fmt: skip
        if count < LEAST or np.hypot(*(pose[:2] - guess[:2])) > FARTHEST:
            return None
    pose[2] = se2.wrap(pose[2])
    return pose


@numba.njit(cache=True)
def _round(a_points, a_normals, low, starts, points, normals, reach, pose):  # type: ignore[no-untyped-def]
    """Gauss-Newton on the distances to the partners' lines, these sought anew at each step; ``pose`` is moved."""
    count = 0
    for _ in range(ITERATIONS):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        count = 0
        hxx = hxy = hyy = hxt = hyt = htt = gx = gy = gt = 0.0
        for j in range(len(points)):
            # Relative to the origin of b: it turns about that.
            x, y = c * points[j, 0] - s * points[j, 1], s * points[j, 0] + c * points[j, 1]
            nx, ny = c * normals[j, 0] - s * normals[j, 1], s * normals[j, 0] + c * normals[j, 1]
            i = nearest(a_points, a_normals, low, starts, x + pose[0], y + pose[1], nx, ny, reach, FACING)
            if i < 0:
                continue
            count += 1
            ax, ay = a_normals[i, 0], a_normals[i, 1]
            off = ax * (x + pose[0] - a_points[i, 0]) + ay * (y + pose[1] - a_points[i, 1])
            t = ay * x - ax * y
            w = (1.0 + (off / SCALE) ** 2) ** -2
            hxx += w * ax * ax
            hxy += w * ax * ay
            hyy += w * ay * ay
            hxt += w * ax * t
            hyt += w * ay * t
            htt += w * t * t
            gx += w * ax * off
            gy += w * ay * off
            gt += w * t * off
        if count < LEAST:
            break
        damping = DAMPING * (hxx + hyy)
        hxx += damping
        hyy += damping
        htt += damping
        # Cramer's rule.
        mxx, mxy, mxt = hyy * htt - hyt * hyt, hxt * hyt - hxy * htt, hxy * hyt - hyy * hxt
        myy, myt, mtt = hxx * htt - hxt * hxt, hxy * hxt - hxx * hyt, hxx * hyy - hxy * hxy
        det = hxx * mxx + hxy * mxy + hxt * mxt
        dx = -(mxx * gx + mxy * gy + mxt * gt) / det
        dy = -(mxy * gx + myy * gy + myt * gt) / det
        dt = -(mxt * gx + myt * gy + mtt * gt) / det
        pose[0] += dx
        pose[1] += dy
        pose[2] += dt
        if abs(dx) < STILL and abs(dy) < STILL and abs(dt) < STILL:
            break
    return count
