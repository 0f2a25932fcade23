"""Absolute trajectory error against reference trajectories, one rigid alignment for the whole team."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from frontend import se2
from frontend.records import FloatArray
from mrtm.evaluation.statistics import Statistics
from mrtm.evaluation.trajectory import MAX_GAP, TimedPoses, interpolate


@dataclass(frozen=True, slots=True)
class AbsoluteErrors:
    """Errors after the alignment.

    Attributes:
        robots: whose trajectories were aligned as one.
        translation: metres between reference and aligned positions.
        rotation: degrees between reference and aligned headings.
        alignment: (x, y, theta) reference_T_joint, metres and radians.
        count: reference poses measured.
        no_scan: reference poses left out because no scan is close enough in time.
    """

    robots: tuple[str, ...]
    translation: Statistics
    rotation: Statistics
    alignment: tuple[float, float, float]
    count: int
    no_scan: int


def align(reference: FloatArray, estimate: FloatArray) -> FloatArray:
    """The rigid motion reference_T_estimate (3,) that brings points (n, 2) closest to reference points (n, 2).

    Closed form, no scale: S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 13(4), 1991, which in the plane is one arctangent.
    """
    to, of = reference.mean(axis=0), estimate.mean(axis=0)
    r, e = reference - to, estimate - of
    theta = math.atan2(float((e[:, 0] * r[:, 1] - e[:, 1] * r[:, 0]).sum()), float((e * r).sum()))
    rotation = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    return np.array([*(to - rotation @ of), theta])


def evaluate_ate(
    truth: Mapping[str, TimedPoses], trajectories: Mapping[str, TimedPoses], max_gap: float = MAX_GAP
) -> AbsoluteErrors:
    """Align all trajectories of one component with their references at once and measure what remains.

    Args:
        truth: the reference of each robot measured, world_T_robot in one world for all, in the log's own time.
        trajectories: joint_T_robot of these robots; those without a reference are not used.
        max_gap: see :func:`mrtm.evaluation.trajectory.interpolate`.
    """
    robots = tuple(name for name in trajectories if name in truth)
    found_references, found_estimates = [np.empty((0, 3))], [np.empty((0, 3))]
    for name in robots:
        poses, found = interpolate(trajectories[name], truth[name].times, max_gap)
        found_references.append(truth[name].poses[found])
        found_estimates.append(poses[found])
    reference, estimate = np.concatenate(found_references), np.concatenate(found_estimates)
    alignment = align(reference[:, :2], estimate[:, :2]) if len(reference) else np.full(3, np.nan)
    aligned = se2.compose(alignment, estimate)
    distance = np.hypot(*(aligned - reference)[:, :2].T)
    angle = np.degrees(np.abs(se2.wrap(aligned[:, 2] - reference[:, 2])))
    return AbsoluteErrors(
        robots=robots,
        translation=Statistics.of(distance),
        rotation=Statistics.of(angle),
        alignment=(float(alignment[0]), float(alignment[1]), float(alignment[2])),
        count=len(reference),
        no_scan=sum(len(truth[name].times) for name in robots) - len(reference),
    )
