"""A finished run with its vertices elsewhere."""

from collections.abc import Mapping
from dataclasses import replace

import gtsam
import numpy as np

from factors import VertexId
from frontend import se2
from mrtm.result import RunResult, Trajectory


def moved(result: RunResult, poses: Mapping[VertexId, gtsam.Pose2]) -> RunResult:
    """The run with some vertices at other poses, and the scans taken there with them; without covariances."""
    trajectories = {}
    for robot, trajectory in result.trajectories.items():
        placed = trajectory.poses.copy()
        for index in np.unique(trajectory.vertices):
            vertex = VertexId(robot, int(index))
            if vertex in poses:
                shift = poses[vertex].compose(result.vertex_poses[vertex].inverse())
                inside = trajectory.vertices == index
                xytheta = np.array([shift.x(), shift.y(), shift.theta()])
                placed[inside] = se2.compose(xytheta, trajectory.poses[inside])
        trajectories[robot] = Trajectory(trajectory.times, placed, trajectory.vertices)
    return replace(
        result, trajectories=trajectories, vertex_poses=result.vertex_poses | dict(poses), vertex_covariances={}
    )
