"""Which sightings between two robots agree on where the robots' frames lie: exhaustive one-point consensus.

Every sighting with a heading proposes an offset of the frames, every suitable pair without headings too, and each
proposal is judged by all sightings (chi2 with sensor noise, pose covariances and both robots' drift). The proposal that
most agree with is refined by least squares over them, until the set stays. What remains may hold rivals.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from frontend import se2
from mrtm.joint.sightings.common_frame import CommonFrame, examine, solve
from mrtm.joint.sightings.hypotheses import BoolArray, FloatArray, IntArray, Measurements, OwnMap
from mrtm.joint.sightings.innovation import GATE_FULL, gates, votes

_ROUNDS = 10
_PARTNERS = 6  # sightings without heading each is paired with, those that fix the heading best
_BASELINE = 4.0  # sigmas by which two sighted points must be apart to fix a heading


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Sightings of one pair of robots that agree with each other, and where they put the second robot.

    Attributes:
        members: (n,) which.
        frame: the vertices of both in the frame of the first robot.
        support: how many members.
        surplus: measured numbers beyond the three that an offset takes.
    """

    members: BoolArray
    frame: CommonFrame
    support: int
    surplus: int


def candidates(first: OwnMap, second: OwnMap, sightings: Measurements) -> Iterator[Candidate]:
    """Sets of sightings that agree, the largest first, each without the members of those before it.

    Args:
        first, second: the robots' own maps.
        sightings: all between the two, in a fixed order; vertices of ``second`` follow those of ``first``.
    """
    m = len(first.vertices)
    relative, covariances = _block(first.relative, second.relative), _block(first.covariances, second.covariances)
    proposals = _proposals(sightings, relative, covariances, first)
    if len(proposals.tail) == 0:
        return
    chi2 = votes(
        sightings, proposals.tail, proposals.head, proposals.offset, proposals.covariance, relative, covariances, m
    )
    inside = chi2 < gates(sightings.full)
    cost = np.where(inside, chi2, 0.0)
    left = np.ones(len(sightings), np.bool_)
    alive = np.ones(len(proposals.tail), np.bool_)
    while alive.any():
        count = np.where(alive, inside @ left.astype(np.int64), -1)
        ties = np.flatnonzero(count == count.max())
        best = int(ties[np.argmin((cost[ties] * left).sum(axis=1).round(6))])
        candidate = _refine(first, second, sightings, proposals, best, inside[best] & left, left)
        if candidate is None:
            alive[best] = False
            continue
        yield candidate
        left &= ~candidate.members
        alive &= left[proposals.sources].all(axis=1)
        alive[best] = False


def _refine(
    first: OwnMap,
    second: OwnMap,
    sightings: Measurements,
    proposals: "_Proposals",
    best: int,
    members: BoolArray,
    left: BoolArray,
) -> Candidate | None:
    """The joint solution of a proposal's supporters, taken again until nobody comes or goes."""
    m = len(first.vertices)
    tail, head, offset = proposals.tail[best], proposals.head[best], proposals.offset[best]
    if tail >= m:
        tail, head, offset = head, tail, se2.inverse(offset)
    root = se2.compose(se2.compose(first.poses[tail], offset), se2.inverse(second.poses[head - m]))
    start = np.concatenate([first.poses, se2.compose(root, second.poses)])
    frame = None
    for _ in range(_ROUNDS):
        try:
            frame = solve((first, second), sightings, members, start if frame is None else frame.poses)
        except np.linalg.LinAlgError:
            return None
        again = left & (examine(frame, sightings, members).chi2 < gates(sightings.full))
        if not again.any() or np.array_equal(again, members):
            break
        members = again
    support = int(members.sum())
    surplus = int(np.where(sightings.full, 3, 2)[members].sum()) - 3
    return Candidate(members, frame, support, surplus) if frame is not None and surplus >= 0 else None


@dataclass(frozen=True, slots=True)
class _Proposals:
    """k offsets: pose ``offset`` (k, 3) of vertex ``head`` (k,) seen from ``tail`` (k,), ``covariance`` (k, 3, 3), and
    the ``sources`` (k, 2) each was made of."""

    tail: IntArray
    head: IntArray
    offset: FloatArray
    covariance: FloatArray
    sources: IntArray


def _proposals(s: Measurements, relative: FloatArray, covariances: FloatArray, first: OwnMap) -> _Proposals:
    full = np.flatnonzero(s.full)
    single = _Proposals(s.tail[full], s.head[full], s.measured[full], s.noise[full], np.column_stack([full, full]))
    double = _two_point(s, relative, covariances, len(first.vertices))
    return _Proposals(
        np.concatenate([single.tail, double.tail]),
        np.concatenate([single.head, double.head]),
        np.concatenate([single.offset, double.offset]),
        np.concatenate([single.covariance, double.covariance]),
        np.concatenate([single.sources, double.sources]),
    )


