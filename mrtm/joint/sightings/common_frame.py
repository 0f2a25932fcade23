"""Several robots in one frame: least squares over their own maps and the sightings believed, and what it predicts.

The robots' vertices are the variables, each robot's own map enters as the tree of ``OwnMap``, a sighting as one
measurement between two vertices. It serves to judge sightings; the joint map itself is iSAM2's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit

from factors import squared_mahalanobis
from frontend import se2
from mrtm.joint.sightings.block_cholesky import (
    Blocks,
    factorise,
    inverse_of_factors,
    multiply,
    pattern_of,
    slot,
    substitute,
)
from mrtm.joint.sightings.hypotheses import BoolArray, FloatArray, IntArray, Measurements, OwnMap
from mrtm.joint.sightings.innovation import between, compose, innovation, innovations

_STEPS, _SETTLED = 10, 1e-4
KEPT = 2**12  # maps


@dataclass(frozen=True, slots=True)
class CommonFrame:
    """The vertices of several robots in the frame of the first one's root.

    Attributes:
        poses: (m, 3) one row a vertex.
        covariance: of all poses but the first together, each in its own frame; of pairs of vertices only those that
            the sightings given to ``solve``, whether believed or not, join, and the roots of the robots these join.
    """

    poses: FloatArray
    covariance: Blocks

    def predict(self, tail: IntArray, head: IntArray) -> tuple[FloatArray, FloatArray]:
        """tail_T_head (n, 3) and its covariance (n, 3, 3) in the frame of head."""
        relative = se2.between(self.poses[tail], self.poses[head])
        back = se2.adjoint(se2.inverse(relative))
        turned = np.swapaxes(back, -1, -2)
        p, u, v = self.covariance, tail - 1, head - 1
        cross = back @ p.at(u, v)
        return relative, back @ p.at(u, u) @ turned + p.at(v, v) - cross - np.swapaxes(cross, -1, -2)


@dataclass(frozen=True, slots=True)
class Examination:
    """Each of n sightings against a common frame that does not know of it.

    Attributes:
        chi2: (n,) of the innovation.
        spread: (n,) sqrt(det) of its covariance, m^2 rad with a heading, m^2 without; infinite where nothing else
            tells of what the sighting measures.
    """

    chi2: FloatArray
    spread: FloatArray


def solve(maps: Sequence[OwnMap], sightings: Measurements, believed: BoolArray, start: FloatArray) -> CommonFrame:
    """Gauss-Newton from ``start`` (m, 3), the vertices of ``maps`` one after the other; the first stays fixed.

    The ``believed`` (n,) sightings must connect all maps.

    Raises:
        LinAlgError: they do not fix where the maps lie.
    """
    trees, measured, informations = _own_edges(maps)
    chosen = np.flatnonzero(believed)
    seen = sightings.rows(chosen)
    tails, heads = np.concatenate([trees[:, 0], seen.tail]), np.concatenate([trees[:, 1], seen.head])
    wanted = _asked_about(maps, sightings)
    # The first is fixed: nothing of it varies, and the rows of the equations begin with the second.
    pattern = pattern_of(len(start) - 1, np.concatenate([tails, wanted[0]]) - 1, np.concatenate([heads, wanted[1]]) - 1)
    poses = start.copy()
    diagonal, below = np.empty((len(start) - 1, 3, 3)), np.empty((len(pattern.rows), 3, 3))
    fixed = _gauss_newton(
        *pattern, tails, heads, measured, informations, seen.full, seen.measured, np.linalg.inv(seen.noise),
        seen.tail_anchor, seen.head_anchor, poses, diagonal, below,
    )  # fmt: skip
    covariance = inverse_of_factors(Blocks(pattern, diagonal, below)) if fixed else None
    if covariance is None or not (np.diagonal(covariance.diagonal, axis1=1, axis2=2) >= 0.0).all():  # NaN as well
        raise np.linalg.LinAlgError("the sightings do not fix the frames")
    return CommonFrame(poses, covariance)


def _asked_about(maps: Sequence[OwnMap], sightings: Measurements) -> IntArray:
    """(2, k) rows of vertices between which something will be predicted: of sightings, and their robots' roots."""
    sizes = [len(own.vertices) for own in maps]
    roots = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes)
    ends = np.stack([sightings.tail, sightings.head])
    return np.concatenate([ends, roots[ends]], axis=1)


def examine(frame: CommonFrame, sightings: Measurements, believed: BoolArray) -> Examination:
    """Judge sightings by a frame that was solved with the ``believed`` (n,) ones; these as if it had not been."""
    predicted, covariance = frame.predict(sightings.tail, sightings.head)
    residual, derivative = innovations(sightings, predicted)
    explained = derivative @ covariance @ np.swapaxes(derivative, -1, -2)
    # Without itself the innovation of a believed one has covariance N M^-1 N and value N M^-1 r, M = N - H P H'.
    total = np.where(believed[:, None, None], sightings.noise - explained, sightings.noise + explained)
    chi2, spread = np.empty(len(sightings)), np.empty(len(sightings))
    _judge(sightings.noise, total, residual, believed, chi2, spread)
    rest = np.flatnonzero(np.isnan(chi2))
    if len(rest):
        chi2[rest], spread[rest] = _alone(sightings.noise[rest], total[rest], residual[rest]), np.inf
    return Examination(chi2, spread)


def _alone(noise: FloatArray, total: FloatArray, residual: FloatArray) -> FloatArray:
    """(n,) chi2 where no more than _ALONE of a sighting's noise is left in some direction of its residual."""
    scale = np.linalg.cholesky(noise)
    white = np.linalg.solve(scale, np.swapaxes(np.linalg.solve(scale, total), -1, -2))
    values, vectors = np.linalg.eigh(0.5 * (white + np.swapaxes(white, -1, -2)))
    r = (np.swapaxes(vectors, -1, -2) @ np.linalg.solve(scale, residual[:, :, None]))[:, :, 0]
    return np.asarray(np.sum(r * r / np.maximum(values, _ALONE), axis=1))


