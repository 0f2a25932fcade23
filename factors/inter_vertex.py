"""The edge by which a robot first left one vertex for a new one (M7b)."""

import gtsam

from factors.edge import Edge


def inter_vertex_factor(edge: Edge, tail: int, head: int) -> gtsam.BetweenFactorPose2:
    """tail_T_head with the particles' covariance at leaving, keys ``tail`` and ``head``.

    Not robust: when it is made, this edge is the only thing that holds the new vertex.
    """
    noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
    return gtsam.BetweenFactorPose2(tail, head, edge.measurement, noise)
