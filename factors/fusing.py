"""The edge that joins the graphs of two robots that met (M11), from all sightings between two of their vertices."""

from collections.abc import Sequence

import gtsam
import numba
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
    start = _start(sightings, tail)
    if start is None:
        return None
    pose = _coordinates(start)
    back = np.array([s.observer_vertex != tail for s in sightings])
    gains, shares = np.empty((len(sightings), 3, 3)), np.empty(len(sightings))
    if not _gauss_newton(*_measured(sightings), back, pose, gains, shares):
        return None
    found = gtsam.Pose2(*pose)
    covariance = _covariance(sightings, tail, found, gains, shares)
    return UncertainPose(found, covariance) if covariance[2, 2] < _MAX_HEADING_SIGMA**2 else None


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


def _measured(sightings: Sequence[AnchoredSighting]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """(n, 3) what was seen, (n, 3) the observers' and (n, 3) the observed robots' poses in their vertices, (n, 3, 3)
    weights; without a heading the last row and column of these are zero."""
    seen, weights = np.zeros((len(sightings), 3)), np.zeros((len(sightings), 3, 3))
    for i, sighting in enumerate(sightings):
        seen[i, :2], seen[i, 2] = sighting.sighting.position, sighting.sighting.heading or 0.0
        size = len(sighting.covariance)
        weights[i, :size, :size] = np.linalg.inv(sighting.covariance)
    observers = np.array([_coordinates(sighting.observer.pose) for sighting in sightings])
    observed = np.array([_coordinates(sighting.observed.pose) for sighting in sightings])
    return seen, observers, observed, weights


@numba.njit(cache=True)
def _gauss_newton(seen, observers, observed, weights, back, pose, gains, shares):  # type: ignore[no-untyped-def]
    """Bring ``pose`` (3,) to the optimum; False if the sightings do not fix it.

    Args:
        back: (n,) whether the observer's vertex is the head.
        gains: (n, 3, 3) becomes what moves the pose by each residual.
        shares: (n,) becomes the part of each sighting in the pose.
    """
    by = np.empty((len(seen), 3, 3))
    for _ in range(_MAX_STEPS):
        information, vector = np.zeros((3, 3)), np.zeros(3)
        for i in range(len(seen)):
            there = _after(_back(pose) if back[i] else pose, observed[i])
            there = _after(_back(observers[i]), there)
            error = there - seen[i]
            error[2] = np.pi - (np.pi - error[2]) % (2.0 * np.pi)
            turn = np.zeros((3, 3))
            turn[0, 0] = turn[1, 1] = np.cos(there[2])
            turn[1, 0] = np.sin(there[2])
            turn[0, 1], turn[2, 2] = -turn[1, 0], 1.0
            by[i] = turn @ _adjoint(_back(observed[i]))
            if back[i]:  # (pose Exp(xi))^-1 = pose^-1 Exp(-Ad(pose) xi)
                by[i] = -by[i] @ _adjoint(pose)
            gains[i] = by[i].T @ weights[i]
            information += gains[i] @ by[i]
            vector += gains[i] @ error
        least, _, most = np.linalg.eigvalsh(information)
        if not most < _MAX_CONDITION * least:
            return False
        covariance = np.linalg.inv(information)
        step = -covariance @ vector
        pose[:] = _after(pose, _exp(step))
        if np.abs(step).max() < _SETTLED:
            for i in range(len(seen)):
                gains[i] = covariance @ gains[i]
                shares[i] = np.trace(gains[i] @ by[i]) / 3.0
            return True
    return False


@numba.njit(cache=True)
def _after(a, b):  # type: ignore[no-untyped-def]
    """a_T_c of poses a_T_b and b_T_c."""
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]])


@numba.njit(cache=True)
def _back(a):  # type: ignore[no-untyped-def]
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([-c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]])


@numba.njit(cache=True)
def _adjoint(a):  # type: ignore[no-untyped-def]
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([[c, -s, a[1]], [s, c, -a[0]], [0.0, 0.0, 1.0]])


@numba.njit(cache=True)
def _exp(tangent):  # type: ignore[no-untyped-def]
    half = 0.5 * tangent[2]
    sinc = np.sin(half) / half if abs(half) > 1e-9 else 1.0
    a, b = sinc * np.cos(half), half * sinc * sinc
    return np.array([a * tangent[0] - b * tangent[1], b * tangent[0] + a * tangent[1], tangent[2]])


def _covariance(
    sightings: Sequence[AnchoredSighting], tail: VertexId, pose: gtsam.Pose2, gains: FloatArray, shares: FloatArray
) -> FloatArray:
    """(3, 3) in the frame of head: the sensor's noise through the gains, and the displacement of either vertex once."""
    sensor = np.zeros((3, 3))
    shifts = np.zeros((2, 3, 3))
    for sighting, gain, share in zip(sightings, gains, shares, strict=True):
        covariance = sighting.sighting.covariance
        through = gain[:, : len(covariance)]
        sensor += through @ covariance @ through.T
        for shift, anchor in zip(shifts, _anchors(sighting, tail), strict=True):
            shift += share * adjoint_transport(*anchor)
    sensor += adjoint_transport(pose.inverse(), shifts[0]) + shifts[1]
    return sensor


def _coordinates(pose: gtsam.Pose2) -> FloatArray:
    return np.array([pose.x(), pose.y(), pose.theta()])
