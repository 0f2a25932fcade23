"""The alignment edge: two local maps that overlap, laid on each other (M13, on line)."""

import gtsam

from factors.edge import Edge
from factors.noise import robust


def alignment_factor(edge: Edge, tail: int, head: int) -> gtsam.BetweenFactorPose2:
    """tail_T_head under the robust kernel, keys ``tail`` and ``head``: places that look alike can be mistaken."""
    noise = robust(gtsam.noiseModel.Gaussian.Covariance(edge.covariance))
    return gtsam.BetweenFactorPose2(tail, head, edge.measurement, noise)
