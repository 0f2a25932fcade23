"""Wheel commands integrated between any two times, with a covariance."""

from itertools import pairwise

import gtsam
import numpy as np

from factors import UncertainPose
from frontend.records import FloatArray

# Calibrated on windows of 0.5 to 32 s of data set 7 against its truth.
# Seconds from a command to the wheels.
LAG = 0.25
# How the variance of x, y and heading grows: per metre driven, per radian turned, and per second in any case.
PER_METRE = np.array([0.10, 0.02, 0.10]) ** 2
PER_RADIAN = np.array([0.02, 0.01, 0.12]) ** 2
PER_SECOND = np.array([0.0005, 0.0005, 0.002]) ** 2


class Odometry:
    """Wheel commands (n, 3) of time, forward and angular velocity, each held until the next.

    The robot moves along the exact arc of each command. Its errors are independent from command to command.
    """

    def __init__(self, commands: FloatArray) -> None:
        self._times, self._forward, self._angular = commands[:, 0] + LAG, commands[:, 1], commands[:, 2]

    @property
    def begin(self) -> float:
        """Time of the first command; before it the robot stands."""
        return float(self._times[0])

    @property
    def end(self) -> float:
        """Time of the last command."""
        return float(self._times[-1])

    def motion(self, start: float, end: float) -> UncertainPose:
        """start_T_end of the robot between two times, the later one last; covariance in the frame at ``end``."""
        durations, poses = self._integrate(start, end)
        forward, angular = self._commands(start, end)
        last = poses[-1]
        # The error of each step in the frame at its end, carried to the last frame by the adjoint.
        cos, sin = np.cos(last[2]), np.sin(last[2])
        offset = poses[1:, :2] - last[:2]
        x, y = cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]
        turn = poses[1:, 2] - last[2]
        carry = np.zeros((len(x), 3, 3))
        carry[:, 0, 0] = carry[:, 1, 1] = np.cos(turn)
        carry[:, 1, 0] = np.sin(turn)
        carry[:, 0, 1] = -carry[:, 1, 0]
        carry[:, 0, 2], carry[:, 1, 2], carry[:, 2, 2] = y, -x, 1.0
        steps = np.column_stack([np.abs(forward) * durations, np.abs(angular) * durations, durations])
        variances = steps @ np.stack([PER_METRE, PER_RADIAN, PER_SECOND])
        covariance = np.einsum("nij,nj,nkj->ik", carry, variances, carry)
        return UncertainPose(gtsam.Pose2(*last), covariance)

    def path(self, times: FloatArray) -> FloatArray:
        """(n, 3) poses at ascending ``times``, the first at the origin."""
        poses = [gtsam.Pose2()]
        for start, end in pairwise(times.tolist()):
            poses.append(poses[-1].compose(self.motion(start, end).pose))
        return np.array([(pose.x(), pose.y(), pose.theta()) for pose in poses])

    def _bounds(self, start: float, end: float) -> FloatArray:
        """``start``, the times of the commands strictly between, and ``end``."""
        between = self._times[np.searchsorted(self._times, start, "right") : np.searchsorted(self._times, end, "left")]
        return np.concatenate([[start], between, [end]])

    def _commands(self, start: float, end: float) -> tuple[FloatArray, FloatArray]:
        """Forward and angular velocity of each step between ``start`` and ``end``."""
        at = np.searchsorted(self._times, self._bounds(start, end)[:-1], "right") - 1
        standing = at < 0
        return np.where(standing, 0.0, self._forward[at]), np.where(standing, 0.0, self._angular[at])

    def _integrate(self, start: float, end: float) -> tuple[FloatArray, FloatArray]:
        """Duration (k,) of each step, and the poses (k + 1, 3) before the first and after each."""
        durations = np.diff(self._bounds(start, end))
        forward, angular = self._commands(start, end)
        turned = angular * durations
        heading = np.concatenate([[0.0], np.cumsum(turned)])
        middle = heading[:-1] + 0.5 * turned
        chord = forward * durations * np.sinc(0.5 * turned / np.pi)
        x = np.concatenate([[0.0], np.cumsum(chord * np.cos(middle))])
        y = np.concatenate([[0.0], np.cumsum(chord * np.sin(middle))])
        return durations, np.column_stack([x, y, heading])
