"""Several robots in one frame: least squares over their own maps and the sightings believed, and what it predicts.

The robots' vertices are the variables, each robot's own map enters as the tree of ``OwnMap``, a sighting as one
measurement between two vertices. It serves to judge sightings; the joint map itself is iSAM2's.

Solved by SuperLU one right side at a time: Cholesky and triangular solves of OpenBLAS start threads even for small
matrices, which on a busy machine costs a thousand times the work.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import SuperLU, splu

from frontend import se2
from mrtm.joint.sightings.hypotheses import BoolArray, FloatArray, IntArray, Measurements, OwnMap
from mrtm.joint.sightings.innovation import innovations
from mrtm.joint.sightings.selected_inverse import selected_inverse

_STEPS, _SETTLED = 10, 1e-4


@dataclass(frozen=True, slots=True)
class CommonFrame:
    """The vertices of several robots in the frame of the first one's root.

    Attributes:
        poses: (m, 3) one row a vertex.
        covariance: (m, m, 3, 3) of all poses together, each in its own frame; of pairs of vertices only those that the
            sightings given to ``solve``, whether believed or not, join, and the roots of the robots these join.
    """

    poses: FloatArray
    covariance: FloatArray

    def predict(self, tail: IntArray, head: IntArray) -> tuple[FloatArray, FloatArray]:
        """tail_T_head (n, 3) and its covariance (n, 3, 3) in the frame of head."""
        relative = se2.between(self.poses[tail], self.poses[head])
        back = adjoint(se2.inverse(relative))
        turned = np.swapaxes(back, -1, -2)
        p = self.covariance
        cross = back @ p[tail, head]
        return relative, back @ p[tail, tail] @ turned + p[head, head] - cross - np.swapaxes(cross, -1, -2)


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
    tails, heads, measured, informations = _own_edges(maps)
    chosen = np.flatnonzero(believed)
    seen = sightings.rows(chosen, np.arange(len(start)))
    weights = np.linalg.inv(seen.noise)
    tails, heads = np.concatenate([tails, seen.tail]), np.concatenate([heads, seen.head])
    poses = start
    for _ in range(_STEPS):
        predicted = se2.between(poses[tails], poses[heads])
        split = len(measured)
        residual, derivative = innovations(seen, predicted[split:])
        own = se2.log(se2.between(predicted[:split], measured))
        turned = np.swapaxes(derivative, -1, -2)
        information = np.concatenate([informations, turned @ weights @ derivative])
        gradient = np.concatenate([_times(informations, own), _times(turned @ weights, residual)])
        matrix, vector = _normal_equations(len(start), tails, heads, predicted, information, gradient)
        factor = _factorised(matrix)
        step = np.zeros((len(start), 3))
        step[1:] = factor.solve(vector[3:]).reshape(-1, 3)
        poses = se2.compose(poses, exp(step))
        if np.abs(step).max() < _SETTLED:
            break
    m = len(start)
    covariance = np.zeros((m, m, 3, 3))
    wanted = _asked_about(maps, sightings)
    covariance[1:, 1:] = selected_inverse(matrix[3:, 3:], (wanted[0] - 1, wanted[1] - 1))
    if not np.all(np.diagonal(covariance.diagonal(), axis1=0, axis2=1) >= 0.0):  # NaN as well
        raise np.linalg.LinAlgError("the sightings do not fix the frames")
    return CommonFrame(poses, covariance)


def _asked_about(maps: Sequence[OwnMap], sightings: Measurements) -> IntArray:
    """(2, k) rows of vertices between which something will be predicted: of sightings, and their robots' roots."""
    sizes = [len(own.vertices) for own in maps]
    roots = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes)
    ends = np.stack([sightings.tail, sightings.head])
    both = np.unique(np.concatenate([ends, roots[ends]], axis=1), axis=1)
    return both[:, (both > 0).all(axis=0)]  # the first is fixed: nothing of it varies


