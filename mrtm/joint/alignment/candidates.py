"""Which closed maps are worth aligning after an event: those that are likely to overlap, not all pairs of all."""

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from itertools import islice
from typing import NamedTuple

import gtsam
import numba
import numpy as np

from factors import UncertainPose, VertexId
from frontend import se2
from frontend.records import FloatArray
from mrtm.joint.alignment.agreement import overlap
from mrtm.joint.alignment.align import LEAST_OVERLAP
from mrtm.joint.alignment.correlative import MAX_XY
from mrtm.joint.alignment.surface import Surface
from mrtm.robot.poses import array_of

MOST = 12  # pairs an event


class Candidate(NamedTuple):
    """Two vertices whose maps likely overlap, ``a`` before ``b``, and a_T_b as it is known."""

    a: VertexId
    b: VertexId
    guess: UncertainPose


def pairs(
    maps: Mapping[VertexId, Surface],
    poses: Mapping[VertexId, gtsam.Pose2],
    relatives: Callable[[list[tuple[VertexId, VertexId]]], list[UncertainPose]],
    wanted: Callable[[VertexId, VertexId], bool] = lambda a, b: True,
    most: int = MOST,
    looks: int | None = None,
) -> list[Candidate]:
    """The pairs of maps to align, the largest overlap first.

    Args:
        maps: of closed vertices of one component.
        poses: joint_T_local of at least these.
        relatives: a_T_b and its covariance in the frame of b, such as ``JointGraph.relatives``; asked of near pairs.
        wanted: whether a pair, a before b, is worth a look at all. All by default.
        most: pairs at most.
        looks: pairs that are asked about, those of the nearest maps; all by default.
    """
    vertices = sorted(vertex for vertex, surface in maps.items() if len(surface.points))
    if not vertices:
        return []
    circles = np.array([_circle(maps[vertex], poses[vertex]) for vertex in vertices])
    rows, columns, apart = _near(circles, MAX_XY)
    found: list[tuple[float, Candidate]] = []
    nearest = ((vertices[rows[n]], vertices[columns[n]], apart[n]) for n in np.argsort(apart, kind="stable"))
    asked = list(islice((near for near in nearest if wanted(*near[:2])), looks))
    for (a, b, between), guess in zip(asked, relatives([(a, b) for a, b, _ in asked]), strict=True):
        if between > 3.0 * np.sqrt(np.linalg.eigvalsh(guess.covariance[:2, :2])[1]):
            continue
        area = _likely_overlap(maps[a], maps[b], guess)
        if area >= LEAST_OVERLAP:
            found.append((area, Candidate(a, b, guess)))
    found.sort(key=lambda item: (-item[0], item[1].a, item[1].b))
    return [candidate for _, candidate in found[:most]]


@numba.njit(cache=True)
def _near(circles, reach):  # type: ignore[no-untyped-def]
    """Rows of every two circles that are ``reach`` apart or nearer, and how far; less than nothing if they overlap."""
    rows, columns, apart = [], [], []
    for i in range(len(circles)):
        for k in range(i + 1, len(circles)):
            dx, dy = circles[i, 0] - circles[k, 0], circles[i, 1] - circles[k, 1]
            centres = reach + circles[i, 2] + circles[k, 2]
            if dx * dx + dy * dy <= centres * centres:
                rows.append(i)
                columns.append(k)
                apart.append(math.sqrt(dx * dx + dy * dy) - circles[i, 2] - circles[k, 2])
    return np.array(rows), np.array(columns), np.array(apart)


def _circle(surface: Surface, pose: gtsam.Pose2) -> FloatArray:
    """Around what a map knows: x, y, radius in the joint frame."""
    x, y, radius = _extent(surface)
    return np.array([*pose.transformFrom(np.array([x, y])), radius])


@lru_cache(2**12)
def _extent(surface: Surface) -> tuple[float, float, float]:
    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    x, y = 0.5 * (low + high)
    return x, y, 0.5 * float(np.hypot(*(high - low)))


def _likely_overlap(a: Surface, b: Surface, guess: UncertainPose) -> float:
    """m^2 known in both, at the guess or a standard deviation beside it along its weakest direction, the most."""
    values, vectors = np.linalg.eigh(guess.covariance)
    aside = np.sqrt(values[2]) * vectors[:, 2]
    start = array_of(guess.pose)
    places = (start, se2.compose(start, aside), se2.compose(start, -aside))
    return max(overlap(a.lookup, b.lookup, place) for place in places)
