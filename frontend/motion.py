"""The odometry motion model: how far a reported motion may be off."""

import numpy as np

from frontend.parameters import MotionParameters
from frontend.records import FloatArray


def variance(motion: FloatArray, noise: MotionParameters) -> FloatArray:
    """Variances (3,) of x, y, theta of one odometry increment ``motion`` (3,), in the robot frame.

    The standard deviations grow with the distance and the turn, as in Thrun, Burgard, Fox, "Probabilistic Robotics",
    5.4, kept isotropic in x and y: an unknown mounting of the laser shows as sideways slip in turns.
    """
    distance = float(np.hypot(motion[0], motion[1]))
    turn = abs(float(motion[2]))
    xy = noise.xy_floor + noise.xy_per_metre * distance + noise.xy_per_radian * turn
    theta = noise.theta_floor + noise.theta_per_radian * turn + noise.theta_per_metre * distance
    return np.array([xy * xy, xy * xy, theta * theta])