def examine(frame: CommonFrame, sightings: Measurements, believed: BoolArray) -> Examination:
    """Judge sightings by a frame that was solved with the ``believed`` (n,) ones; these as if it had not been."""
    predicted, covariance = frame.predict(sightings.tail, sightings.head)
    residual, derivative = innovations(sightings, predicted)
    explained = derivative @ covariance @ np.swapaxes(derivative, -1, -2)
    noise = sightings.noise
    # Without itself the innovation of a believed one has covariance N M^-1 N and value N M^-1 r, M = N - H P H'.
    total = np.where(believed[:, None, None], noise - explained, noise + explained)
    scale = np.linalg.cholesky(noise)
    white = np.linalg.solve(scale, np.swapaxes(np.linalg.solve(scale, total), -1, -2))
    white = 0.5 * (white + np.swapaxes(white, -1, -2))
    values, vectors = np.linalg.eigh(white)
    alone = values[:, 0] < _ALONE
    values = np.maximum(values, _ALONE)
    r = _times(np.swapaxes(vectors, -1, -2), np.linalg.solve(scale, residual[:, :, None])[:, :, 0])
    power = np.where(believed, -0.5, 0.5)
    spread = np.prod(np.diagonal(scale, axis1=1, axis2=2), axis=1) * np.prod(values ** power[:, None], axis=1)
    return Examination(np.sum(r * r / values, axis=1), np.where(alone, np.inf, spread))


_ALONE = 1e-6  # share of a sighting's noise that a residual keeps where nothing else tells of it


def adjoint(poses: FloatArray) -> FloatArray:
    """(..., 3, 3) Ad of (..., 3) poses: takes tangent vectors from the frame after the pose to the one before it."""
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    matrix = np.zeros((*poses.shape, 3))
    matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2] = c, -s, poses[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 1], matrix[..., 1, 2] = s, c, -poses[..., 0]
    matrix[..., 2, 2] = 1.0
    return matrix


def exp(tangents: FloatArray) -> FloatArray:
    """(..., 3) poses of tangent vectors, the inverse of ``frontend.se2.log``."""
    theta = tangents[..., 2]
    a, b = np.sinc(theta / np.pi), 0.5 * theta * np.sinc(0.5 * theta / np.pi) ** 2
    x, y = tangents[..., 0], tangents[..., 1]
    return np.stack([a * x - b * y, b * x + a * y, se2.wrap(theta)], axis=-1)


def _own_edges(maps: Sequence[OwnMap]) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """The tree edges of all maps: tail and head rows, measured pose, information in the frame of the head."""
    trees, measured, covariances = [], [], []
    first = 0
    for own in maps:
        trees.append(own.tree + first)
        measured.append(own.relative[own.tree[:, 0], own.tree[:, 1]])
        covariances.append(own.covariances[own.tree[:, 0], own.tree[:, 1]])
        first += len(own.vertices)
    tree = np.concatenate(trees)
    return tree[:, 0], tree[:, 1], np.concatenate(measured), np.linalg.inv(np.concatenate(covariances))


def _normal_equations(
    m: int, tails: IntArray, heads: IntArray, predicted: FloatArray, information: FloatArray, gradient: FloatArray
) -> tuple[csc_array, FloatArray]:
    """(3m, 3m) matrix and (3m,) vector; a step of the head counts as it is, one of the tail as seen from the head."""
    back = -adjoint(se2.inverse(predicted))
    turned = np.swapaxes(back, -1, -2)
    mixed = turned @ information
    rows, columns = np.concatenate([tails, heads, tails, heads]), np.concatenate([tails, heads, heads, tails])
    blocks = np.concatenate([mixed @ back, information, mixed, np.swapaxes(mixed, -1, -2)])
    order = np.argsort(rows, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=m))])
    matrix = bsr_array((blocks[order], columns[order], starts), shape=(3 * m, 3 * m)).tocsc()
    vector = np.zeros((m, 3))
    np.add.at(vector, tails, _times(turned, gradient))
    np.add.at(vector, heads, gradient)
    return matrix, vector.reshape(-1)


def _factorised(matrix: csc_array) -> SuperLU:
    """The factors of the matrix without the fixed pose."""
    try:
        return splu(matrix[3:, 3:], permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    except RuntimeError as error:  # exactly singular
        raise np.linalg.LinAlgError(str(error)) from error


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])
