"""A run whose truth is known: two robots that drove through two rooms joined by a door, and a third that met nobody."""

import gtsam
import numpy as np

from factors import Edge, EdgeId, EdgeKind, VertexId
from frontend.local_map import Grid, LocalMap
from frontend.records import FloatArray
from mrtm.result import EdgeFate, Event, RunResult, Trajectory

RESOLUTION = 0.05
ROOMS = ((0.0, 0.0, 6.0, 4.0), (6.0, 0.0, 10.0, 4.0))
DOOR = (5.0, 1.5, 7.0, 2.5)


def inside(x: FloatArray, y: FloatArray) -> FloatArray:
    """Metres to the nearest wall, negative outside, in the joint frame."""
    boxes = [np.minimum(np.minimum(x - a, c - x), np.minimum(y - b, d - y)) for a, b, c, d in (*ROOMS, DOOR)]
    return np.asarray(np.max(boxes, axis=0))


def local_map(pose: gtsam.Pose2, first: int, times: FloatArray, poses: FloatArray, size: float = 14.0) -> LocalMap:
    """The rooms as seen from a vertex at joint_T_local, for scans whose joint poses are given (n, 3)."""
    cells = round(size / RESOLUTION)
    centres = RESOLUTION * (np.arange(cells) + 0.5) - size / 2
    x, y = np.meshgrid(centres, centres)
    cos, sin = np.cos(pose.theta()), np.sin(pose.theta())
    depth = inside(pose.x() + cos * x - sin * y, pose.y() + sin * x + cos * y)
    log_odds = np.where(np.abs(depth) < 0.6 * RESOLUTION, 4.0, np.where(depth > 0, -3.0, 0.0)).astype(np.float32)
    rows, columns = np.nonzero(log_odds > 0)
    local = [pose.between(gtsam.Pose2(*p)) for p in poses]
    return LocalMap(
        Grid(log_odds, RESOLUTION, np.array([-size / 2, -size / 2])),
        np.arange(first, first + len(times)),
        times,
        np.array([[p.x(), p.y(), p.theta()] for p in local]),
        np.column_stack([centres[columns], centres[rows]]),
        np.tile([0.0, 1.0], (len(rows), 1)),
    )


def sample_run(seed: int = 3) -> RunResult:
    """Red and blue in one component of four vertices, a lone green one; one loop accepted, one refused."""
    rng = np.random.default_rng(seed)
    robots = {
        "red": (100.0, [(1.0, 2.0, 0.3), (4.5, 2.0, -2.0)]),
        "blue": (500.0, [(9.0, 3.0, 1.2), (7.5, 1.0, 3.0)]),
        "green": (900.0, [(3.0, 1.0, 0.0)]),
    }
    trajectories, maps, vertex_poses = {}, {}, {}
    for robot, (start, corners) in robots.items():
        ends = [*corners[1:], (corners[-1][0] + 0.5, corners[-1][1], corners[-1][2])]
        joint, owners = [], []
        for index, (corner, end) in enumerate(zip(corners, ends, strict=True)):
            steps = np.linspace(0, 1, 10, endpoint=False)[:, None]
            # In each vertex the robot keeps its first heading: the first pose is the vertex itself.
            poses = np.column_stack([corner[:2] + steps * np.subtract(end[:2], corner[:2]), np.full(10, corner[2])])
            vertex = VertexId(robot, index)
            vertex_poses[vertex] = gtsam.Pose2(*corner)
            times = start + 2.0 * index + np.linspace(0.0, 1.8, 10)
            maps[vertex] = local_map(vertex_poses[vertex], 10 * index, times, poses)
            joint.append(poses)
            owners += [index] * 10
        times = start + np.linspace(0.0, 0.2 * len(owners) - 0.2, len(owners))
        trajectories[robot] = Trajectory(times, np.concatenate(joint), np.array(owners))

    covariance = np.diag([0.02, 0.03, 0.01]) ** 2

    def edge(number: int, kind: EdgeKind, tail: VertexId, head: VertexId, version: int = 0) -> Edge:
        noise = gtsam.Pose2.Expmap(rng.multivariate_normal(np.zeros(3), covariance))
        measured = vertex_poses[tail].between(vertex_poses[head]).compose(noise)
        return Edge(EdgeId(tail.robot, number), version, kind, tail, head, measured, covariance)

    red0, red1, blue0, blue1 = (VertexId(robot, index) for robot in ("red", "blue") for index in (0, 1))
    edges = [
        EdgeFate(edge(0, EdgeKind.INTER_VERTEX, red0, red1), "replaced"),
        EdgeFate(edge(0, EdgeKind.COVARIANCE_INTERSECTION, red0, red1, version=1), "accepted", chi2=1.5),
        EdgeFate(edge(0, EdgeKind.INTER_VERTEX, blue0, blue1), "accepted"),
        EdgeFate(edge(1, EdgeKind.LOOP, red1, blue1), "accepted", chi2=2.0),
        EdgeFate(edge(1, EdgeKind.LOOP, blue1, red0), "refused", "chi2 40 beyond 11.3", 40.0),
    ]
    return RunResult(
        config={"frontend": {"particles": 40}},
        seed=seed,
        trajectories=trajectories,
        local_maps=maps,
        map_poses=vertex_poses,
        vertex_poses=vertex_poses,
        vertex_covariances=dict.fromkeys(vertex_poses, covariance),
        components=[[VertexId("green", 0)], [red0, red1, blue0, blue1]],
        edges=edges,
        events=[Event(100.0, "red", "new vertex", {"vertex": 0})],
        timings={"front end": 1.0, "total": 2.0},
        longest={"front end": 0.1},
        counts={"scans": 50, "vertices": 5},
        blemishes=["red.clf:12: unreadable"],
    )
