"""SE(2) on (N, 3) arrays x, y, theta."""

import numpy as np

from frontend.records import FloatArray


def wrapped(angle: FloatArray) -> FloatArray:
    """Angles in (-pi, pi]."""
    return np.asarray(np.pi - (np.pi - angle) % (2 * np.pi))


def compose(a: FloatArray, b: FloatArray) -> FloatArray:
    """a_T_c from a_T_b and b_T_c, each (N, 3) or (3,)."""
    x, y, theta = np.moveaxis(a, -1, 0)
    c, s = np.cos(theta), np.sin(theta)
    bx, by, turn = np.moveaxis(b, -1, 0)
    return np.stack((x + c * bx - s * by, y + s * bx + c * by, wrapped(theta + turn)), axis=-1)


def between(a: FloatArray, b: FloatArray) -> FloatArray:
    """a_T_b from w_T_a and w_T_b, each (N, 3) or (3,)."""
    dx, dy, turn = np.moveaxis(b - a, -1, 0)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack((c * dx + s * dy, c * dy - s * dx, wrapped(turn)), axis=-1)


def exponential(twist: FloatArray) -> FloatArray:
    """The motion of a constant velocity ``vx, vy, omega`` held for one unit of time, (N, 3)."""
    vx, vy, omega = np.moveaxis(twist, -1, 0)
    a, b = _chord(omega)
    return np.stack((a * vx - b * vy, b * vx + a * vy, wrapped(omega)), axis=-1)


def logarithm(motion: FloatArray) -> FloatArray:
    """The constant velocity that makes the motion in one unit of time, (N, 3); |theta| below pi."""
    x, y, omega = np.moveaxis(motion, -1, 0)
    a, b = _chord(omega)
    norm = a * a + b * b
    return np.stack(((a * x + b * y) / norm, (a * y - b * x) / norm, omega), axis=-1)


def accumulated(motions: FloatArray) -> FloatArray:
    """(N + 1, 3) poses from the origin on, each motion (N, 3) made from the pose before it."""
    heading = np.concatenate(([0.0], np.cumsum(motions[:, 2])))
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    x, y = motions[:, 0], motions[:, 1]
    steps = np.column_stack((c * x - s * y, s * x + c * y))
    position = np.vstack((np.zeros(2), np.cumsum(steps, axis=0)))
    return np.column_stack((position, wrapped(heading)))


def _chord(omega: FloatArray) -> tuple[FloatArray, FloatArray]:
    """sin(w)/w and (1 - cos(w))/w, also near zero."""
    half = omega / 2
    sinc = np.sinc(half / np.pi)
    return sinc * np.cos(half), sinc * np.sin(half)
