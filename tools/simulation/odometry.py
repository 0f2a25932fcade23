"""Wheel odometry of a differential drive: systematic errors, noise, and what goes badly wrong."""

from dataclasses import dataclass

import numpy as np

from frontend.records import FloatArray
from tools.simulation.poses import accumulated, between, exponential, logarithm


@dataclass(frozen=True)
class OdometryNoise:
    """How odometry lies.

    Systematic errors are drawn once a run (Borenstein and Feng 1996: unequal wheels, uncertain wheelbase). Noise
    grows with the square root of the motion, so that it does not depend on how often the wheels are read.

    Attributes:
        wheelbase: metres between the wheels.
        scale: standard deviation of the error of both wheels' diameter, a fraction.
        wheel_mismatch: standard deviation of the difference between the wheels' diameters, a fraction.
        wheelbase_scale: standard deviation of the error of the wheelbase, a fraction.
        translation_from_translation: noise, metres per square root of a metre driven.
        rotation_from_translation: noise, radians per square root of a metre driven.
        rotation_from_rotation: noise, radians per square root of a radian turned.
        slips_per_minute: on average, the wheels spin or the robot is pushed, for a second.
        slip_translation: standard deviation of the false motion of a slip, metres.
        slip_rotation: the same, radians.
        reversals_per_minute: on average, a stretch of translation is recorded with the wrong sign.
        reversal_length: metres driven in such a stretch.
    """

    wheelbase: float = 0.38
    scale: float = 0.01
    wheel_mismatch: float = 0.0005
    wheelbase_scale: float = 0.015
    translation_from_translation: float = 0.01
    rotation_from_translation: float = 0.01
    rotation_from_rotation: float = 0.02
    slips_per_minute: float = 0.0
    slip_translation: float = 0.15
    slip_rotation: float = 0.1
    reversals_per_minute: float = 0.0
    reversal_length: float = 1.5


PERFECT = OdometryNoise(
    scale=0.0,
    wheel_mismatch=0.0,
    wheelbase_scale=0.0,
    translation_from_translation=0.0,
    rotation_from_translation=0.0,
    rotation_from_rotation=0.0,
)


def dead_reckon(times: FloatArray, poses: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """What the wheels say.

    Args:
        times: (N,) seconds, evenly spaced and dense: between two the robot moves at constant velocity.
        poses: (N, 3) plan_T_robot, the truth.
        noise: the errors to make.
        rng: draws them.

    Returns:
        (N, 3) odom_T_robot, the first at the origin.
    """
    twists = logarithm(between(poses[:-1], poses[1:]))
    twists[:, [0, 2]] = _through_wheels(twists[:, 0], twists[:, 2], noise, rng)
    driven, turned = np.abs(twists[:, 0]), np.abs(twists[:, 2])
    draws = rng.standard_normal((len(twists), 3))
    twists[:, 0] += noise.translation_from_translation * np.sqrt(driven) * draws[:, 0]
    twists[:, 2] += noise.rotation_from_translation * np.sqrt(driven) * draws[:, 1]
    twists[:, 2] += noise.rotation_from_rotation * np.sqrt(turned) * draws[:, 2]
    twists[_reversed(times, driven, noise, rng), 0] *= -1
    twists += _slips(times, noise, rng)
    return accumulated(exponential(twists))


def _through_wheels(
    forward: FloatArray, turn: FloatArray, noise: OdometryNoise, rng: np.random.Generator
) -> FloatArray:
    """(N, 2) forward and turn as computed from wheels that are not what the robot believes."""
    scale, mismatch, width = rng.standard_normal(3) * (
        noise.scale,
        noise.wheel_mismatch,
        noise.wheelbase_scale,
    )
    left = (forward - turn * noise.wheelbase / 2) * (1 + scale - mismatch / 2)
    right = (forward + turn * noise.wheelbase / 2) * (1 + scale + mismatch / 2)
    return np.column_stack(((left + right) / 2, (right - left) / (noise.wheelbase * (1 + width))))


def _starts(times: FloatArray, per_minute: float, rng: np.random.Generator) -> list[int]:
    """Indices of the motions at which events begin: a Poisson process."""
    steps = len(times) - 1
    count = rng.poisson(per_minute * (times[-1] - times[0]) / 60)
    return sorted(rng.integers(0, steps, size=count).tolist()) if steps else []


def _reversed(
    times: FloatArray, driven: FloatArray, noise: OdometryNoise, rng: np.random.Generator
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """(N - 1,) whether a motion is recorded with the wrong sign."""
    mask = np.zeros(len(driven), dtype=np.bool_)
    path = np.concatenate(([0.0], np.cumsum(driven)))
    for start in _starts(times, noise.reversals_per_minute, rng):
        mask[start : np.searchsorted(path, path[start] + noise.reversal_length)] = True
    return mask


def _slips(times: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """(N - 1, 3) false motion, spread over a second each."""
    false = np.zeros((len(times) - 1, 3))
    for start in _starts(times, noise.slips_per_minute, rng):
        end = np.searchsorted(times[:-1], times[start] + 1.0)
        slip = rng.standard_normal(3) * (noise.slip_translation, 0.0, noise.slip_rotation)
        false[start:end] += slip / (end - start)
    return false
