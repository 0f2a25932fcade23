"""What a log holds, as plain records in SI units.

A pose is a float64 array ``x, y, theta`` (metres, radians); ``a_T_b`` is the pose of frame b in frame a.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Laser:
    """A planar laser scanner and where it sits on the robot.

    Attributes:
        angles: (B,) bearing of each beam in the laser frame, radians.
        mount: (3,) robot_T_laser, metres and radians.
        max_range: readings at or beyond this many metres mean "nothing was hit".
    """

    angles: FloatArray
    mount: FloatArray
    max_range: float


@dataclass(frozen=True, slots=True)
class LaserScan:
    """One sweep of the laser with the odometry of its time.

    Attributes:
        time: seconds, the log's own clock.
        ranges: (B,) float32 metres; NaN where the reading is unusable (NaN, negative, zero, not a number), inf where
            nothing was hit.
        odometry: (3,) odom_T_robot.
        laser: the scanner; the same object for all scans of a log.
    """

    time: float
    ranges: npt.NDArray[np.float32]
    odometry: FloatArray
    laser: Laser


@dataclass(frozen=True, slots=True)
class Odometry:
    """The robot's dead-reckoned pose: ``time`` in seconds, ``pose`` (3,) odom_T_robot."""

    time: float
    pose: FloatArray


@dataclass(frozen=True, slots=True)
class Sighting:
    """Another robot seen by the sensor, identity unknown: seconds, metres, radians in the robot frame."""

    time: float
    range: float
    bearing: float
