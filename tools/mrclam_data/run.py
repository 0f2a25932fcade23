"""One data set played on line through a Team, and what came of it against the truth."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby

import gtsam
import numpy as np

from factors import EdgeKind, VertexId
from frontend import se2
from frontend.records import FloatArray
from mrtm.evaluation import AbsoluteErrors, TimedPoses, evaluate_ate, interpolate, nees
from mrtm.joint.graph import JointGraph
from tools.mrclam_data.dataset import RobotLog
from tools.mrclam_data.odometry import Odometry
from tools.mrclam_data.team import Seen, Team

# Seconds between the poses that are compared with the truth.
_EVERY = 1.0
# Vertices from which the others are seen to judge their covariances.
_REFERENCES = 15
# chi2 of 2 degrees of freedom, 99.9 %.
_FALSE = 13.8


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a team made of its sightings.

    Attributes:
        robots: those of the largest component; all figures are of these.
        joined: seconds from the first sighting until they were in one frame.
        vertices, edges: of the joint graph.
        steps: (n,) seconds of processor time for each second of the log with sightings.
        truth: world_T_robot, each second.
        joint: joint_T_robot at the end, at the same times.
        online: what each robot held its pose to be at the time, from when it was in the frame on.
        true_start: odometry alone from each robot's true first pose.
        common_start: odometry alone from where the robots held themselves to be when all were in one frame.
        honesty: NEES / degrees of freedom: odometry edges and sightings against the truth, and joint vertex poses.
        false_sightings: how many are beyond chi2 13.8 (99.9 %) of the final estimate.
    """

    robots: list[int]
    joined: float
    vertices: int
    edges: int
    steps: FloatArray
    truth: dict[str, TimedPoses]
    joint: dict[str, TimedPoses]
    online: dict[str, TimedPoses]
    true_start: dict[str, TimedPoses]
    common_start: dict[str, TimedPoses]
    honesty: dict[str, FloatArray]
    false_sightings: int

    def ate(self, poses: Mapping[str, TimedPoses]) -> AbsoluteErrors:
        """The error of one of the trajectories above, the whole team under one alignment."""
        return evaluate_ate(self.truth, poses)


def play(logs: Mapping[int, RobotLog], seen: list[Seen], window: float) -> Outcome:
    """Play sightings second by second, solving after each, and compare with the truth."""
    odometry = {robot: Odometry(log.odometry) for robot, log in logs.items()}
    team = Team(odometry, window)
    steps, live = [], []
    joined_at = begin = seen[0].time if seen else 0.0
    joined = len(team.components())
    for second, batch in groupby(seen, key=lambda s: np.floor(s.time)):
        start = time.process_time()
        team.step(batch)
        steps.append(time.process_time() - start)
        now = np.array([second + 1.0])
        live += [(team.component(robot).root, robot, now[0], team.poses(robot, now)[0]) for robot in logs]
        if len(team.components()) < joined:
            joined, joined_at = len(team.components()), now[0]
    graph, robots = next(iter(team.components().items()))
    graph.optimize_fully()

    trajectories: dict[str, dict[str, TimedPoses]] = {
        name: {} for name in ("truth", "joint", "online", "true_start", "common_start")
    }
    for robot in robots:
        log, wheels = logs[robot], odometry[robot]
        first, last = max(wheels.begin, log.truth.times[0]), min(wheels.end, log.truth.times[-1])
        times = np.arange(np.ceil(first), last, _EVERY)
        true, path = _truth(log, times), wheels.path(times)
        held = [(t, pose) for root, who, t, pose in live if root == graph.root and who == robot]
        online = TimedPoses(np.array([t for t, _ in held]), np.array([pose for _, pose in held]).reshape(-1, 3))
        at_joining = int(np.searchsorted(times, joined_at).clip(0, len(times) - 1))
        begin_at, _ = interpolate(online, times[at_joining : at_joining + 1], _EVERY)
        for name, poses in (
            ("truth", true),
            ("joint", team.poses(robot, times)),
            ("true_start", se2.compose(true[0], path)),
            ("common_start", se2.compose(begin_at, se2.between(path[at_joining], path))),
        ):
            trajectories[name][str(robot)] = TimedPoses(times, poses)
        trajectories["online"][str(robot)] = online
    return Outcome(
        robots=robots,
        joined=joined_at - begin,
        vertices=len(graph.vertices()),
        edges=len(graph.edges()),
        steps=np.array(steps),
        **trajectories,
        honesty=_honesty(graph, team, logs),
        false_sightings=sum(graph.chi2(e.id) > _FALSE for e in graph.edges() if e.kind is EdgeKind.SIGHTING),
    )


def _truth(log: RobotLog, times: FloatArray) -> FloatArray:
    """(n, 3) world_T_robot at times, NaN where motion capture lost the robot for a second."""
    return interpolate(log.truth, times, 1.0)[0]


def _honesty(graph: JointGraph, team: Team, logs: Mapping[int, RobotLog]) -> dict[str, FloatArray]:
    """NEES over degrees of freedom of odometry edges, sightings and vertices, seen from some all over the graph."""
    true: dict[VertexId, FloatArray] = {}
    for robot in {int(v.robot) for v in graph.vertices()}:
        for index, pose in enumerate(_truth(logs[robot], team.vertex_times(robot))):
            true[VertexId(str(robot), index)] = pose
    driven = [e for e in graph.edges() if e.kind is EdgeKind.INTER_VERTEX and e.estimate is not None]
    relative = np.array([se2.between(true[e.tail], true[e.head]) for e in driven])
    measured = np.array([_coordinates(e.estimate.pose) for e in driven if e.estimate is not None])
    sightings = []
    for edge in (e for e in graph.edges() if e.kind is EdgeKind.SIGHTING):
        error, _ = edge.residual(gtsam.Pose2(*se2.between(true[edge.tail], true[edge.head])))
        sightings.append(float(error @ np.linalg.solve(edge.covariance, error)) / 2.0)
    # One reference vertex would be one draw: its heading error is in all that is seen from it.
    vertices = graph.vertices()
    references = vertices[:: max(len(vertices) // _REFERENCES, 1)]
    joint = [_seen_from(graph, true, at, vertices[:: len(references)]) for at in references]
    return {
        "odometry edges": nees(relative, measured, np.array([e.covariance for e in driven])),
        "sightings": np.array(sightings),
        "joint vertex poses": np.concatenate(joint),
    }


def _seen_from(
    graph: JointGraph, true: Mapping[VertexId, FloatArray], reference: VertexId, vertices: Iterable[VertexId]
) -> FloatArray:
    """NEES over degrees of freedom of other vertices as seen from a ``reference``."""
    others = [v for v in vertices if v != reference]
    seen = graph.relatives([(reference, v) for v in others])
    return nees(
        np.array([se2.between(true[reference], true[v]) for v in others]),
        np.array([_coordinates(one.pose) for one in seen]),
        np.array([one.covariance for one in seen]),
    )


def _coordinates(pose: gtsam.Pose2) -> list[float]:
    return [pose.x(), pose.y(), pose.theta()]
