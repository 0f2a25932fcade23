"""Where in a known local map the robot may be, given one scan and a wide guess (the first half of M3's re-entry)."""

import math

import numpy as np

from frontend import se2
from frontend.grid import Maps
from frontend.matching import match, search
from frontend.parameters import FilterParameters
from frontend.points import Points
from frontend.records import FloatArray

PEAKS = 32
STEP_XY = 0.15  # metres: half the width that surfels cover around themselves
STEP_THETA = 0.035  # radians
MAX_XY = 8.0  # metres and
MAX_THETA = 0.8  # radians searched at most to each side
SEARCH_BEAMS = 120
PRIOR_WEIGHT = 0.003  # of the squared Mahalanobis distance to the guess, against the fraction of endpoints explained
APART_XY = 0.10  # metres and
APART_THETA = 0.05  # radians: hypotheses closer than this are one


def hypotheses(
    known: Maps, points: Points, guess: FloatArray, covariance: FloatArray, parameters: FilterParameters
) -> tuple[FloatArray, FloatArray]:
    """Poses in ``known`` (a stack of one) that explain a scan, best first.

    Args:
        guess: (3,) local_T_robot.
        covariance: (3, 3) of the guess in the robot's tangent frame; three standard deviations are searched.

    Returns:
        (k, 3) poses and (k,) scores: endpoints explained less endpoints in free space, as a fraction of all,
        less a little for the distance from the guess.
    """
    c, s = math.cos(guess[2]), math.sin(guess[2])
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    widened = rotation @ covariance @ rotation.T + np.diag([0.1**2, 0.1**2, 0.03**2])
    information = np.linalg.inv(widened)
    reach_xy = min(MAX_XY, 3.0 * math.sqrt(np.linalg.eigvalsh(widened[:2, :2])[1]))
    reach_theta = min(MAX_THETA, 3.0 * math.sqrt(widened[2, 2]))
    layers = known.layers(0)
    peaks = np.empty((PEAKS, 3))
    stride = max(1, len(points.hits) // SEARCH_BEAMS)
    found = search(
        *layers,
        points.hits,
        guess,
        reach_xy,
        STEP_XY,
        reach_theta,
        STEP_THETA,
        information,
        stride,
        peaks,
        np.empty(PEAKS),
    )
    poses, scores = [], []
    for start in peaks[:found]:
        pose = start.copy()
        fit, _, free, _ = match(*layers, points.hits, pose, guess, information, parameters.sigma, np.empty((3, 3)))
        pose[2] = se2.wrap(pose[2])
        poses.append(pose)
        offset = pose - guess
        offset[2] = se2.wrap(offset[2])
        scores.append((fit - free) / max(1, len(points.hits)) - PRIOR_WEIGHT * float(offset @ information @ offset))
    order = np.argsort(-np.array(scores), kind="stable")
    kept: list[int] = []
    for i in order:
        offsets = np.abs([se2.between(poses[j], poses[i]) for j in kept]).reshape(-1, 3)
        if not np.any((np.hypot(offsets[:, 0], offsets[:, 1]) < APART_XY) & (offsets[:, 2] < APART_THETA)):
            kept.append(int(i))
    return np.array(poses).reshape(-1, 3)[kept], np.array(scores)[kept]
