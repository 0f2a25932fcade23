"""Alignment of two overlapping local maps (M13, on line): where one lies on the other, how sure, and whether at all."""

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import UncertainPose
from factors.noise import FloatArray
from frontend import se2
from mrtm.joint.alignment.agreement import Agreement, agreement, counts, scores
from mrtm.joint.alignment.correlative import SIGMAS, hypotheses
from mrtm.joint.alignment.fit import Fit, fit
from mrtm.joint.alignment.icp import COARSE, FINE, icp
from mrtm.joint.alignment.surface import Surface
from mrtm.robot.poses import array_of, innovation, pose_of

LEAST_OVERLAP = 10.0  # m^2 known in both maps
LEAST_PAIRS = 150  # points of one surface: 7.5 m of wall
MOST_RESIDUAL = 0.05  # metres, rms: between maps that are bent; walls at random distances have 0.087
LEAST_HITS = 0.7  # of the surface points in space known to the other map that must lie on its surfaces
MOST_CONFLICTS = 0.1  # of them that may lie in space it says is free: doors and people move
MOST_RIVAL = 0.9  # of the best place's score that another may have; long walls fit fairly well at many places
RIVAL_POINTS = 0.3  # of the best place's points that another must compare: a small overlap easily fits
GATE = 100.0  # chi2 of 3 degrees of freedom: farther from the guess it is another place; from 30 on the graph doubts it
DISTINCT = 25.0  # squared Mahalanobis distance between two optima that are not one
SLIDING = 0.92  # of the score at a slid position from which on the position is not seen
PROBES = (-1.0, -0.6, 0.6, 1.0)  # metres slid to see whether the position matters
GUESS_WEIGHT = 0.01  # of the guess's information that goes into an alignment, so that nothing is ever unknown


@dataclass(frozen=True, slots=True)
class Alignment:
    """What came of aligning two local maps.

    Attributes:
        estimate: a_T_b and its covariance, of the maps alone: where they say nothing the pose is the guess's and the
            standard deviation ten times the guess's, so that an edge of it does not count the guess twice.
        pairs: points of b that lie on the same surface of a.
        residual: their rms distance to its line, metres.
        agreement: of the two grids there.
        rival: the score of the best other place, as a fraction of this one's; 0 if there is none.
        innovation: chi2 of 3 degrees of freedom against the guess.
        shares: (k,) of a's places and of b's, that what lies on each other was drawn from, as of ``Bends.shares``.
        refusal: why it should not be believed, with the number; None if accepted.
    """

    estimate: UncertainPose
    pairs: int
    residual: float
    agreement: Agreement
    rival: float
    innovation: float
    shares: tuple[FloatArray, FloatArray]
    refusal: str | None

    @property
    def accepted(self) -> bool:
        """Whether it may become an edge."""
        return self.refusal is None


def align(a: Surface, b: Surface, guess: UncertainPose) -> Alignment | None:
    """Lay ``b`` on ``a``.

    Where three standard deviations of the guess are within the basin of ICP (point to line), it starts from there.
    Where they are not, every pose among them is looked at (correlative search), and it starts from the best of these.
    The place that brings most surfaces together is refined with more points, and judged.

    Args:
        a, b: two local maps, prepared.
        guess: a_T_b with its covariance, from the joint estimate.

    Returns:
        The alignment, accepted or not; None where nothing of the maps can meet.
    """
    places = _places(a, b, guess)
    if len(places) == 0:
        return None
    counted = counts(a.lookup, b.lookup, places)
    score = (counted[:, 1] - counted[:, 2]) / np.maximum(counted[:, 0], 1)
    first = int(np.argmax(counted[:, 1] - counted[:, 2]))
    best = icp(a, b, places[first], (FINE,))
    if best is None:
        return None
    found = fit(a, b, best)
    estimate = _estimate(guess, best, _seen(a, b, best, found, float(score[first])), found.drift)
    offsets = se2.log(se2.between(best, places))
    others = np.einsum("ki,ij,kj->k", offsets, np.linalg.inv(estimate.covariance), offsets) > DISTINCT
    others &= counted[:, 0] >= RIVAL_POINTS * counted[first, 0]
    rival = float(score[others].max(initial=0.0)) / max(float(score[first]), 0.01)
    agreed = agreement(a.lookup, b.lookup, array_of(estimate.pose))
    _, moved = innovation(guess, estimate)
    refusal = _refusal(found, agreed, rival, moved)
    return Alignment(estimate, found.pairs, found.residual, agreed, rival, moved, found.shares, refusal)


