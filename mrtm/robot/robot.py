"""One robot's TM-SLAM: steps M1 to M8, scan by scan."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal, Protocol

import numpy as np

from factors import Edge, EdgeKind, UncertainPose, VertexId, compose, intersect, inverse
from frontend import se2
from frontend.local_slam import LocalSlam, Visit
from frontend.points import Points, points_of
from frontend.records import FloatArray, LaserScan
from frontend.relocalisation import hypotheses
from mrtm.config import Config
from mrtm.result import Event
from mrtm.robot.poses import array_of, innovation, pose_of
from mrtm.robot.reentry import Candidate, Trial, candidates
from mrtm.robot.topology import Topology, Vertex
from mrtm.timing import Stages


class Joint(Protocol):
    """What the robot needs of the joint map: to tell it about edges, and to ask where a vertex is."""

    def update(self, *, add: Iterable[Edge] = (), replace: Iterable[Edge] = ()) -> None:
        """Enter new edges and new versions of known ones."""

    def relatives(self, pairs: Sequence[tuple[VertexId, VertexId]]) -> list[UncertainPose]:
        """a_T_b with its covariance in the frame of b, for every pair."""


class Robot:
    """Maps with one robot; feed it scans with ``process`` and end with ``finish``.

    Args:
        name: the robot's.
        config: of the run.
        make_joint: given the first vertex (M1), the joint map to work with.
        notify: told of every event.
        visited: told whenever a vertex's map has been closed: vertex, index of the visit's first scan, visit.
        stages: counts the time of every stage.
    """

    def __init__(
        self,
        name: str,
        config: Config,
        make_joint: Callable[[VertexId], Joint],
        notify: Callable[[Event], None],
        visited: Callable[[Vertex, int, Visit], None],
        stages: Stages,
    ) -> None:
        self.name = name
        self.config = config
        self.topology = Topology(name)
        self.times: list[float] = []
        self._notify = notify
        self._visited = visited
        self._stages = stages
        self._slam = LocalSlam(config.frontend, config.seed)
        self._half_width = 0.5 * config.frontend.travel_square
        self._odometry = np.zeros(3)
        self._here = self.topology.new_vertex()  # M1
        self._joint = make_joint(self._here.id)
        self._entered: tuple[Edge, UncertainPose] | None = None  # edge come by, and the pose at leaving its other end
        self._trial: Trial | None = None
        self._since_look = 0.0  # metres driven since M6 last looked around
        self._scan = -1  # index of the present scan
        self._first = 0  # index of the present visit's first scan

    def process(self, scan: LaserScan) -> None:
        """M2: take the next scan."""
        points = points_of(scan, self.config.frontend.sensing_range, self.config.frontend.max_beams)
        increment = se2.between(self._odometry, scan.odometry)
        self._odometry = scan.odometry
        self._scan += 1
        self.times.append(scan.time)
        if self._scan == 0:
            self._slam.begin(points, self._at_origin())
        else:
            self._advance(points, increment)

    def whereabouts(self, scan: int) -> tuple[VertexId, UncertainPose] | None:
        """The vertex and the pose in it, ``local_T_robot``, at a scan of the present visit, as far as is known now.

        None for a scan of an earlier visit, and while a re-entry is on trial.
        """
        if self._trial is not None or not self._first <= scan <= self._scan:
            return None
        pose = self._slam.path()[scan - self._first]
        return self._here.id, UncertainPose(pose_of(pose), self._slam.covariance())

    def finish(self) -> None:
        """M12: the log is at its end; close the vertex the robot is in."""
        while self._trial is not None:
            self._judge(self._trial, leaving=True)
        if self._scan >= 0:
            self._leave_map()

    def _advance(self, points: Points, increment: FloatArray) -> None:
        with self._stages("filter"):
            step = self._slam.add(points, increment)  # M3
        points = step.points
        if step.searched:
            self._tell("searched wider", level=step.searched, fit=step.fit, known=step.known)
        if step.reversed:
            self._tell("odometry reversed", forward="as recorded" if step.forward else "recorded as backward")
        outside = float(np.max(np.abs(step.pose[:2]))) / self._half_width  # M4
        if self._trial is not None:
            self._trial.add(step, increment)
            self._judge(self._trial, leaving=outside > TRIAL_SQUARE)
        elif outside > 1.0:
            self._leave(points)
        elif self._slam.length >= self.config.topology.longest_visit:
            self._resume(self._leave_map(), points, self._scan)
        else:
            self._look_around(step.pose, points, increment)

    def _leave_map(self) -> UncertainPose:
        """Close the present vertex's map; the robot's pose in it, with covariance."""
        with self._stages("closing"):
            visit = self._slam.finish()
        here = self._here
        chosen = visit.poses[visit.chosen]
        known = here.covariances(chosen, visit.covariances)
        here.maps, here.spread = visit.maps, visit.spread
        here.scans.extend(range(self._first, self._first + len(visit.poses)))
        here.poses.extend(visit.poses)
        here.drawn_from(chosen, known)
        self._tell(
            "left vertex",
            vertex=str(here.id),
            scans=len(visit.poses),
            since_resampling=visit.since_resampling,
            sigma=round(visit.sigma, 5),
        )
        self._update_edge(UncertainPose(pose_of(chosen[0]), known[0]))
        self._visited(here, self._first, replace(visit, covariances=known))
        return UncertainPose(pose_of(chosen[-1]), known[-1])

    def _update_edge(self, entered: UncertainPose) -> None:
        """M5: the vertex was entered by a known edge and is well known now; fuse the edge with what was measured."""
        if self._entered is None:
            return
        edge, left = self._entered
        self._entered = None
        measured = compose(left, inverse(entered))  # previous_T_here
        if edge.head != self._here.id:
            measured = inverse(measured)
        if edge.kind is EdgeKind.LOOP and edge.version == 0:
            # The edge that this visit made (M8): its measurement, with the pose as it is known now.
            kind, fused = EdgeKind.LOOP, measured
        else:
            # A loop that is met again may still be of two places that look alike.
            kind = EdgeKind.LOOP if edge.kind is EdgeKind.LOOP else EdgeKind.COVARIANCE_INTERSECTION
            fused = fuse(edge.estimate, measured, self.config.topology.omega)
        newer = Edge(edge.id, edge.version + 1, kind, edge.tail, edge.head, fused.pose, fused.covariance)
        self.topology.put(newer)
        with self._stages("joint map"):
            self._joint.update(replace=[newer])
        self._tell("edge updated", edge=str(newer), **_difference(edge.estimate, measured))

    def _leave(self, points: Points) -> None:
        """The robot has left the 2 d_s square (M4)."""
        left = self._leave_map()
        for candidate in self._candidates(left, self._half_width):
            if (found := self._fits(candidate, points)) is not None:
                self._enter_on_trial(candidate, left, points, found, resume=False)
                return
        self._create_vertex(left, points, self._scan)

    def _look_around(self, pose: FloatArray, points: Points, increment: FloatArray) -> None:
        """Beyond the paper: M6 before the border is reached, when the robot is deep inside another vertex's square.

        Else a robot whose square ends beyond a known place drives right through it, and maps it a second time.
        """
        p = self.config.topology
        self._since_look += float(np.hypot(increment[0], increment[1]))
        inner = p.attraction * self._half_width
        if self._since_look < p.look_distance or np.max(np.abs(pose[:2])) < inner:
            return
        self._since_look = 0.0
        for candidate in self._candidates(UncertainPose(pose_of(pose), self._slam.covariance()), inner):
            if (found := self._fits(candidate, points)) is not None:
                self._enter_on_trial(candidate, self._leave_map(), points, found, resume=True)
                return

    def _candidates(self, robot: UncertainPose, half_width: float) -> list[Candidate]:
        """M6."""
        p = self.config.topology
        here, others = self._here.id, [v for v in self.topology.vertices if v is not self._here]
        with self._stages("joint map"):
            if p.projection == "dijkstra":
                seen = self.topology.along_shortest_paths(here)
            else:
                poses = self._joint.relatives([(here, v.id) for v in others])
                seen = {v.id: pose for v, pose in zip(others, poses, strict=True)}
        return candidates(robot, others, seen, half_width, p.reach)[: p.candidates]

    def _fits(self, candidate: Candidate, points: Points) -> tuple[FloatArray, FloatArray] | None:
        """Poses in the candidate's map that explain the scan, with their scores; None if none does well enough."""
        guess, covariance = array_of(candidate.estimate.pose), candidate.estimate.covariance
        with self._stages("relocalising"):
            poses, scores = hypotheses(candidate.maps, points, guess, covariance, self.config.frontend)
        if len(scores) and scores[0] >= self.config.topology.entry_score:
            return poses, scores
        best = f"{scores[0]:.2f}" if len(scores) else "none"
        self._tell("re-entry refused", vertex=str(candidate.vertex.id), reason=f"the scan does not fit: score {best}")
        return None

    def _enter_on_trial(
        self,
        candidate: Candidate,
        left: UncertainPose,
        points: Points,
        found: tuple[FloatArray, FloatArray],
        resume: bool,
    ) -> None:
        """M3 with FL_re-enter: particles where the old map explains the scan, within the projected covariance."""
        self._trial = Trial(candidate, left, self._scan, resume)
        self._slam.begin(points, self._slam.spread(*found), candidate.maps, mapping=False)

    def _judge(self, trial: Trial, leaving: bool) -> None:
        with self._stages("relocalising"):
            accepted, reason = trial.verdict(self._slam, self.config.topology, leaving)
        if accepted is None:
            return
        self._trial = None
        if accepted:
            self._reenter(trial, reason)
            return
        self._tell("re-entry refused", vertex=str(trial.candidate.vertex.id), reason=reason)
        scans = self._slam.take_back()
        if trial.resume:
            self._resume(trial.left, scans[0][0], trial.first_scan)
        else:
            self._create_vertex(trial.left, scans[0][0], trial.first_scan)
        for self._scan, (points, increment) in enumerate(scans[1:], trial.first_scan + 1):
            self._advance(points, increment)

    def _resume(self, left: UncertainPose, points: Points, first_scan: int) -> None:
        """Go on in the vertex whose map has just been closed, as if it had not been."""
        self._first = first_scan
        particles = self._slam.particles(array_of(left.pose), self._here.spread)
        self._slam.begin(points, particles, self._here.maps, again=True)

    def _reenter(self, trial: Trial, reason: str) -> None:
        """The robot is in a known vertex again; M8 if no edge leads there yet."""
        entered = trial.entered(self._slam)
        self._slam.settle()
        previous, self._here, self._first = self._here, trial.candidate.vertex, trial.first_scan
        detail = {"vertex": str(self._here.id), "reason": reason, **_difference(trial.candidate.estimate, entered)}
        edge = self.topology.between(previous.id, self._here.id)
        if edge is None:
            measured = compose(trial.left, inverse(entered))
            edge = self.topology.new_edge(EdgeKind.LOOP, previous.id, self._here.id, measured)
            self._add_edge(edge)
            self._tell("loop closed", edge=str(edge), **detail)
        else:
            self._tell("re-entered", **detail)
        self._entered = edge, trial.left

    def _create_vertex(self, left: UncertainPose, points: Points, first_scan: int) -> None:
        """M7: a new vertex where the robot is, joined to the one it left."""
        vertex = self.topology.new_vertex()
        edge = self.topology.new_edge(EdgeKind.INTER_VERTEX, self._here.id, vertex.id, left)
        self._add_edge(edge)
        self._here, self._first = vertex, first_scan
        self._slam.begin(points, self._at_origin())
        self._tell("new vertex", vertex=str(vertex.id), edge=str(edge))

    def _add_edge(self, edge: Edge) -> None:
        self.topology.put(edge)
        with self._stages("joint map"):
            self._joint.update(add=[edge])

    def _at_origin(self) -> FloatArray:
        return np.zeros((self.config.frontend.particles, 3))

    def _tell(self, kind: str, **detail: Any) -> None:
        self._notify(Event(self.times[self._scan], self.name, kind, detail))


TRIAL_SQUARE = 1.5  # a robot on trial must have its verdict within this multiple of the travel square

CONTRADICTING = 11.34  # chi2 of 3 degrees of freedom that one in a hundred pairs of independent estimates exceeds


def fuse(old: UncertainPose, new: UncertainPose, omega: float | Literal["optimal"]) -> UncertainPose:
    """M5 of two estimates of an edge, see ``intersect``.

    Where they contradict each other one has slipped, and neither is as sure as it says: the covariance grows as their
    difference asks for (Birge 1932).
    """
    fused = intersect(old, new, omega)
    _, chi2 = innovation(old, new)
    return fused if chi2 < CONTRADICTING else UncertainPose(fused.pose, chi2 / 3.0 * fused.covariance)


def _difference(expected: UncertainPose, measured: UncertainPose) -> dict[str, Any]:
    """``offset`` of a measurement from what was expected and its ``innovation``, chi2 over its 3 degrees of freedom."""
    offset, chi2 = innovation(expected, measured)
    return {"offset": [round(float(v), 4) for v in offset], "innovation": round(chi2 / 3.0, 3)}
