"""The alignment edge: two local maps that overlap, laid on each other (M13, on line)."""

import gtsam

from factors.edge import Edge
from factors.noise import robust

SHARED = 2.0
"""Times the covariance of an alignment of two maps of one robot that it has in the graph, where all edges count as
independent: the maps' errors are also in the edges that led the robot from one to the other. That is covariance
intersection (Julier and Uhlmann 1997) with equal weights, which claims too much of neither whatever they share. Robots
share no such edge."""


def alignment_factor(edge: Edge, tail: int, head: int) -> gtsam.BetweenFactorPose2:
    """tail_T_head under the robust kernel, keys ``tail`` and ``head``: places that look alike can be mistaken."""
    times = SHARED if edge.tail.robot == edge.head.robot else 1.0
    noise = robust(gtsam.noiseModel.Gaussian.Covariance(times * edge.covariance))
    return gtsam.BetweenFactorPose2(tail, head, edge.measurement, noise)
