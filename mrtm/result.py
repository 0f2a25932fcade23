"""What a run leaves in memory: everything that the output writes and the evaluation measures."""

from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from factors import Edge, VertexId
from frontend.local_map import LocalMap
from frontend.records import FloatArray


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A robot's poses at every scan of its log.

    Attributes:
        times: (n,) seconds, the log's own clock, in the order of the log (the clock may step back).
        poses: (n, 3) joint_T_robot.
        vertices: (n,) index of the vertex in whose local map the scan lies.
    """

    times: FloatArray
    poses: FloatArray
    vertices: npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class EdgeFate:
    """An edge that was ever made: ``fate`` is "accepted", "replaced" (by a newer version) or "refused", and why."""

    edge: Edge
    fate: str
    reason: str = ""
    chi2: float = float("nan")


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened on the way, for the report: time, what (e.g. "new vertex"), where, and the numbers."""

    time: float
    robot: str
    kind: str
    detail: dict[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class RunResult:
    """Everything a run knows at its end, in the joint frame of each component's root.

    ``timings`` are seconds by stage, ``longest`` those of the longest single call, ``counts`` plain numbers (scans,
    vertices, ...), ``blemishes`` one line each about what the log's reader met. ``components`` lists the vertices of
    each connected component, root first.
    """

    config: dict[str, Any]
    seed: int
    trajectories: dict[str, Trajectory]
    local_maps: dict[VertexId, LocalMap]
    vertex_poses: dict[VertexId, gtsam.Pose2]
    vertex_covariances: dict[VertexId, FloatArray]
    components: list[list[VertexId]]
    edges: list[EdgeFate]
    events: list[Event]
    timings: dict[str, float]
    longest: dict[str, float]
    counts: dict[str, int]
    blemishes: list[str]
