"""The laser scanner: geometry and noise. The default is a SICK LMS-200."""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from frontend.records import FloatArray, Laser
from tools.simulation.poses import compose
from tools.simulation.raycast import cast, shade

BODY = 0.25  # radius of a robot, as another robot's laser sees it, metres


@dataclass(frozen=True)
class LaserModel:
    """A planar scanner with evenly spaced beams.

    Attributes:
        beams: readings a scan.
        first: bearing of the first beam, radians; negative is to the right.
        step: radians from a beam to the next.
        rate: scans a second.
        max_range: metres; nothing farther is seen.
        no_return: metres written to a log where nothing was seen, at least max_range.
        mount: robot_T_laser, metres and radians.
        sigma: standard deviation of a range, metres.
        resolution: ranges are rounded to multiples of this, metres.
        divergence: angle across a beam, radians.
        edge: a beam straddles an edge if its two sides hit things farther apart than this, metres.
        mixed_pixels: probability that such a beam reports a range between the two.
        drop_outs: probability that a beam returns nothing.
    """

    beams: int = 180
    first: float = -math.pi / 2
    step: float = math.pi / 180
    rate: float = 5.0
    max_range: float = 80.0
    no_return: float = 81.91
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma: float = 0.01
    resolution: float = 0.01
    divergence: float = math.radians(0.25)
    edge: float = 0.3
    mixed_pixels: float = 0.5
    drop_outs: float = 0.002

    @classmethod
    def spanning(cls, field_of_view: float, beams: int, max_range: float) -> "LaserModel":
        """A scanner that looks ahead, ``field_of_view`` radians wide; after a full turn it does not repeat beam 0."""
        full_turn = field_of_view > 2 * math.pi - 1e-9
        step = field_of_view / (beams if full_turn else beams - 1)
        return cls(beams, -field_of_view / 2, step, max_range=max_range, no_return=max_range)

    def exact(self) -> "LaserModel":
        """The same scanner without noise, rounding, mixed pixels and drop-outs."""
        return replace(self, sigma=0.0, resolution=0.0, mixed_pixels=0.0, drop_outs=0.0)

    def record(self) -> Laser:
        """The scanner as logs describe it."""
        angles = self.first + self.step * np.arange(self.beams, dtype=np.float64)
        return Laser(angles, np.array(self.mount), self.max_range)


LMS200 = LaserModel()
LMS200_HALF_DEGREE = LaserModel(beams=361, step=math.pi / 360)


def measure(
    laser: LaserModel,
    segments: FloatArray,
    poses: FloatArray,
    rng: np.random.Generator,
    others: FloatArray | None = None,
) -> npt.NDArray[np.float32]:
    """What the laser reports from each robot pose.

    Args:
        laser: the scanner.
        segments: (S, 4) everything it can hit, in the plan's frame.
        poses: (N, 3) plan_T_robot.
        rng: noise.
        others: (N, K, 2) where the other robots are at the time of each pose, in the plan's frame.

    Returns:
        (N, B) metres, inf where nothing was seen.
    """
    at = compose(poses, np.array(laser.mount))
    ranges = _echoes(laser, segments, at, rng, np.empty((len(at), 0, 2)) if others is None else others)
    ranges += laser.sigma * rng.standard_normal(ranges.shape)
    if laser.resolution > 0:
        ranges = np.round(ranges / laser.resolution) * laser.resolution
    # A range of zero would read as "no measurement": the nearest a scanner reports is one step of its resolution.
    ranges = np.maximum(ranges, laser.resolution)
    lost = rng.random(ranges.shape) < laser.drop_outs
    ranges[lost | (ranges >= laser.max_range)] = np.inf
    return ranges.astype(np.float32)


def _echoes(
    laser: LaserModel, segments: FloatArray, at: FloatArray, rng: np.random.Generator, others: FloatArray
) -> FloatArray:
    """Ranges without noise; some beams that straddle an edge report a range between its two sides."""

    def exact(side: float) -> FloatArray:
        ranges = cast(segments, at, laser.first + side, laser.step, laser.beams, laser.max_range)
        shade(ranges, others, BODY, at, laser.first + side, laser.step)
        return ranges

    half = laser.divergence / 2
    middle, left, right = exact(0.0), exact(half), exact(-half)
    near, far = np.minimum(left, right), np.maximum(left, right)
    fraction, chance = rng.random(near.shape), rng.random(near.shape)
    # With nothing behind the edge there is only one echo, hence nothing to mix.
    mixed = (far < laser.max_range) & (far > near + laser.edge) & (chance < laser.mixed_pixels)
    middle[mixed] = near[mixed] + fraction[mixed] * (far[mixed] - near[mixed])
    return middle
