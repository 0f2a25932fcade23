"""The joint graph of robots that drive blindly and see each other: vertices where they met, and nothing else."""

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from factors import (
    AnchoredSighting,
    Edge,
    EdgeId,
    EdgeKind,
    GraphEdge,
    Sighting,
    SightingEdge,
    UncertainPose,
    VertexId,
    fusing_edge,
    inverse,
)
from frontend.records import FloatArray
from mrtm.joint.graph import JointGraph
from tools.mrclam_data.joining import agreeing
from tools.mrclam_data.odometry import Odometry

_AT_VERTEX = UncertainPose(gtsam.Pose2(), np.zeros((3, 3)))


class Seen(NamedTuple):
    """A sighting at a time, the robots by number."""

    time: float
    observer: int
    observed: int
    sighting: Sighting


@dataclass(frozen=True, slots=True)
class Waiting:
    """A sighting between robots without a common frame, and their vertices at its time."""

    observer: VertexId
    observed: VertexId
    time: float
    sighting: Sighting


def select(
    sightings: Mapping[int, FloatArray], interval: float, sigma_range: float, sigma_bearing: float
) -> list[Seen]:
    """Raw sightings (n, 4) by observer, in the order of their times, of each robot by each the first in ``interval`` s.

    A camera's errors last for seconds (a robot seen from the side is off to the side), so that the sightings of a
    moment are not independent: one of them says as much as all.
    """
    seen = []
    for observer, rows in sightings.items():
        last: dict[int, float] = {}
        for time, observed, distance, bearing in rows.tolist():
            if time - last.get(int(observed), -np.inf) >= interval:
                last[int(observed)] = time
                measured = Sighting(distance, bearing, None, sigma_range, sigma_bearing, None)
                seen.append(Seen(time, observer, int(observed), measured))
    return sorted(seen, key=lambda s: s[:3])