@njit(cache=True, error_model="numpy")
def _judge(noise, total, residual, believed, chi2, spread):  # type: ignore[no-untyped-def]
    """``chi2`` and ``spread`` of all sightings about which something else tells; of the others NaN."""
    left = np.empty((3, 3))
    for j in range(len(residual)):
        for r in range(3):
            for c in range(3):
                left[r, c] = total[j, r, c] - _ALONE * noise[j, r, c]
        if not _determinant(left) > 0.0:
            chi2[j] = spread[j] = np.nan
            continue
        chi2[j] = squared_mahalanobis(residual[j], total[j])
        left[:] = total[j]
        spread[j] = math.sqrt(_determinant(left))
        if believed[j]:
            left[:] = noise[j]
            spread[j] = _determinant(left) / spread[j]


@njit(cache=True, error_model="numpy")
def _determinant(a):  # type: ignore[no-untyped-def]
    """Of (3, 3), which is used up; NaN if it is not positive definite."""
    product = 1.0
    for i in range(3):
        if not a[i, i] > 0.0:
            return np.nan
        product *= a[i, i]
        for r in range(i + 1, 3):
            share = a[r, i] / a[i, i]
            for c in range(i + 1, 3):
                a[r, c] -= share * a[i, c]
    return product


_ALONE = 1e-6  # share of a sighting's noise that a residual keeps where nothing else tells of it


def _own_edges(maps: Sequence[OwnMap]) -> tuple[IntArray, FloatArray, FloatArray]:
    """The tree edges of all maps: rows of tail and head, measured pose, information in the frame of the head."""
    sizes = [len(own.vertices) for own in maps]
    trees = [own.tree + first for own, first in zip(maps, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True)]
    measured, informations = zip(*map(_tree_edges, maps), strict=True)
    return np.concatenate(trees), np.concatenate(measured), np.concatenate(informations)


@lru_cache(KEPT)
def _tree_edges(own: OwnMap) -> tuple[FloatArray, FloatArray]:
    at = own.tree[:, 0], own.tree[:, 1]
    return own.relative[at], np.asarray(np.linalg.inv(own.covariances[at]), np.float64)


@njit(cache=True)
def _gauss_newton(  # type: ignore[no-untyped-def]
    place, starts, rows, tails, heads, own, own_information, full, measured, weights, tail_anchor, head_anchor,
    poses, diagonal, below,
):  # fmt: skip
    """Leave the ``poses`` at the optimum, and the factors of the last matrix; False if it is singular."""
    split = len(own)
    vector, step = np.empty((len(diagonal), 3)), np.empty(3)
    predicted, pose, r, g = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    h, information, mixed, back = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for _ in range(_STEPS):
        diagonal[:], below[:], vector[:] = 0.0, 0.0, 0.0
        for e in range(len(tails)):
            between(poses[tails[e]], poses[heads[e]], predicted)
            if e < split:
                innovation(True, own[e], predicted, predicted, predicted, pose, r, h)
                information[:] = own_information[e]
                _times(information, r, g)
            else:
                j = e - split
                innovation(full[j], measured[j], tail_anchor[j], head_anchor[j], predicted, pose, r, h)
                multiply(h.T, weights[j], mixed)
                multiply(mixed, h, information)
                _times(mixed, r, g)
            # A step of the head counts as it is, one of the tail as seen from the head.
            tail, head = tails[e] - 1, heads[e] - 1
            _back(predicted, back)
            if head >= 0:
                diagonal[place[head]] += information
                vector[place[head]] += g
            if tail >= 0:
                multiply(back.T, information, mixed)
                multiply(mixed, back, h)
                diagonal[place[tail]] += h
                for a in range(3):
                    for b in range(3):
                        vector[place[tail], a] += back[b, a] * g[b]
                if head >= 0 and place[tail] > place[head]:
                    below[slot(starts, rows, place[tail], place[head])] += mixed
                elif head >= 0:
                    below[slot(starts, rows, place[head], place[tail])] += mixed.T
        if not factorise(starts, rows, diagonal, below):
            return False
        substitute(starts, rows, diagonal, below, vector)
        largest = 0.0
        for i in range(len(diagonal)):
            largest = max(largest, np.abs(vector[place[i]]).max())
            exp(vector[place[i]], step)
            compose(poses[i + 1], step, poses[i + 1])
        if largest < _SETTLED:
            break
    return True


@njit(cache=True)
def exp(tangent, out):  # type: ignore[no-untyped-def]
    """The pose of a tangent vector, the inverse of ``frontend.se2.log``."""
    theta = tangent[2]
    half = 0.5 * theta
    sinc = math.sin(half) / half if abs(half) > 1e-9 else 1.0
    a, b = sinc * math.cos(half), half * sinc * sinc
    out[0], out[1], out[2] = a * tangent[0] - b * tangent[1], b * tangent[0] + a * tangent[1], theta


@njit(cache=True)
def _back(pose, out):  # type: ignore[no-untyped-def]
    """-Ad(pose^-1)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x = -(c * pose[0] + s * pose[1])
    y = s * pose[0] - c * pose[1]
    out[0, 0], out[0, 1], out[0, 2] = -c, -s, -y
    out[1, 0], out[1, 1], out[1, 2] = s, -c, x
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, -1.0


@njit(cache=True)
def _times(a, v, out):  # type: ignore[no-untyped-def]
    for r in range(3):
        out[r] = a[r, 0] * v[0] + a[r, 1] * v[1] + a[r, 2] * v[2]
