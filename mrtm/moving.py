"""A finished run with its vertices elsewhere."""

from collections.abc import Mapping
from dataclasses import replace

import gtsam

from factors import VertexId
from frontend import se2
from mrtm.result import RunResult, Trajectory
from mrtm.robot.poses import array_of


def moved(result: RunResult, poses: Mapping[VertexId, gtsam.Pose2]) -> RunResult:
    """The run with some vertices at other poses, and with each its local map and scans, rigid; without covariances."""
    trajectories = {}
    for robot, trajectory in result.trajectories.items():
        placed = trajectory.poses.copy()
        for vertex in poses.keys() & result.local_maps.keys():
            if vertex.robot == robot:
                local_map = result.local_maps[vertex]
                # The scan with which the robot went on to the next vertex is in both maps, and lies in the later.
                inside = trajectory.vertices[local_map.scans] == vertex.number
                placed[local_map.scans[inside]] = se2.compose(array_of(poses[vertex]), local_map.poses[inside])
        trajectories[robot] = Trajectory(trajectory.times, placed, trajectory.vertices)
    return replace(
        result,
        trajectories=trajectories,
        map_poses=result.map_poses | dict(poses),
        vertex_poses=result.vertex_poses | dict(poses),
        vertex_covariances={},
    )
