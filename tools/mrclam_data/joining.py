"""Which sightings between two robots agree: what may join them to begin with."""

from collections.abc import Sequence
from itertools import combinations

import gtsam
import numpy as np

from factors import AnchoredSighting, UncertainPose, fuse_sightings

# chi2 of 2 degrees of freedom, 99 %.
_AGREES = 9.21
# So many sightings and such a part of them must agree: a barcode misread is rarely misread alike again and again.
_LEAST, _PART = 4, 0.7
# Radians: a heading no better known may be far off, and a first edge cannot be.
_HEADING_SIGMA = 0.2


def agreeing(sightings: Sequence[AnchoredSighting]) -> list[AnchoredSighting]:
    """The largest set of sightings between the same two vertices that agree on one relative pose; empty if too few.

    Every two sightings propose a pose, as far as they fix one, and all are held against it; those that agree best
    propose once more, all together.
    """
    least = max(_LEAST, _PART * len(sightings))
    best: list[AnchoredSighting] = []
    for pair in combinations(sightings, 2):
        best = max(best, _near(sightings, pair), key=len)
    agreed = _near(sightings, best) if best else []
    fused = fuse_sightings(agreed) if len(agreed) >= least else None
    return agreed if fused is not None and fused.covariance[2, 2] < _HEADING_SIGMA**2 else []


def _near(sightings: Sequence[AnchoredSighting], proposing: Sequence[AnchoredSighting]) -> list[AnchoredSighting]:
    """The sightings that agree with the pose that some of them propose; empty if these fix none."""
    proposal = fuse_sightings(proposing)
    return [] if proposal is None else [s for s in sightings if _chi2(s, proposal) < _AGREES]


def _chi2(sighting: AnchoredSighting, proposal: UncertainPose) -> float:
    """Squared Mahalanobis distance of a sighting from a proposed lesser_T_greater, without the proposal's own error."""
    forward = sighting.observer_vertex < sighting.observed_vertex
    pose: gtsam.Pose2 = proposal.pose if forward else proposal.pose.inverse()
    error, _ = sighting.residual(pose)
    return float(error @ np.linalg.solve(sighting.covariance, error))
