"""SE(2) on arrays of poses: (..., 3) float64, x, y, theta; exp and log as in ``gtsam.Pose2.Expmap`` and ``Logmap``."""

import numpy as np

from frontend.records import FloatArray


def wrap(angle: FloatArray) -> FloatArray:
    """The same angle in (-pi, pi]."""
    return -((np.pi - angle) % (2 * np.pi) - np.pi)


def compose(a: FloatArray, b: FloatArray) -> FloatArray:
    """a_T_c from a_T_b and b_T_c; the leading shapes broadcast."""
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack(
        [
            a[..., 0] + cos * b[..., 0] - sin * b[..., 1],
            a[..., 1] + sin * b[..., 0] + cos * b[..., 1],
            wrap(a[..., 2] + b[..., 2]),
        ],
        axis=-1,
    )


def inverse(a: FloatArray) -> FloatArray:
    """b_T_a from a_T_b."""
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack([-cos * a[..., 0] - sin * a[..., 1], sin * a[..., 0] - cos * a[..., 1], wrap(-a[..., 2])], axis=-1)


def between(a: FloatArray, b: FloatArray) -> FloatArray:
    """a_T_b from w_T_a and w_T_b."""
    return compose(inverse(a), b)


def exp(tangent: FloatArray) -> FloatArray:
    """The pose reached by moving with constant velocity ``tangent`` for one unit of time."""
    along, across = _arc(tangent[..., 2])
    x = along * tangent[..., 0] - across * tangent[..., 1]
    y = across * tangent[..., 0] + along * tangent[..., 1]
    return np.stack([x, y, wrap(tangent[..., 2])], axis=-1)


def log(pose: FloatArray) -> FloatArray:
    """The inverse of :func:`exp`."""
    along, across = _arc(pose[..., 2])
    norm = along**2 + across**2
    x = (along * pose[..., 0] + across * pose[..., 1]) / norm
    y = (along * pose[..., 1] - across * pose[..., 0]) / norm
    return np.stack([x, y, pose[..., 2]], axis=-1)


def _arc(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """sin(t)/t and (1-cos(t))/t, stable near zero."""
    half = angle / 2
    chord = np.sinc(half / np.pi)
    return chord * np.cos(half), chord * np.sin(half)
