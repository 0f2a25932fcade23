"""The edge that joins the graphs of two robots that met (M11), from all sightings between two of their vertices."""

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from factors.edge import Edge, EdgeId, EdgeKind, VertexId
from factors.errors import FactorError
from factors.noise import FloatArray, UncertainPose, adjoint_transport, robust
from factors.sighting import AnchoredSighting

# Radians: beyond, the heading between the robots is as good as not seen, and no Gaussian describes the pose.
_MAX_HEADING_SIGMA = 0.5
_MAX_STEPS, _SETTLED = 30, 1e-10
_MAX_CONDITION = 1e12


def fusing_factor(edge: Edge, tail: int, head: int) -> gtsam.BetweenFactorPose2:
    """tail_T_head under the robust kernel, keys ``tail`` and ``head``: a sighting may be false."""
    noise = robust(gtsam.noiseModel.Gaussian.Covariance(edge.covariance))
    return gtsam.BetweenFactorPose2(tail, head, edge.measurement, noise)


def fusing_edge(edge_id: EdgeId, version: int, sightings: Sequence[AnchoredSighting]) -> Edge | None:
    """The fusing edge of sightings between the same two vertices, whoever saw whom; None as of ``fuse_sightings``.

    Raises:
        FactorError: as of ``fuse_sightings``.
    """
    tail, head = _ends(sightings)
    estimate = fuse_sightings(sightings)
    return estimate and Edge(edge_id, version, EdgeKind.FUSING, tail, head, estimate.pose, estimate.covariance)


def fuse_sightings(sightings: Sequence[AnchoredSighting]) -> UncertainPose | None:
    """tail_T_head of two vertices from sightings between them; ``tail`` is the lesser VertexId, whoever saw whom.

    Weighted Gauss-Newton over the pose, from the rigid motion that fits the seen positions best in closed form, or
    from a sighting with a heading. Two robots' mutual bearings, or several sightings as they move, fix the heading.

    The paper takes the covariance of the sensor alone. Here the sensor's noise, independent from one sighting to the
    next, averages; the robots' poses in their vertices come from one map each, so their error is taken to be the same
    rigid displacement of the map for all sightings: carried to the vertex frame, averaged by the sightings'
    part in the pose, and counted once.

    Returns:
        tail_T_head and its (3, 3) covariance in the frame of head; None if the sightings do not fix all of it.

    Raises:
        FactorError: if there is no sighting, or they are not all between the same two vertices.
    """
    tail, _ = _ends(sightings)
    pose = _start(sightings, tail)
    weights = [np.linalg.inv(sighting.covariance).astype(np.float64) for sighting in sightings]
    for _ in range(_MAX_STEPS):
        terms = None if pose is None else _linearised(sightings, weights, tail, pose)
        if pose is None or terms is None:
            return None
        step = -np.sum([term.gain @ term.error for term in terms], axis=0)
        pose = pose.compose(gtsam.Pose2.Expmap(step))
        if float(np.abs(step).max()) < _SETTLED:
            covariance = _covariance(sightings, tail, pose, terms)
            return UncertainPose(pose, covariance) if covariance[2, 2] < _MAX_HEADING_SIGMA**2 else None
    return None


def _ends(sightings: Sequence[AnchoredSighting]) -> tuple[VertexId, VertexId]:
    ends = {vertex for s in sightings for vertex in (s.observer_vertex, s.observed_vertex)}
    if len(ends) != 2 or any(s.observer_vertex == s.observed_vertex for s in sightings):
        names = ", ".join(map(str, sorted(ends))) or "no"
        raise FactorError(f"a fusing edge needs sightings between the same two vertices, not {names}")
    tail, head = sorted(ends)
    return tail, head


def _anchors(sighting: AnchoredSighting, tail: VertexId) -> tuple[UncertainPose, UncertainPose]:
    """tail_T_robot and head_T_robot at the sighting."""
    first, second = sighting.observer, sighting.observed
    return (first, second) if sighting.observer_vertex == tail else (second, first)


def _start(sightings: Sequence[AnchoredSighting], tail: VertexId) -> gtsam.Pose2 | None:
    """tail_T_head near the optimum: by a measured heading, or by the points both vertices know; None with one point."""
    for sighting in sightings:
        seen = sighting.sighting.relative_pose()
        if seen is not None:
            direct = sighting.observer.pose.compose(seen.pose).compose(sighting.observed.pose.inverse())
            return direct if sighting.observer_vertex == tail else direct.inverse()
    if len(sightings) < 2:
        return None
    # Each sighting is of one point in space: where it was seen in one vertex, where it was in the other.
    points = np.empty((2, len(sightings), 2))
    for i, sighting in enumerate(sightings):
        seen_in = 0 if sighting.observer_vertex == tail else 1
        points[seen_in, i] = sighting.observer.pose.transformFrom(sighting.sighting.position)
        points[1 - seen_in, i] = sighting.observed.pose.translation()
    centres = points.mean(axis=1)
    (ax, ay), (bx, by) = (points - centres[:, None]).transpose(0, 2, 1)
    turn = gtsam.Pose2(0.0, 0.0, float(np.arctan2(bx @ ay - by @ ax, bx @ ax + by @ ay)))
    x, y = (centres[0] - turn.transformFrom(centres[1])).tolist()
    return gtsam.Pose2(x, y, turn.theta())


class _Term(NamedTuple):
    """What one sighting adds: ``gain`` (3, n) moves the pose by ``error`` (n,); ``share`` is its part in the pose."""

    gain: FloatArray
    error: FloatArray
    share: float


def _linearised(
    sightings: Sequence[AnchoredSighting], weights: Sequence[FloatArray], tail: VertexId, pose: gtsam.Pose2
) -> list[_Term] | None:
    """The normal equations at ``pose``, the sightings weighted by (n, n) ``weights``, solved; None if singular."""
    rows = []
    information = np.zeros((3, 3))
    for sighting, weight in zip(sightings, weights, strict=True):
        if sighting.observer_vertex == tail:
            error, by_head = sighting.residual(pose)
        else:  # (pose Exp(xi))^-1 = pose^-1 Exp(-Ad(pose) xi)
            error, by_tail = sighting.residual(pose.inverse())
            by_head = -by_tail @ pose.AdjointMap()
        weighted = by_head.T @ weight
        information += weighted @ by_head
        rows.append((weighted, error, by_head))
    if np.linalg.cond(information) > _MAX_CONDITION:
        return None
    covariance: FloatArray = np.linalg.inv(information).astype(np.float64)
    return [_Term(covariance @ w, error, float(np.trace(covariance @ w @ by)) / 3.0) for w, error, by in rows]


def _covariance(
    sightings: Sequence[AnchoredSighting], tail: VertexId, pose: gtsam.Pose2, terms: Sequence[_Term]
) -> FloatArray:
    """(3, 3) in the frame of head: the sensor's noise through the gains, and the displacement of either vertex once."""
    sensor = np.zeros((3, 3))
    shifts = np.zeros((2, 3, 3))
    for sighting, term in zip(sightings, terms, strict=True):
        sensor += term.gain @ sighting.sighting.covariance @ term.gain.T
        for shift, anchor in zip(shifts, _anchors(sighting, tail), strict=True):
            shift += term.share * adjoint_transport(*anchor)
    sensor += adjoint_transport(pose.inverse(), shifts[0]) + shifts[1]
    return sensor
