"""One robot sees another: range, bearing and perhaps heading (the direct sensing model of Eq. 9)."""

from dataclasses import dataclass, field
from typing import Any, Self

import gtsam
import numpy as np

from factors.edge import EdgeId, EdgeKind, VertexId, check_ends, describe
from factors.errors import FactorError
from factors.noise import FloatArray, UncertainPose, check_covariance, check_pose_covariance, robust


@dataclass(frozen=True, slots=True)
class Sighting:
    """Where the observer saw the observed robot, in the observer's robot frame; SI units.

    Attributes:
        range: metres, positive.
        bearing: radians, of the observed robot's origin; kept in (-pi, pi].
        heading: radians, theta of observer_T_observed, kept in (-pi, pi]; None if it was not measured.
        sigma_range, sigma_bearing, sigma_heading: standard deviations; that of the heading is None where it is.

    Raises:
        FactorError: if a number is not finite, the range or a standard deviation is not positive, or only one of
            heading and its standard deviation is given.
    """

    range: float
    bearing: float
    heading: float | None
    sigma_range: float
    sigma_bearing: float
    sigma_heading: float | None

    def __post_init__(self) -> None:
        if (self.heading is None) != (self.sigma_heading is None):
            raise FactorError(f"sighting: heading {self.heading} and its sigma {self.sigma_heading} go together")
        for name in ("range", "bearing", "heading", "sigma_range", "sigma_bearing", "sigma_heading"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value):
                raise FactorError(f"sighting: {name} {value} is not finite")
        for name in ("range", "sigma_range", "sigma_bearing", "sigma_heading"):
            value = getattr(self, name)
            if value is not None and value <= 0.0:
                raise FactorError(f"sighting: {name} {value} is not positive")
        object.__setattr__(self, "bearing", wrapped(self.bearing))
        if self.heading is not None:
            object.__setattr__(self, "heading", wrapped(self.heading))

    @property
    def position(self) -> FloatArray:
        """(2,) the observed robot's origin in the observer's frame, metres."""
        return self.range * np.array([np.cos(self.bearing), np.sin(self.bearing)])

    @property
    def position_covariance(self) -> FloatArray:
        """(2, 2) covariance of ``position``, in the observer's frame.

        Across the line of sight the variance is ``(range^2 + sigma_range^2) sigma_bearing^2``, the second moment to
        first order in the bearing: unlike the usual Jacobian's it does not vanish at range 0.
        """
        along = np.array([np.cos(self.bearing), np.sin(self.bearing)])
        across = np.array([-along[1], along[0]])
        variance = (self.range**2 + self.sigma_range**2) * self.sigma_bearing**2
        return self.sigma_range**2 * np.outer(along, along) + variance * np.outer(across, across)

    @property
    def covariance(self) -> FloatArray:
        """Of ``residual``: (2, 2), or (3, 3) with the heading where it was measured."""
        if self.sigma_heading is None:
            return self.position_covariance
        covariance = np.diag([0.0, 0.0, self.sigma_heading**2])
        covariance[:2, :2] = self.position_covariance
        return covariance

    def relative_pose(self) -> UncertainPose | None:
        """observer_T_observed, its (3, 3) covariance in the frame of the observed; None without a heading."""
        if self.heading is None:
            return None
        x, y = self.position.tolist()
        turn = gtsam.Pose2(0.0, 0.0, self.heading)
        return UncertainPose(gtsam.Pose2(x, y, self.heading), turn.matrix().T @ self.covariance @ turn.matrix())

    def residual(self, observer_T_observed: gtsam.Pose2) -> tuple[FloatArray, FloatArray]:
        """How far a pose is from what was seen, and the derivative by its tangent at the observed robot.

        The position in the observer's frame, not range and bearing: it is smooth at range 0 and does not wrap.

        Returns:
            (2,) and (2, 3), metres; with a heading (3,) and (3, 3), its difference in (-pi, pi] last.
        """
        pose = observer_T_observed
        position = np.array([pose.x(), pose.y()]) - self.position
        if self.heading is None:
            return position, pose.matrix()[:2] * np.array([1.0, 1.0, 0.0])
        by = pose.matrix()
        by[:2, 2] = 0.0
        return np.append(position, wrapped(pose.theta() - self.heading)), by


@dataclass(frozen=True, slots=True, eq=False)
class AnchoredSighting:
    """A sighting together with where both robots were in their vertices at that time.

    Attributes:
        sighting: the measurement.
        observer_vertex, observed_vertex: the vertices the two robots were in.
        observer, observed: vertex_T_robot of either, (3, 3) covariance in the frame of the robot; it may be singular.
        covariance: of ``residual``: sensor and both anchors, (2, 2), or (3, 3) where the heading was measured.

    Raises:
        FactorError: if an anchor is not finite or its covariance not positive semidefinite.
    """

    sighting: Sighting
    observer_vertex: VertexId
    observed_vertex: VertexId
    observer: UncertainPose
    observed: UncertainPose
    covariance: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        for name in ("observer", "observed"):
            checked = check_pose_covariance(getattr(self, name), f"sighting, {name}")
            object.__setattr__(self, name, checked)
        object.__setattr__(self, "covariance", self._covariance())

    def _covariance(self) -> FloatArray:
        covariance = self.sighting.covariance.copy()
        x, y = self.sighting.position.tolist()
        heading = self.sighting.heading
        rows = 2 if heading is None else 3
        # What the observer's error makes of the observed robot's pose.
        by_observer = -np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])[:rows]
        covariance += by_observer @ self.observer.covariance @ by_observer.T
        if heading is None:
            # The observed robot's error comes turned by an unknown angle: its longest axis stands for every direction.
            covariance += np.linalg.eigvalsh(self.observed.covariance[:2, :2])[-1] * np.eye(2)
        else:
            turn = gtsam.Pose2(0.0, 0.0, heading).matrix()
            covariance += turn @ self.observed.covariance @ turn.T
        return covariance

    def residual(self, vertex_T_vertex: gtsam.Pose2) -> tuple[FloatArray, FloatArray]:
        """``Sighting.residual`` with the observed robot's vertex as seen from the observer's, and by its tangent."""
        seen = self.observer.pose.between(vertex_T_vertex).compose(self.observed.pose)
        error, by_observed = self.sighting.residual(seen)
        return error, by_observed @ self.observed.pose.inverse().AdjointMap()


