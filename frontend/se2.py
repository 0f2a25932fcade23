"""Planar rigid motions on arrays of ``x, y, theta`` (last axis 3); metres, radians, angles in (-pi, pi]."""

import numpy as np

from frontend.records import FloatArray


def wrap(angle: FloatArray) -> FloatArray:
    """The same angles in (-pi, pi]."""
    return -((np.pi - angle) % (2.0 * np.pi) - np.pi)


def compose(a_T_b: FloatArray, b_T_c: FloatArray) -> FloatArray:
    """a_T_c; the arguments broadcast."""
    c, s = np.cos(a_T_b[..., 2]), np.sin(a_T_b[..., 2])
    x = a_T_b[..., 0] + c * b_T_c[..., 0] - s * b_T_c[..., 1]
    y = a_T_b[..., 1] + s * b_T_c[..., 0] + c * b_T_c[..., 1]
    return _pose(x, y, wrap(a_T_b[..., 2] + b_T_c[..., 2]))


def between(a_T_b: FloatArray, a_T_c: FloatArray) -> FloatArray:
    """b_T_c; the arguments broadcast."""
    c, s = np.cos(a_T_b[..., 2]), np.sin(a_T_b[..., 2])
    dx = a_T_c[..., 0] - a_T_b[..., 0]
    dy = a_T_c[..., 1] - a_T_b[..., 1]
    return _pose(c * dx + s * dy, c * dy - s * dx, wrap(a_T_c[..., 2] - a_T_b[..., 2]))


def inverse(a_T_b: FloatArray) -> FloatArray:
    """b_T_a."""
    return between(a_T_b, np.zeros(3))


def log(a_T_b: FloatArray) -> FloatArray:
    """Tangent vector (…, 3) whose exponential is ``a_T_b``."""
    theta = wrap(a_T_b[..., 2])
    half = 0.5 * theta
    # half / tan(half), by its series where the quotient loses digits
    small = np.abs(half) < 1e-4
    k = np.where(small, 1.0 - half * half / 3.0, half / np.tan(np.where(small, 1.0, half)))
    x = k * a_T_b[..., 0] + half * a_T_b[..., 1]
    y = k * a_T_b[..., 1] - half * a_T_b[..., 0]
    return _pose(x, y, theta)


def exp(tangent: FloatArray) -> FloatArray:
    """The motion (…, 3) of a tangent vector; its angle in (-pi, pi]."""
    theta = tangent[..., 2]
    small = np.abs(theta) < 1e-6
    turn = np.where(small, 1.0, theta)
    a = np.where(small, 1.0 - theta * theta / 6.0, np.sin(turn) / turn)
    b = np.where(small, 0.5 * theta, (1.0 - np.cos(turn)) / turn)
    return _pose(
        a * tangent[..., 0] - b * tangent[..., 1], b * tangent[..., 0] + a * tangent[..., 1], np.asarray(wrap(theta))
    )


def mean_and_covariance(poses: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean of weighted poses and their covariance in its tangent space, ``Log(mean^-1 * pose)``.

    Args:
        poses: (n, 3).
        weights: (n,) non-negative, summing to one.

    Returns:
        (3,) and (3, 3).
    """
    mean = poses[int(np.argmax(weights))]
    for _ in range(10):
        tangent = log(between(mean, poses))
        step = weights @ tangent
        mean = compose(mean, exp(step))
        if np.abs(step).max() < 1e-9:
            break
    tangent = log(between(mean, poses))
    return mean, (tangent * weights[:, None]).T @ tangent


def adjoint(poses: FloatArray) -> FloatArray:
    """(..., 3, 3) Ad of (..., 3) poses: takes tangent vectors from the frame after the pose to the one before it."""
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    matrix = np.zeros((*poses.shape, 3))
    matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2] = c, -s, poses[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 1], matrix[..., 1, 2] = s, c, -poses[..., 0]
    matrix[..., 2, 2] = 1.0
    return matrix


def _pose(x: FloatArray, y: FloatArray, theta: FloatArray) -> FloatArray:
    """The three as the last axis of one array; np.stack takes three times as long for the poses of every scan."""
    pose = np.empty((*x.shape, 3))
    pose[..., 0], pose[..., 1], pose[..., 2] = x, y, theta
    return pose
