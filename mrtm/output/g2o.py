"""The joint graph as g2o and GTSAM read it."""

from pathlib import Path

import gtsam
import numpy as np

from factors import VertexId, factor_of, without_kernel
from mrtm.output.files import replacing
from mrtm.result import RunResult


def write_g2o(path: Path, result: RunResult, components: list[list[VertexId]]) -> None:
    """Write the vertices of all components, numbered in their order, and the accepted edges between them.

    The root of each component is FIXed. An information matrix is the one with which the edge counts in the joint graph,
    in the frame of the edge's head, which is where g2o and GTSAM measure the error of EDGE_SE2.
    """
    vertices = [vertex for component in components for vertex in component]
    number = {vertex: i for i, vertex in enumerate(vertices)}
    lines = []
    for vertex in vertices:
        pose = result.vertex_poses[vertex]
        lines.append(f"VERTEX_SE2 {number[vertex]} {pose.x():.9f} {pose.y():.9f} {pose.theta():.12f}")
    for fate in result.edges:
        edge = fate.edge
        if fate.fate != "accepted" or edge.estimate is None:  # g2o has no type for a range and bearing with levers
            continue
        pose = edge.estimate.pose
        noise = without_kernel(factor_of(edge, 0, 1)).noiseModel()
        assert isinstance(noise, gtsam.noiseModel.Gaussian)
        upper = noise.information()[np.triu_indices(3)]
        lines.append(
            f"EDGE_SE2 {number[edge.tail]} {number[edge.head]} {pose.x():.9f} {pose.y():.9f} {pose.theta():.12f} "
            + " ".join(f"{value:.12g}" for value in upper)
        )
    # Last: GTSAM stops reading edges at a line it does not know.
    lines += [f"FIX {number[component[0]]}" for component in components if component]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