@dataclass(frozen=True, slots=True, eq=False)
class SightingEdge:
    """One version of a range and bearing between the robots of two vertices (Eq. 9).

    Two numbers do not fix tail_T_head: this edge cannot place a vertex, and holds none alone. A sighting with a
    heading does, and makes a fusing edge.

    Attributes:
        id: same for all versions.
        version: from 0.
        anchored: the sighting; ``tail`` is the vertex of the observer, ``head`` that of the observed robot.
        covariance: (2, 2) of ``residual``: sensor and both anchors; metres, in the observer's frame.

    Raises:
        FactorError: if there is a heading, the version is negative, both robots are in one vertex, or the covariance
            is refused by ``check_covariance``.
    """

    id: EdgeId
    version: int
    anchored: AnchoredSighting
    covariance: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        check_ends(self)
        if self.anchored.sighting.heading is not None:
            raise FactorError(f"{self}: the sighting has a heading, it makes a fusing edge")
        object.__setattr__(self, "covariance", check_covariance(self.anchored.covariance, str(self), size=2))

    def __str__(self) -> str:
        return describe(self)

    @property
    def kind(self) -> EdgeKind:
        """Always SIGHTING."""
        return EdgeKind.SIGHTING

    @property
    def tail(self) -> VertexId:
        """The vertex of the observer."""
        return self.anchored.observer_vertex

    @property
    def head(self) -> VertexId:
        """The vertex of the observed robot."""
        return self.anchored.observed_vertex

    @property
    def estimate(self) -> None:
        """None: range and bearing leave one degree of freedom open."""

    def residual(self, tail_T_head: gtsam.Pose2) -> tuple[FloatArray, FloatArray]:
        """(2,) the observed robot's position less the one seen, in the observer's frame; its (2, 3) derivative."""
        return self.anchored.residual(tail_T_head)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, fit for JSON; ``from_dict`` reads them back."""
        seen = self.anchored.sighting
        return {
            "id": [self.id.robot, self.id.number],
            "version": self.version,
            "kind": str(self.kind),
            "tail": [self.tail.robot, self.tail.number],
            "head": [self.head.robot, self.head.number],
            "range_bearing": [seen.range, seen.bearing],
            "sigmas": [seen.sigma_range, seen.sigma_bearing],
            "anchors": [_anchor_to_list(self.anchored.observer), _anchor_to_list(self.anchored.observed)],
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """The edge that ``to_dict`` wrote.

        Raises:
            FactorError: if the data are not those of a valid edge.
        """
        try:
            (distance, bearing), (sigma_range, sigma_bearing) = data["range_bearing"], data["sigmas"]
            observer, observed = map(_anchor_from_list, data["anchors"])
            sighting = Sighting(distance, bearing, None, sigma_range, sigma_bearing, None)
            tail, head = VertexId(*data["tail"]), VertexId(*data["head"])
            anchored = AnchoredSighting(sighting, tail, head, observer, observed)
            return cls(EdgeId(*data["id"]), data["version"], anchored)
        except FactorError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise FactorError(f"not a sighting edge: {error!r} in {data!r}") from error


class SightingFactor(gtsam.CustomFactor):
    """The residual of a SightingEdge between the variables ``tail`` and ``head``; GTSAM has none with lever arms."""

    def __init__(self, edge: SightingEdge, tail: int, head: int, noise: gtsam.noiseModel.Base) -> None:
        def error(_: object, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
            tail_T_head = values.atPose2(tail).between(values.atPose2(head))
            residual, by_head = edge.residual(tail_T_head)
            if jacobians is not None:
                jacobians[0] = -by_head @ tail_T_head.inverse().AdjointMap()
                jacobians[1] = by_head
            return residual

        super().__init__(noise, [tail, head], error)
        self._edge = edge

    def cloneWithNewNoiseModel(self, noise: gtsam.noiseModel.Base) -> "SightingFactor":
        """The same under ``noise``; GTSAM's own refuses to copy a custom factor."""
        tail, head = self.keys()
        return SightingFactor(self._edge, tail, head, noise)


def sighting_factor(edge: SightingEdge, tail: int, head: int) -> SightingFactor:
    """Range and bearing under the robust kernel, keys ``tail`` and ``head``: a robot may be taken for another."""
    return SightingFactor(edge, tail, head, robust(gtsam.noiseModel.Gaussian.Covariance(edge.covariance)))


def wrapped(angle: float) -> float:
    """``angle`` in (-pi, pi]."""
    return float(np.pi - np.remainder(np.pi - angle, 2.0 * np.pi))


def _anchor_to_list(anchor: UncertainPose) -> list[Any]:
    return [anchor.pose.x(), anchor.pose.y(), anchor.pose.theta(), anchor.covariance.tolist()]


def _anchor_from_list(row: list[Any]) -> UncertainPose:
    return UncertainPose(gtsam.Pose2(*row[:3]), np.array(row[3], dtype=np.float64))
