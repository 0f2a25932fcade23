"""How long two components take to become one: ``python -m tools.bench.joining``."""

import time
from typing import Annotated

import gtsam
import numpy as np
import typer

from factors import Edge, EdgeId, EdgeKind, VertexId
from frontend.records import FloatArray
from mrtm.joint.graph import JointGraph

STEP = np.diag([0.05, 0.03, 0.005]) ** 2
MEETING = np.diag([0.05, 0.05, 0.01]) ** 2


def drive(robot: str, vertices: int, loops: int, rng: np.random.Generator) -> tuple[JointGraph, list[gtsam.Pose2]]:
    """A robot's own graph, three rounds of a ring of 8 m steps with loops between any two vertices; and the truth."""
    poses = [gtsam.Pose2()]
    while len(poses) < vertices:
        poses.append(poses[-1].compose(gtsam.Pose2(8.0, 0.0, 6.0 * np.pi / vertices + rng.normal(0.0, 0.1))))

    def edge(number: int, kind: EdgeKind, i: int, j: int) -> Edge:
        measured = _noisy(poses[i].between(poses[j]), STEP, rng)
        return Edge(EdgeId(robot, number), 0, kind, VertexId(robot, i), VertexId(robot, j), measured, STEP)

    graph = JointGraph(VertexId(robot, 0))
    graph.update(add=[edge(i, EdgeKind.INTER_VERTEX, i, i + 1) for i in range(vertices - 1)])
    for number in range(loops):
        i, j = sorted(rng.choice(vertices, 2, replace=False).tolist())
        graph.update(add=[edge(vertices + number, EdgeKind.LOOP, i, j)])
    return graph, poses


def join(vertices: int, fusing: int, seed: int) -> float:
    """Seconds from two graphs and so many fusing edges between them to the estimate of every vertex."""
    rng = np.random.default_rng(seed)
    (red, red_poses), (blue, blue_poses) = (drive(robot, vertices, vertices // 4, rng) for robot in ("red", "blue"))
    offset = gtsam.Pose2(20.0, 5.0, 1.0)
    edges = []
    for number, (i, j) in enumerate(rng.choice(vertices, (fusing, 2)).tolist()):
        measured = _noisy(red_poses[i].between(offset.compose(blue_poses[j])), MEETING, rng)
        ends = VertexId("red", i), VertexId("blue", j)
        edges.append(Edge(EdgeId("meeting", number), 0, EdgeKind.FUSING, *ends, measured, MEETING))
    start = time.perf_counter()
    red.merge(blue, edges[0], edges[1:])
    red.estimates()
    return time.perf_counter() - start


def main(
    vertices: Annotated[int, typer.Option(min=2, help="Of either component.")] = 100,
    runs: Annotated[int, typer.Option(min=1, help="Graphs joined, each of its own seed.")] = 20,
) -> None:
    """Join two components by one fusing edge and by five."""
    for fusing in (1, 5):
        times = 1e3 * np.array([join(vertices, fusing, seed) for seed in range(runs)])
        typer.echo(
            f"two components of {vertices} vertices, {fusing} fusing edges: "
            f"median {np.median(times):.1f} ms, worst {times.max():.1f} ms of {runs}"
        )


def _noisy(pose: gtsam.Pose2, covariance: FloatArray, rng: np.random.Generator) -> gtsam.Pose2:
    return pose.compose(gtsam.Pose2.Expmap(rng.multivariate_normal(np.zeros(3), covariance)))


if __name__ == "__main__":
    typer.run(main)
