"""One robot's TM-SLAM: steps M1 to M8, scan by scan."""

from collections.abc import Callable, Iterable
from typing import Any, Protocol

import gtsam
import numpy as np

from factors import Edge, EdgeKind, UncertainPose, VertexId, compose, intersect, inverse
from frontend import se2
from frontend.local_slam import LocalSlam
from frontend.points import Points, points_of
from frontend.records import FloatArray, LaserScan
from frontend.relocalisation import hypotheses, spread
from mrtm.config import Config
from mrtm.result import Event
from mrtm.robot.reentry import Candidate, Trial, array_of, candidates, pose_of
from mrtm.robot.topology import Topology, Vertex


SUBMAP_SCANS = 12  # taken together to confirm a re-entry
APART = 0.25  # metres between two places that are not the same
CHECK_DISTANCE = 0.5  # metres driven between two attempts to confirm


class Joint(Protocol):
    """What the robot needs of the joint map: to tell it about edges, and to ask where a vertex is."""

    def update(self, *, add: Iterable[Edge] = (), replace: Iterable[Edge] = ()) -> None:
        """Enter new edges and new versions of known ones."""

    def relative(self, a: VertexId, b: VertexId) -> UncertainPose:
        """a_T_b with its covariance in the frame of b."""


class Robot:
    """Maps with one robot; feed it scans with ``process`` and end with ``finish``.

    Args:
        name: the robot's.
        config: of the run.
        make_joint: given the first vertex (M1), the joint map to work with.
        notify: told of every event.
    """

    def __init__(
        self, name: str, config: Config, make_joint: Callable[[VertexId], Joint], notify: Callable[[Event], None]
    ) -> None:
        self.name = name
        self.config = config
        self.topology = Topology(name)
        self.times: list[float] = []
        self._notify = notify
        self._slam = LocalSlam(config.frontend, config.seed)
        self._random = np.random.default_rng(config.seed)
        self._half_width = 0.5 * config.frontend.travel_square
        self._odometry = np.zeros(3)
        self._here = self.topology.new_vertex()  # M1
        self._joint = make_joint(self._here.id)
        self._entered: tuple[Edge, UncertainPose] | None = None  # edge come by, pose on it at leaving the other vertex
        self._trial: Trial | None = None
        self._scan = -1  # index of the present scan
        self._since_look = 0.0  # metres driven since M6 last looked around
        self._first = 0  # index of the present visit's first scan

    def process(self, scan: LaserScan) -> None:
        """M2: take the next scan."""
        points = points_of(scan, self.config.frontend.sensing_range, self.config.frontend.max_beams)
        increment = se2.between(self._odometry, scan.odometry)
        self._odometry = scan.odometry
        self._scan += 1
        self.times.append(scan.time)
        if self._scan == 0:
            self._slam.begin(points, np.zeros((self.config.frontend.particles, 3)))
        else:
            self._advance(points, increment)

    def finish(self) -> None:
        """M12: the log is at its end; close the vertex the robot is in."""
        if self._scan < 0:
            return
        if self._trial is not None:
            self._judge(leaving=True)
        self._leave_map()

    def _advance(self, points: Points, increment: FloatArray) -> None:
        step = self._slam.add(points, increment)  # M3
        if step.searched:
            self._tell("searched wider", level=step.searched, fit=step.fit, known=step.known)
        outside = bool(np.max(np.abs(step.pose[:2])) > self._half_width)  # M4
        if self._trial is not None:
            self._trial.add(step, increment)
            outside = bool(np.max(np.abs(step.pose[:2])) > 1.5 * self._half_width)
            self._judge(leaving=outside)
        elif outside:
            self._leave(points)
        else:
            self._look_around(step.pose, points, increment)

    def _leave_map(self) -> UncertainPose:
        """Close the present vertex's map; the robot's pose in it, with covariance."""
        visit = self._slam.finish()
        here = self._here
        here.maps = visit.maps
        here.scans.extend(range(self._first, self._first + len(visit.poses)))
        here.poses.extend(visit.poses)
        self._tell("left vertex", vertex=str(here.id), scans=len(visit.poses), since_resampling=visit.since_resampling)
        self._update_edge(UncertainPose(pose_of(visit.poses[0]), visit.covariance))
        return UncertainPose(pose_of(visit.poses[-1]), visit.covariance)

    def _update_edge(self, entered: UncertainPose) -> None:
        """M5: the vertex was entered by a known edge and is well known now; fuse the edge with what entering measured."""
        if self._entered is None:
            return
        edge, left = self._entered
        self._entered = None
        measured = compose(left, inverse(entered))  # previous_T_here
        if edge.head != self._here.id:
            measured = inverse(measured)
        if edge.kind is EdgeKind.LOOP and edge.version == 0:
            # The edge this visit made (M8): its measurement with the pose as it is known now.
            kind, fused = EdgeKind.LOOP, measured
        else:
            kind, fused = (
                EdgeKind.COVARIANCE_INTERSECTION,
                intersect(edge.estimate, measured, self.config.topology.omega),
            )
        newer = Edge(edge.id, edge.version + 1, kind, edge.tail, edge.head, fused.pose, fused.covariance)
        self.topology.put(newer)
        self._joint.update(replace=[newer])
        self._tell("edge updated", edge=str(newer), **_innovation(edge.estimate, measured))

    def _leave(self, points: Points) -> None:
        """The robot has left the 2 d_s square (M4)."""
        left = self._leave_map()
        for candidate in self._candidates(left, self._half_width):
            if (found := self._fits(candidate, points)) is not None:
                self._enter_on_trial(candidate, left, points, found, resume=False)
                return
        self._create_vertex(left, points)

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
        robot = UncertainPose(pose_of(pose), self._slam.covariance())
        for candidate in self._candidates(robot, inner):
            if (found := self._fits(candidate, points)) is not None:
                left = self._leave_map()
                self._enter_on_trial(candidate, left, points, found, resume=True)
                return

    def _candidates(self, left: UncertainPose, half_width: float) -> list[Candidate]:
        """M6."""
        p = self.config.topology
        if p.projection == "dijkstra":
            project = self.topology.along_shortest_paths(self._here.id)
        else:

            def project(vertex: VertexId) -> UncertainPose:
                return self._joint.relative(self._here.id, vertex)

        others = [v for v in self.topology.vertices if v is not self._here]
        return candidates(left, others, project, half_width, p.reach)[: p.candidates]

    def _fits(self, candidate: Candidate, points: Points) -> tuple[FloatArray, FloatArray] | None:
        """Poses in the candidate's map that explain the scan, with their scores; None if none does well enough."""
        known = candidate.vertex.maps
        assert known is not None
        guess, covariance = array_of(candidate.estimate.pose), candidate.estimate.covariance
        poses, scores = hypotheses(known, points, guess, covariance, self.config.frontend)
        if len(scores) and scores[0] >= self.config.topology.entry_score:
            return poses, scores
        score = f"{scores[0]:.2f}" if len(scores) else "none"
        self._tell("re-entry refused", vertex=str(candidate.vertex.id), reason=f"the scan does not fit: score {score}")
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
        particles = spread(*found, self.config.frontend.particles, self._random)
        self._trial = Trial(candidate, left, self._scan, resume)
        self._slam.begin(points, particles, candidate.vertex.maps, mapping=False)

    def _judge(self, leaving: bool) -> None:
        trial = self._trial
        assert trial is not None
        covariance = self._slam.covariance()
        accepted, reason = trial.verdict(covariance, self.config.topology, leaving)
        if accepted is None:
            return
        vertex = trial.candidate.vertex
        if accepted:
            accepted, why = self._confirm(trial)
            reason = f"{reason}, {why}"
            if accepted is None:
                if not leaving and trial.distance < trial.limit(self.config.topology):
                    return
                accepted = False
        self._trial = None
        entered = UncertainPose(pose_of(self._slam.path()[0]), covariance)
        surprise = 3.0 * _innovation(trial.candidate.estimate, entered)["innovation"]
        if accepted and surprise > self.config.topology.gate:
            accepted, reason = False, f"contradicts the joint map: chi2 {surprise:.1f}, {reason}"
        if accepted:
            self._slam.settle()
            self._reenter(vertex, trial, entered, reason)
            return
        self._tell("re-entry refused", vertex=str(vertex.id), reason=reason)
        scans = self._slam.scans()
        if trial.resume:
            self._first = trial.first_scan
            poses = np.tile(array_of(trial.left.pose), (self.config.frontend.particles, 1))
            self._slam.begin(scans[0][0], poses, self._here.maps)
        else:
            self._create_vertex(trial.left, scans[0][0], trial.first_scan)
        for self._scan, (points, increment) in enumerate(scans[1:], trial.first_scan + 1):
            self._advance(points, increment)

    def _confirm(self, trial: Trial) -> tuple[bool | None, str]:
        """Search the whole of the projected covariance again, with all that the trial has seen so far as one scan.

        One scan may fit in many places where a stretch of them fits in one. True: it fits where the particles are. None:
        it does not, or nearly as well elsewhere; where it clearly fits elsewhere, the trial starts again from there.
        """
        p = self.config.topology
        if trial.distance < trial.next_check:
            return None, "unconfirmed"
        trial.next_check = trial.distance + CHECK_DISTANCE
        path = self._slam.path()
        driven = pose_of(se2.between(path[0], path[-1]))
        guess = compose(trial.candidate.estimate, UncertainPose(driven, np.zeros((3, 3))))
        known = trial.candidate.vertex.maps
        assert known is not None
        poses, scores = hypotheses(
            known, self._slam.submap(SUBMAP_SCANS), array_of(guess.pose), guess.covariance, self.config.frontend
        )
        if not len(poses):
            return None, "fits nowhere"
        offsets = se2.between(poses[0], poses)
        elsewhere = scores[np.hypot(offsets[:, 0], offsets[:, 1]) > APART]
        lead = float(scores[0] - elsewhere[0]) if len(elsewhere) else 1.0
        off = float(np.hypot(*se2.between(path[-1], poses[0])[:2]))
        numbers = f"leads by {lead:.2f}, {off:.2f} m off"
        if lead < p.trial_lead:
            return None, numbers
        if off <= 0.5 * APART:
            return True, numbers
        scans = self._slam.scans()
        start = se2.compose(poses[0], se2.between(path[-1], path[0]))
        particles = spread(start[None], np.zeros(1), self.config.frontend.particles, self._random)
        self._slam.begin(scans[0][0], particles, known, mapping=False)
        trial.restart()
        for points, increment in scans[1:]:
            trial.add(self._slam.add(points, increment), increment)
        return None, numbers

    def _reenter(self, vertex: Vertex, trial: Trial, entered: UncertainPose, reason: str) -> None:
        """The robot is in a known vertex again; M8 if no edge leads there yet."""
        previous = self._here
        self._here, self._first = vertex, trial.first_scan
        measured = compose(trial.left, inverse(entered))
        edge = self.topology.between(previous.id, vertex.id)
        detail = {"vertex": str(vertex.id), "reason": reason, **_innovation(trial.candidate.estimate, entered)}
        if edge is None:
            edge = self.topology.new_edge(EdgeKind.LOOP, previous.id, vertex.id, measured)
            self.topology.put(edge)
            self._joint.update(add=[edge])
            self._tell("loop closed", edge=str(edge), **detail)
        else:
            self._tell("re-entered", **detail)
        self._entered = edge, trial.left

    def _create_vertex(self, left: UncertainPose, points: Points, first_scan: int | None = None) -> None:
        """M7: a new vertex where the robot is, joined to the one it left."""
        vertex = self.topology.new_vertex()
        edge = self.topology.new_edge(EdgeKind.INTER_VERTEX, self._here.id, vertex.id, left)
        self.topology.put(edge)
        self._joint.update(add=[edge])
        self._here, self._first = vertex, self._scan if first_scan is None else first_scan
        self._slam.begin(points, np.zeros((self.config.frontend.particles, 3)))
        self._tell("new vertex", vertex=str(vertex.id), edge=str(edge))

    def _tell(self, kind: str, **detail: Any) -> None:
        self._notify(Event(self.times[self._scan], self.name, kind, detail))


def _innovation(expected: UncertainPose, measured: UncertainPose) -> dict[str, Any]:
    """``offset`` x, y, theta of a measurement from what was expected, and its ``innovation``: the squared Mahalanobis
    distance over its 3 degrees of freedom, near 1 on average if both are honest and independent."""
    offset = gtsam.Pose2.Logmap(expected.pose.between(measured.pose))
    distance = offset @ np.linalg.solve(expected.covariance + measured.covariance, offset)
    return {"offset": [round(float(v), 4) for v in offset], "innovation": round(float(distance) / 3.0, 3)}