def _two_point(s: Measurements, relative: FloatArray, covariances: FloatArray, m: int) -> _Proposals:
    """Offsets from pairs of sightings without headings.

    Whoever sees whom, each sighting says that one point of the first robot's map (where the first stood, or where it
    saw the second) is one point of the second's. Two points as far apart in both maps fix the offset.
    """
    which = np.flatnonzero(~s.full)
    i, k = np.triu_indices(len(which), 1)
    i, k = which[i], which[k]
    seen = np.column_stack([s.measured[:, :2], np.zeros(len(s))])
    at_tail, at_head = se2.compose(s.tail_anchor, seen)[:, :2], s.head_anchor[:, :2]
    from_first = s.tail < m
    u, v = np.where(from_first, s.tail, s.head), np.where(from_first, s.head, s.tail)
    p = np.where(from_first[:, None], at_tail, at_head)
    q = np.where(from_first[:, None], at_head, at_tail)
    # The points of sighting k in the vertices of sighting i, and how uncertain that is.
    p1, q1 = p[i], q[i]
    p2, q2 = _moved(relative[u[i], u[k]], p[k]), _moved(relative[v[i], v[k]], q[k])
    dp, dq = p2 - p1, q2 - q1
    long_p, long_q = np.hypot(*dp.T), np.hypot(*dq.T)
    sensor = 0.5 * np.trace(s.noise[:, :2, :2], axis1=1, axis2=2)
    drift = _point_variance(covariances[u[i], u[k]], p[k]) + _point_variance(covariances[v[i], v[k]], q[k])
    variance = sensor[i] + sensor[k] + drift
    length = 0.5 * (long_p + long_q)
    turn_variance = variance / np.maximum(length, 1e-9) ** 2
    good = ((long_p - long_q) ** 2 < GATE_FULL * variance) & (length**2 > _BASELINE**2 * variance)
    # Of each sighting the partners that fix the heading best.
    chosen = np.zeros(len(i), np.bool_)
    order = np.lexsort((k, i, turn_variance))
    order = order[good[order]]
    taken = np.zeros(len(s), np.int64)
    for e in order:
        if min(taken[i[e]], taken[k[e]]) < _PARTNERS:
            chosen[e] = True
            taken[i[e]] += 1
            taken[k[e]] += 1
    c = np.flatnonzero(chosen)
    turn = se2.wrap(np.arctan2(dp[c, 1], dp[c, 0]) - np.arctan2(dq[c, 1], dq[c, 0]))
    rotated = _moved(np.column_stack([np.zeros((len(c), 2)), turn]), 0.5 * (q1[c] + q2[c]))
    offset = np.column_stack([0.5 * (p1[c] + p2[c]) - rotated, turn])
    # The middle of the two points is known to half the variance, the turn about it apart from that.
    lever = 0.5 * (q1[c] + q2[c])
    covariance = np.zeros((len(c), 3, 3))
    covariance[:, 2, 2] = turn_variance[c]
    half = 0.5 * variance[c]
    x, y, t = lever[:, 0], lever[:, 1], turn_variance[c]
    covariance[:, 0, 0], covariance[:, 1, 1] = half + t * y * y, half + t * x * x
    covariance[:, 0, 1] = covariance[:, 1, 0] = -t * x * y
    covariance[:, 0, 2] = covariance[:, 2, 0] = t * y
    covariance[:, 1, 2] = covariance[:, 2, 1] = -t * x
    return _Proposals(u[i[c]], v[i[c]], offset, covariance, np.column_stack([i[c], k[c]]))


def _moved(pose: FloatArray, points: FloatArray) -> FloatArray:
    return se2.compose(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]


def _point_variance(covariance: FloatArray, points: FloatArray) -> FloatArray:
    """(n,) variance along its worst axis, at most, of points (n, 2) given in a frame with pose covariance (n, 3, 3)."""
    c, (x, y) = covariance, points.T
    rotation = (x * x + y * y) * c[:, 2, 2] + 2.0 * (x * c[:, 1, 2] - y * c[:, 0, 2])
    return np.asarray(c[:, 0, 0] + c[:, 1, 1] + rotation)


def _block(a: FloatArray, b: FloatArray) -> FloatArray:
    """Two (m, m, ...) tables on the diagonal of one."""
    m = len(a)
    table = np.zeros((m + len(b), m + len(b), *a.shape[2:]))
    table[:m, :m], table[m:, m:] = a, b
    return table
