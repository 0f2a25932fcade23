"""A run: logs in, joint map out."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from factors import VertexId
from frontend import se2
from frontend.ahead import ahead
from frontend.grid import NX, NY, UNIT, N, X, Y
from frontend.local_map import Grid, LocalMap
from frontend.rbpf import first_run
from frontend.readers import open_log
from frontend.records import LaserScan
from mrtm.config import Config
from mrtm.joint.graph import JointGraph
from mrtm.output.export import export
from mrtm.progress import Progress
from mrtm.result import EdgeFate, Event, RunResult, Trajectory
from mrtm.robot.poses import array_of
from mrtm.robot.robot import Robot
from mrtm.robot.topology import Vertex
from mrtm.timing import Stages

MAPPING = 0.95  # of the time a run takes; the rest goes into writing


def run_log(path: Path, out: Path, config: Config, progress: Progress) -> RunResult:
    """Map one robot's log and write what a run leaves behind.

    The robot is called as the file is, without its endings.

    Raises:
        LogError: the log cannot be read or holds no usable scan.
    """
    log = open_log(path)
    if first_run():
        progress(0.0, "compiling the kernels, which only the first run does")

    def report(scans: int, vertices: int) -> None:
        progress(MAPPING * log.report.fraction, f"{scans} scans, {vertices} vertices")

    result = map_scans(ahead(log.scans()), config, report, path.name.split(".")[0])
    progress(MAPPING, "writing")
    result.blemishes.extend(log.report.blemishes())
    export(result, out)
    progress(1.0, f"{result.counts['scans']} scans, {result.counts['vertices']} vertices")
    return result


def map_scans(
    scans: Iterable[LaserScan],
    config: Config,
    report: Callable[[int, int], None] = lambda scans, vertices: None,
    name: str = "robot",
) -> RunResult:
    """Map one robot's scans; nothing is written.

    Args:
        report: told now and then how many scans have been taken and how many vertices there are.
    """
    stages = Stages()
    graphs: list[JointGraph] = []
    events: list[Event] = []

    def make_joint(root: VertexId) -> JointGraph:
        graphs.append(JointGraph(root))
        return graphs[-1]

    robot = Robot(name, config, make_joint, events.append, stages)
    source = iter(scans)
    while True:
        with stages("reading"):
            scan = next(source, None)
        if scan is None:
            break
        robot.process(scan)
        if len(robot.times) % 100 == 0:
            report(len(robot.times), len(robot.topology.vertices))
    robot.finish()
    graph = graphs[0]
    with stages("joint map"):
        graph.optimize_fully()
    return _result(robot, graph, config, events, stages)


def _result(robot: Robot, graph: JointGraph, config: Config, events: list[Event], stages: Stages) -> RunResult:
    topology = robot.topology
    joint = {v.id: graph.estimate(v.id) for v in topology.vertices}
    n = len(robot.times)
    poses, inside = np.zeros((n, 3)), np.zeros(n, np.int64)
    for vertex in topology.vertices:
        scans = np.array(vertex.scans, np.int64)
        poses[scans] = se2.compose(array_of(joint[vertex.id]), np.array(vertex.poses).reshape(-1, 3))
        inside[scans] = vertex.id.index
    times = np.array(robot.times)
    edges = topology.past + [EdgeFate(e, "accepted", chi2=graph.chi2(e.id)) for e in topology.edges.values()]
    return RunResult(
        config=config.model_dump(mode="json"),
        seed=config.seed,
        trajectories={robot.name: Trajectory(times, poses, inside)},
        local_maps={v.id: _local_map(v, times) for v in topology.vertices},
        vertex_poses=joint,
        vertex_covariances={v.id: graph.marginal(v.id) for v in topology.vertices},
        components=[[v.id for v in topology.vertices]],
        edges=edges,
        events=events,
        timings=stages.seconds,
        longest=stages.longest,
        counts={"scans": n, "vertices": len(joint), "edges": len(topology.edges)},
        blemishes=[],
    )


def _local_map(vertex: Vertex, times: np.ndarray) -> LocalMap:
    maps = vertex.maps
    assert maps is not None
    log_odds, corner = maps.known(0)
    grid = Grid(log_odds.astype(np.float32) / UNIT, maps.resolution, corner)
    surfels = maps.surfels[0, 1 : maps.counts[0]].astype(np.float64)
    surfels = surfels[surfels[:, N] > 0]
    normals = surfels[:, NX : NY + 1]
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    # A visit that was resumed has the scan of the seam twice; the later pose is the one that had the whole map.
    scans, order = np.unique(np.array(vertex.scans, np.int64)[::-1], return_index=True)
    order = len(vertex.scans) - 1 - order
    return LocalMap(
        grid,
        scans,
        times[scans],
        np.array(vertex.poses)[order],
        surfels[:, X : Y + 1],
        np.where(lengths > 0.5, normals / np.maximum(lengths, 0.5), 0.0),
    )
