"""The loop edge: a robot re-entered a vertex from one not adjacent to it (M8)."""

import gtsam

from factors.edge import Edge
from factors.noise import robust


def loop_factor(edge: Edge, tail: int, head: int) -> gtsam.BetweenFactorPose2:
    """tail_T_head under the robust kernel, keys ``tail`` and ``head``: a re-entry may be false."""
    noise = robust(gtsam.noiseModel.Gaussian.Covariance(edge.covariance))
    return gtsam.BetweenFactorPose2(tail, head, edge.measurement, noise)
