"""What the local maps of two robots say of an offset between them, for sightings that cannot decide it alone.

A sighting is good to a few decimetres at the far side of a local map, so the pose is first fitted within its own
uncertainty. Then the maps agree, contradict each other, or say nothing: also where they agree as well with themselves
moved along, as a corridor does.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from factors import UncertainPose, VertexId
from frontend import se2
from mrtm.joint.alignment.agreement import (
    LEAST_POINTS,
    Agreement,
    Decision,
    FloatArray,
    Lookup,
    agreement,
    known,
    overlap,
    scores,
)
from mrtm.joint.sightings.hypotheses import RobotGraph, coordinates

LEAST_OVERLAP = 20.0
"""Area known in both maps, m^2, below which they say nothing."""

AGREEING = (0.65, 0.12)
"""At least so many hits and at most so many conflicts."""

CONTRADICTING = (0.4, 0.3)
"""At most so many hits and at least so many conflicts."""

UNIQUE = 0.15
"""By which the score has to fall wherever one map is moved along the direction that the walls fix least."""

SIGMAS = 3.0
"""How far the fit may move a pose, in standard deviations of each axis."""

WIDEST = (1.2, 0.25)
"""Metres and radians beyond which a pose is too uncertain to be fitted, and its maps are not asked."""

KEPT = 2**14  # answers

NEAREST = 6
"""Pairs of local maps that are looked at, those whose vertices lie nearest to each other."""

MOST_PAIRS = 3
"""Pairs of them that are compared, those that overlap most."""

_THINNED = 4  # one point in so many gives a score to about
_ROUGHLY = 0.1
_STEPS = ((0.1, 0.02, _THINNED), (0.05, 0.01, 1))  # metres, radians and one point in how many, coarse and fine
_RASTER = np.array([0.1, 0.1, 0.02])  # metres and radians
_FINE = np.array([0.1, 0.1, 0.02])
_SHIFTS = np.arange(0.6, 4.01, 0.2)


@dataclass(frozen=True, slots=True)
class Fit:
    """Two local maps ``a`` and ``b`` at the ``pose`` a_T_b (3,) that fits best, and how they agree there."""

    a: Lookup
    b: Lookup
    pose: FloatArray
    agreement: Agreement

    @property
    def decision(self) -> Decision:
        """What it says; the bounds come from true and false overlaps of real local maps."""
        found = self.agreement
        if found.overlap < LEAST_OVERLAP or found.points < LEAST_POINTS:
            return Decision.UNDECIDED
        if found.hits <= CONTRADICTING[0] and found.conflicts >= CONTRADICTING[1]:
            return Decision.CONTRADICTS
        agrees = found.hits >= AGREEING[0] and found.conflicts <= AGREEING[1]
        return Decision.AGREES if agrees and self.lead() >= UNIQUE else Decision.UNDECIDED

    def lead(self) -> float:
        """How clearly they fit: the score there less the best score with one map moved along, which takes long."""
        a, b, pose = self.a, self.b, self.pose
        axis = _weak_direction(a, b, pose)
        way = np.concatenate([_SHIFTS, -_SHIFTS])
        moved = []
        for angle in (axis, axis + 0.5 * np.pi):
            shift = np.outer(way, [np.cos(angle), np.sin(angle), 0.0])
            moved.append(se2.compose((pose + shift)[:, None], _around(_FINE, 0.1, 0.02)[None]).reshape(-1, 3))
        # Moved sideways two corridors touch wall to wall, which is no overlap: that leaves few of the points.
        elsewhere = _best_score(a, b, np.concatenate(moved), max(LEAST_POINTS, self.agreement.points // 2))
        return float(scores(a, b, pose[None])[0] - elsewhere)


def fit(a: Lookup, b: Lookup, guess: FloatArray, half: FloatArray) -> Fit:
    """The best pose a_T_b (3,) within ``half`` (3,), metres and radians, of ``guess``."""
    pose = guess
    for (step, turn, thinned), width in zip(_STEPS, (half, _FINE), strict=True):
        tried = se2.compose(pose, _around(width, step, turn))
        score = scores(a, b, tried, thinned=thinned)
        if score.max() > scores(a, b, pose[None], thinned=thinned)[0]:
            pose = tried[int(np.argmax(score))]
    return Fit(a, b, pose, agreement(a, b, pose))


def _best_score(a: Lookup, b: Lookup, poses: FloatArray, least: int) -> float:
    """The best score at any of the poses (k, 3); all points are looked up only where some of them promise it."""
    rough = scores(a, b, poses, least, _THINNED)
    return float(scores(a, b, poses[rough >= rough.max() - _ROUGHLY], least).max())


class MapEvidence:
    """The word of the local maps, as :func:`mrtm.joint.sightings.consistency.judge` asks for it.

    Args:
        maps: of all robots, ready for comparison, all at vertices that the graphs have; only those are looked at that
            are to be compared.
        graphs: each robot's own, by name.
    """

    def __init__(self, maps: Mapping[VertexId, Lookup], graphs: Mapping[str, RobotGraph]) -> None:
        self._maps, self._graphs = maps, graphs
        self._owned: dict[str, tuple[VertexId, ...]] = {}
        for vertex in sorted(maps):
            self._owned[vertex.robot] = (*self._owned.get(vertex.robot, ()), vertex)

    def __call__(self, tail: VertexId, head: VertexId, tail_T_head: UncertainPose, veto: bool = False) -> Decision:
        """What the maps of two robots say if ``head`` lies there: one contradiction outweighs any agreement.

        Args:
            veto: whether only a contradiction matters; then no agreement is looked for.
        """
        ours, theirs = (self._owned.get(end.robot, ()) for end in (tail, head))
        if not (ours and theirs):
            return Decision.UNDECIDED
        overlaps = []
        near_tail = _seen_from(self._graphs[tail.robot], tail, ours)
        seen, sigma = _between(near_tail, tail_T_head, _seen_from(self._graphs[head.robot], head, theirs))
        sure = (sigma[..., :2].max(axis=-1) < WIDEST[0] / SIGMAS) & (sigma[..., 2] < WIDEST[1] / SIGMAS)
        near = np.where(sure, np.hypot(seen[..., 0], seen[..., 1]), np.inf).ravel()
        for place in np.argsort(near, kind="stable")[:NEAREST]:
            if not np.isfinite(near[place]):
                break
            i, k = np.unravel_index(place, sure.shape)
            u, v, question = ours[i], theirs[k], _question(seen[i, k], sigma[i, k])
            overlaps.append((_overlap(self._maps[u], self._maps[v], question), u, v, question))
        overlaps.sort(key=lambda o: (-o[0], o[1], o[2]))
        said = {
            _decision(self._maps[u], self._maps[v], question)
            for area, u, v, question in overlaps[:MOST_PAIRS]
            if area >= LEAST_OVERLAP and not (veto and _fits_well(self._maps[u], self._maps[v], question))
        }
        return next((word for word in (Decision.CONTRADICTS, Decision.AGREES) if word in said), Decision.UNDECIDED)


class _Around(NamedTuple):
    """Where n vertices of a robot lie, seen from one of them: ``poses`` (n, 3) and their ``covariances`` (n, 3, 3)."""

    poses: FloatArray
    covariances: FloatArray


@lru_cache(512)
def _seen_from(graph: RobotGraph, vertex: VertexId, others: tuple[VertexId, ...]) -> _Around:
    seen = graph.relatives([(vertex, v) for v in others])
    return _Around(np.array([coordinates(s.pose) for s in seen]), np.array([s.covariance for s in seen]))


def _between(ours: _Around, tail_T_head: UncertainPose, theirs: _Around) -> tuple[FloatArray, FloatArray]:
    """The poses (n, k, 3) of their vertices seen from ours, and their standard deviations (n, k, 3)."""
    u_T_head = se2.between(ours.poses, np.array(coordinates(tail_T_head.pose)))
    back = se2.adjoint(se2.inverse(u_T_head))
    at_head = back @ ours.covariances @ np.swapaxes(back, -1, -2) + tail_T_head.covariance
    back = se2.adjoint(se2.inverse(theirs.poses))
    at_v = back @ at_head[:, None] @ np.swapaxes(back, -1, -2) + theirs.covariances
    seen = se2.compose(u_T_head[:, None], theirs.poses[None])
    return seen, np.sqrt(np.diagonal(at_v, axis1=-2, axis2=-1))


class _Question(NamedTuple):
    """Where to fit two maps, in whole steps, so that next to the same is the same: pose and half widths (3,)."""

    pose: tuple[float, ...]
    half: tuple[float, ...]


def _question(pose: FloatArray, sigma: FloatArray) -> _Question:
    near = np.round(pose / _RASTER) * _RASTER
    half = np.ceil(SIGMAS * sigma / _RASTER + 0.5) * _RASTER
    return _Question(tuple(near.tolist()), tuple(half.tolist()))


@lru_cache(KEPT)
def _overlap(a: Lookup, b: Lookup, question: _Question) -> float:
    return overlap(a, b, np.array(question.pose))


def _fits_well(a: Lookup, b: Lookup, question: _Question) -> bool:
    """Whether two maps agree too well to contradict each other already where the fit begins, which makes it better."""
    return bool(scores(a, b, np.array([question.pose]))[0] > CONTRADICTING[0] - CONTRADICTING[1])


@lru_cache(KEPT)
def _decision(a: Lookup, b: Lookup, question: _Question) -> Decision:
    return fit(a, b, np.array(question.pose), np.array(question.half)).decision


def _around(half: FloatArray, step: float, turn: float) -> FloatArray:
    """(k, 3) a grid of small motions within plus and minus ``half`` (3,)."""
    counts = np.maximum(np.ceil(half / np.array([step, step, turn]) - 1e-9), 1).astype(int)
    axes = [np.arange(-n, n + 1) * size for n, size in zip(counts, (step, step, turn), strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _weak_direction(a: Lookup, b: Lookup, a_T_b: FloatArray) -> float:
    """The direction, in the frame of a, in which the surfaces in the overlap fix the pose least."""
    here = a.normals[known(b, a.points, se2.inverse(a_T_b))]
    there = b.normals[known(a, b.points, a_T_b)]
    normals = np.concatenate(
        [here, se2.compose(np.array([0.0, 0.0, a_T_b[2]]), np.column_stack([there, 0 * there[:, :1]]))[:, :2]]
    )
    weakest = np.linalg.eigh(normals.T @ normals)[1][:, 0]
    return float(np.arctan2(weakest[1], weakest[0]))
