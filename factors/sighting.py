"""One robot sees another: range, bearing and perhaps heading (the direct sensing model of Eq. 9)."""

from dataclasses import dataclass

import gtsam
import numpy as np

from factors.errors import FactorError
from factors.noise import FloatArray, UncertainPose


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
        object.__setattr__(self, "bearing", _wrapped(self.bearing))
        if self.heading is not None:
            object.__setattr__(self, "heading", _wrapped(self.heading))

    @property
    def position(self) -> FloatArray:
        """(2,) the observed robot's origin in the observer's frame, metres."""
        return self.range * np.array([np.cos(self.bearing), np.sin(self.bearing)])

    @property
    def position_covariance(self) -> FloatArray:
        """(2, 2) covariance of ``position``, in the observer's frame.

        Across the line of sight the variance is ``(range^2 + sigma_range^2) sigma_bearing^2``, the exact second
        moment to first order in the bearing: it does not vanish at range 0.
        """
        along = np.array([np.cos(self.bearing), np.sin(self.bearing)])
        across = np.array([-along[1], along[0]])
        variance = (self.range**2 + self.sigma_range**2) * self.sigma_bearing**2
        return self.sigma_range**2 * np.outer(along, along) + variance * np.outer(across, across)

    def relative_pose(self) -> UncertainPose | None:
        """observer_T_observed, its (3, 3) covariance in the frame of the observed; None without a heading."""
        if self.heading is None or self.sigma_heading is None:
            return None
        x, y = self.position.tolist()
        pose = gtsam.Pose2(x, y, self.heading)
        turn = pose.rotation().matrix()
        covariance = np.zeros((3, 3))
        covariance[:2, :2] = turn.T @ self.position_covariance @ turn
        covariance[2, 2] = self.sigma_heading**2
        return UncertainPose(pose, covariance)


def _wrapped(angle: float) -> float:
    """``angle`` in (-pi, pi]."""
    return float(np.pi - np.remainder(np.pi - angle, 2.0 * np.pi))
