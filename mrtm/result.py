"""What a run leaves in memory: everything that the output writes and the evaluation measures."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from factors import GraphEdge, VertexId
from frontend.local_map import LocalMap
from frontend.records import FloatArray


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A robot's poses at every scan of its log.

    Attributes:
        times: (n,) seconds, the log's own clock, in the order of the log (the clock may step back).
        poses: (n, 3) joint_T_robot: the most likely ones by all edges, local maps giving way between them.
        vertices: (n,) index of the vertex in whose local map the scan lies.
    """

    times: FloatArray
    poses: FloatArray
    vertices: npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class EdgeFate:
    """An edge that was ever made: ``fate`` is "accepted", "replaced" (by a newer version) or "refused", and why."""

    edge: GraphEdge
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


@dataclass(frozen=True, slots=True)
class Meeting:
    """Two robots that exchanged what they knew (M9, M10), and whether that brought them into one frame (M11).

    Attributes:
        time: team time, seconds.
        robots: the two.
        bytes: sent in both directions, by kind of record.
        verdict: "accepted", "waiting" or "refused", of the sightings between the two as a whole.
        reason: in words.
    """

    time: float
    robots: tuple[str, str]
    bytes: dict[str, int]
    verdict: str
    reason: str


@dataclass(frozen=True, slots=True)
class Latency:
    """How long somebody took from an event to a joint estimate that takes account of it.

    Attributes:
        time: team time of the event, seconds.
        robot: who; None for somebody who hears all, at the end.
        vertices: in the joint map then.
        seconds: by stage. Exchange counts for both robots; what sightings come to is worked out by the first of those
            who hold the same records.
    """

    time: float
    robot: str | None
    vertices: int
    seconds: dict[str, float]


@dataclass(frozen=True, slots=True)
class SightingFate:
    """What became of a sighting: ``fate`` is "accepted", "waiting" or "refused", and why, with the ``numbers``."""

    time: float
    observer: str
    observed: str
    fate: str
    reason: str
    numbers: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TeamStory:
    """How the robots of a team found together.

    Attributes:
        meetings: in the order of team time.
        sightings: likewise, as judged at the end with all that is known.
        first_meeting: team time of the first meeting, seconds; None if nobody met.
        common_frame: team time at which some robot first had all the robots of its component in its frame; None if
            every robot stayed alone.
        known: for every robot, the number of vertices that it had in its own frame at the end, by the robot that made
            them.
    """

    meetings: list[Meeting]
    sightings: list[SightingFate]
    first_meeting: float | None
    common_frame: float | None
    known: dict[str, dict[str, int]]


@dataclass(slots=True)
class RunResult:
    """Everything a run knows at its end, in the joint frame of each component's root.

    ``vertex_poses`` and ``vertex_covariances`` are of the vertices, the origins of the local maps, as the joint graph
    has them. There a map is surest, but off by what gathers on its way: ``map_poses``, joint_T_local too, bring each
    map, kept rigid, to where its scans lie in the trajectories on average. They are for drawing maps.

    ``timings`` are seconds by stage, ``longest`` those of the longest single call, ``latencies`` those of each event
    after which a joint map was brought up to date; these three differ from run to run. ``counts`` are plain numbers
    (scans, vertices, ...), ``blemishes`` one line each about what the log's reader met. ``components`` lists the
    vertices of each connected component, root first. ``team`` is None for a robot that was alone.
    """

    config: dict[str, Any]
    seed: int
    trajectories: dict[str, Trajectory]
    local_maps: dict[VertexId, LocalMap]
    map_poses: dict[VertexId, gtsam.Pose2]
    vertex_poses: dict[VertexId, gtsam.Pose2]
    vertex_covariances: dict[VertexId, FloatArray]
    components: list[list[VertexId]]
    edges: list[EdgeFate]
    events: list[Event]
    timings: dict[str, float]
    longest: dict[str, float]
    counts: dict[str, int]
    blemishes: list[str]
    team: TeamStory | None = None
    latencies: list[Latency] = field(default_factory=list)

    def placed_maps(self, vertices: Iterable[VertexId]) -> list[tuple[gtsam.Pose2, LocalMap]]:
        """The local maps of those of the vertices that have one, each with its pose in the joint frame."""
        return [(self.map_poses[v], self.local_maps[v]) for v in vertices if v in self.local_maps]