class Team:
    """Robots' joint graph on line: one JointGraph a component, joined as soon as sightings allow.

    Every robot begins at its own origin. Each sighting makes a vertex of either robot at its time, after an odometry
    edge. Within a component it is a sighting edge at once. Between components it waits; when those of one pair within
    ``window`` agree, they become the fusing edge that joins the two, and the pairs that are then in one frame enter
    theirs that wait.

    Args:
        odometry: of each robot.
        window: seconds over which sightings are gathered to join two robots; their odometry must be good so long.
    """

    def __init__(self, odometry: Mapping[int, Odometry], window: float = 30.0) -> None:
        self._odometry = odometry
        self._window = window
        self._times: dict[int, list[float]] = {robot: [] for robot in odometry}
        self._graphs: dict[int, JointGraph] = {robot: JointGraph(self._vertex(robot, 0)) for robot in odometry}
        self._waiting: defaultdict[tuple[int, int], list[Waiting]] = defaultdict(list)
        self._numbers: defaultdict[str, int] = defaultdict(int)
        for robot, log in odometry.items():
            self._times[robot].append(log.begin)

    def components(self) -> dict[JointGraph, list[int]]:
        """Each joint graph and its robots, the largest first."""
        found: defaultdict[JointGraph, list[int]] = defaultdict(list)
        for robot, graph in self._graphs.items():
            found[graph].append(robot)
        return dict(sorted(found.items(), key=lambda item: -len(item[1])))

    def component(self, robot: int) -> JointGraph:
        """The joint graph the robot is in."""
        return self._graphs[robot]

    def vertex_times(self, robot: int) -> FloatArray:
        """(n,) the times of the robot's vertices 0 to n - 1."""
        return np.array(self._times[robot])

    def step(self, seen: Iterable[Seen]) -> None:
        """Take the sightings of a moment, in the order of their times, and solve."""
        edges: defaultdict[JointGraph, list[GraphEdge]] = defaultdict(list)
        for time, observer, observed, sighting in seen:
            if time < max(self._times[observer][0], self._times[observed][0]):
                continue  # before the odometry began
            ends = []
            for robot in (observer, observed):
                edges[self._graphs[robot]] += self._drive(robot, time)
                ends.append(self._vertex(robot, len(self._times[robot]) - 1))
            waiting = Waiting(ends[0], ends[1], time, sighting)
            if self._graphs[observer] is self._graphs[observed]:
                edges[self._graphs[observer]].append(self._sighting_edge(waiting))
            else:
                self._waiting[min(observer, observed), max(observer, observed)].append(waiting)
        for graph, new in edges.items():
            graph.update(add=new)
        self._join()

    def poses(self, robot: int, times: FloatArray) -> FloatArray:
        """(n, 3) the robot in the frame of its component at ``times``.

        By odometry from the vertex before; what is then missing to the vertex after grows evenly between the two.
        """
        graph, wheels, known = self._graphs[robot], self._odometry[robot], self._times[robot]
        found = []
        for time in times.tolist():
            before = max(bisect_right(known, time) - 1, 0)
            start = graph.estimate(self._vertex(robot, before))
            pose = start.compose(wheels.motion(known[before], max(time, known[before])).pose)
            if time > known[before] and before + 1 < len(known):
                end = graph.estimate(self._vertex(robot, before + 1))
                missing = pose.between(end.compose(wheels.motion(time, known[before + 1]).pose.inverse()))
                share = (time - known[before]) / (known[before + 1] - known[before])
                pose = pose.compose(gtsam.Pose2.Expmap(share * gtsam.Pose2.Logmap(missing)))
            found.append((pose.x(), pose.y(), pose.theta()))
        return np.array(found).reshape(-1, 3)

    def _join(self) -> None:
        """Join components over every pair whose waiting sightings agree."""
        for (first, second), waiting in sorted(self._waiting.items()):
            if self._graphs[first] is self._graphs[second]:
                continue
            latest = waiting[-1]
            self._waiting[first, second] = recent = [w for w in waiting if w.time > latest.time - self._window]
            anchors = {w.sighting: self._anchored(w, latest) for w in recent}
            agreed = agreeing(list(anchors.values()))
            edge = fusing_edge(self._edge_id("fusing"), 0, agreed) if agreed else None
            if edge is None:
                continue
            lose, keep = sorted((self._graphs[first], self._graphs[second]), key=lambda g: len(g.vertices()))
            keep.merge(lose, edge)
            self._graphs = {robot: keep if graph is lose else graph for robot, graph in self._graphs.items()}
            del self._waiting[first, second]  # used up, or false
            self._enter_waiting(keep)

    def _enter_waiting(self, graph: JointGraph) -> None:
        for pair in [p for p in self._waiting if self._graphs[p[0]] is self._graphs[p[1]] is graph]:
            graph.update(add=[self._sighting_edge(waiting) for waiting in self._waiting.pop(pair)])

    def _drive(self, robot: int, time: float) -> list[GraphEdge]:
        """The odometry edge to a vertex at ``time``; none if the robot is at one."""
        times = self._times[robot]
        if time - times[-1] < 1e-3:
            return []
        times.append(time)
        motion = self._odometry[robot].motion(times[-2], time)
        tail, head = (self._vertex(robot, len(times) - k) for k in (2, 1))
        number = self._edge_id(tail.robot)
        return [Edge(number, 0, EdgeKind.INTER_VERTEX, tail, head, motion.pose, motion.covariance)]

    def _anchored(self, waiting: Waiting, latest: Waiting) -> AnchoredSighting:
        """A waiting sighting, with the robots where they were then as seen from their vertices of the ``latest``."""
        ends = (latest.observer, latest.observed)
        if waiting.observer.robot != latest.observer.robot:
            ends = ends[::-1]
        observer, observed = (
            self._back(at, v) for at, v in zip(ends, (waiting.observer, waiting.observed), strict=True)
        )
        return AnchoredSighting(waiting.sighting, *ends, observer, observed)

    def _back(self, later: VertexId, earlier: VertexId) -> UncertainPose:
        """later_T_earlier of two vertices of a robot, by odometry."""
        robot = int(later.robot)
        times = self._times[robot]
        return inverse(self._odometry[robot].motion(times[earlier.number], times[later.number]))

    def _sighting_edge(self, waiting: Waiting) -> SightingEdge:
        anchored = AnchoredSighting(waiting.sighting, waiting.observer, waiting.observed, _AT_VERTEX, _AT_VERTEX)
        return SightingEdge(self._edge_id("sighting"), 0, anchored)

    def _edge_id(self, maker: str) -> EdgeId:
        self._numbers[maker] += 1
        return EdgeId(maker, self._numbers[maker])

    @staticmethod
    def _vertex(robot: int, index: int) -> VertexId:
        return VertexId(str(robot), index)