def _places(a: Surface, b: Surface, guess: UncertainPose) -> FloatArray:
    """(k, 3) poses at which surfaces of ``b`` lie on surfaces of ``a``, that the guess allows; k may be 0."""
    start = array_of(guess.pose)
    off = SIGMAS * _offset(b, guess.covariance)
    if off > COARSE[0].reach:
        starts = hypotheses(a, b, start, np.asarray(guess.covariance))
        found = [icp(a, b, pose, COARSE) for pose in starts]
    else:
        found = [icp(a, b, start, [r for r in COARSE if r.reach <= 2.0 * max(off, COARSE[-1].reach)])]
    return np.array([pose for pose in found if pose is not None]).reshape(-1, 3)


def _offset(b: Surface, covariance: FloatArray) -> float:
    """Standard deviation of where the guess has the points of ``b``, metres: their root mean square."""
    x, y = b.points.mean(axis=0) if len(b.points) else (0.0, 0.0)
    square = float(np.square(b.points).sum()) / max(1, len(b.points))
    turned = square * covariance[2, 2] + 2.0 * (x * covariance[1, 2] - y * covariance[0, 2])
    return math.sqrt(covariance[0, 0] + covariance[1, 1] + turned)


def _seen(a: Surface, b: Surface, best: FloatArray, found: Fit, score: float) -> FloatArray:
    """The information (3, 3) of a fit, without its weakest direction if sliding along that hardly matters.

    At an optimum along a corridor a few points at doors fix the position to centimetres, at any door.
    """
    information = found.information
    xy, mixed, theta = information[:2, :2], information[:2, 2], max(information[2, 2], 1e-9)
    weakest = np.linalg.eigh(xy - np.outer(mixed, mixed) / theta)[1][:, 0]
    slide = np.append(weakest, -mixed @ weakest / theta)  # turning as it fits best
    probes = se2.compose(best, np.outer(PROBES, slide))
    seen = information @ slide
    if scores(a.lookup, b.lookup, probes).max() <= SLIDING * score or slide @ seen <= 0.0:
        return information
    return np.asarray(information - np.outer(seen, seen) / (slide @ seen))


def _estimate(guess: UncertainPose, best: FloatArray, information: FloatArray, drift: FloatArray) -> UncertainPose:
    """The optimum, but what the maps do not see as guessed; along a bare corridor the optimum is anywhere."""
    covariance = np.linalg.inv(information + GUESS_WEIGHT * np.linalg.inv(guess.covariance))
    offset = gtsam.Pose2.Logmap(guess.pose.between(pose_of(best)))
    seen = covariance @ information @ offset
    return UncertainPose(guess.pose.compose(gtsam.Pose2.Expmap(seen)), covariance + drift)


def _refusal(found: Fit, agreed: Agreement, rival: float, moved: float) -> str | None:
    if agreed.overlap < LEAST_OVERLAP:
        return f"overlap {agreed.overlap:.0f} m^2, less than {LEAST_OVERLAP:.0f}"
    if found.pairs < LEAST_PAIRS:
        return f"{found.pairs} points in common, fewer than {LEAST_PAIRS}"
    if found.residual > MOST_RESIDUAL:
        return f"residual {found.residual:.3f} m, more than {MOST_RESIDUAL}"
    if agreed.hits < LEAST_HITS:
        return f"{agreed.hits:.0%} of the surfaces agree, less than {LEAST_HITS:.0%}"
    if agreed.conflicts > MOST_CONFLICTS:
        return f"{agreed.conflicts:.0%} of the surfaces lie in free space, more than {MOST_CONFLICTS:.0%}"
    if rival > MOST_RIVAL:
        return f"another place fits {rival:.0%} as well, more than {MOST_RIVAL:.0%}"
    if moved > GATE:
        return f"chi2 {moved:.1f} from the guess, more than {GATE}"
    return None
