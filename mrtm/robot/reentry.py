"""Coming back to a place (M6 and M3): which known vertex the robot may be in, and whether it really is.

A projected pose is a guess. The robot enters the old vertex on trial: its particles only localise in the old map, which
stays as it is, until a stretch of driving has shown that the map explains what the laser sees and that the particles
agree. Only then does the vertex count as re-entered; else the trial is undone.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from factors import UncertainPose, VertexId, compose, inverse
from frontend import se2
from frontend.grid import Maps
from frontend.local_slam import SPREAD, LocalSlam
from frontend.records import FloatArray
from frontend.relocalisation import hypotheses
from frontend.tracking import Step
from mrtm.config import TopologyParameters
from mrtm.robot.poses import array_of, exactly, innovation
from mrtm.robot.topology import Vertex

SUBMAP_SCANS = 12  # taken together to confirm a re-entry
APART = 0.25  # metres between two places that are not the same
SAME = 0.12  # metres within which two poses are of the same place
TRUST = 8.0  # growth of the gate with the lead of the best place
CHECK_DISTANCE = 0.5  # metres driven between two attempts to confirm
LIMIT = 3.0  # trial distances after which there must be a verdict
HOPELESS = 0.2  # a fit so far below what is asked for ends the trial at once
TURN_RADIUS = 0.3  # metres


@dataclass(frozen=True, slots=True)
class Candidate:
    """A known vertex in which the robot may be: its pose there, ``local_T_robot``, covariance in the robot's frame."""

    vertex: Vertex
    estimate: UncertainPose

    @property
    def maps(self) -> Maps:
        """What is known of the vertex, a stack of one."""
        maps = self.vertex.maps
        assert maps is not None  # only the vertex the robot is in for the first time has none
        return maps


def candidates(
    robot: UncertainPose, vertices: list[Vertex], seen: dict[VertexId, UncertainPose],
    half_width: float, reach: float,
) -> list[Candidate]:  # fmt: skip
    """M6: project the robot's pose into every vertex; those where it lies inside the travel square, best first.

    Best is the least determinant of the projected covariance (M6b). An uncertain pose counts as inside if it is so
    within ``reach`` standard deviations, at most half the square's half width.

    Args:
        robot: pose in the vertex it leaves.
        seen: here_T_vertex of every vertex.
        half_width: of the travel square, metres.
    """
    found = []
    for vertex in vertices:
        here_T_vertex = seen[vertex.id]
        vertex_T_robot = compose(inverse(here_T_vertex), robot)
        pose = vertex_T_robot.pose
        deviation = np.sqrt(np.linalg.eigvalsh(vertex_T_robot.covariance[:2, :2])[1])
        if max(abs(pose.x()), abs(pose.y())) <= half_width + min(reach * deviation, 0.5 * half_width):
            found.append(Candidate(vertex, vertex_T_robot))
    return sorted(found, key=lambda c: float(np.linalg.det(c.estimate.covariance)))


@dataclass(slots=True)
class Trial:
    """A re-entry under examination.

    Attributes:
        candidate: the vertex on trial.
        left: the robot's pose in the vertex it came from, at the scan where the trial begins.
        first_scan: index of that scan.
        resume: the robot had not yet left the vertex it came from; if the trial fails it goes on there.
        fits: for each scan, the fraction of the known space that the old map explains.
        knowns: for each scan, the fraction of the endpoints in known space.
        distance: metres driven so far; a turn counts as if driven on an arc of TURN_RADIUS.
        next_check: distance at which the next attempt to confirm it is due.
        reversed: odometry seemed to change its sign.
    """

    candidate: Candidate
    left: UncertainPose
    first_scan: int
    resume: bool
    fits: list[float] = field(default_factory=list)
    knowns: list[float] = field(default_factory=list)
    distance: float = 0.0
    next_check: float = 0.0
    reversed: bool = False

    def add(self, step: Step, increment: FloatArray) -> None:
        """Take note of one more scan."""
        self.fits.append(step.fit)
        self.knowns.append(step.known)
        self.reversed |= step.reversed
        self.distance += float(np.hypot(increment[0], increment[1])) + TURN_RADIUS * abs(float(increment[2]))

    def verdict(self, slam: LocalSlam, p: TopologyParameters, leaving: bool) -> tuple[bool | None, str]:
        """Accept (True), refuse (False) or wait (None), and the reason in words.

        Args:
            slam: localising in the old map. Where the stretch so far fits another place, it starts again from there.
            leaving: the robot is about to leave the vertex: decide now.
        """
        if self.reversed:
            # A wrong place is the likelier reason: from there on the old map would hold the robot to driving back.
            return False, "odometry would have to lie"
        if len(self.fits) < p.trial_scans:
            return (False, "left before it was sure") if leaving else (None, "")
        # The worse of the whole stretch and its end: a robot that drifts off the old map fits well at first.
        fit, known = (float(min(np.mean(v), np.mean(v[-p.trial_scans :]))) for v in (self.fits, self.knowns))
        covariance = slam.covariance()
        deviation = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1]))
        reason = f"fit {fit:.2f}, known {known:.2f}, spread {deviation:.2f} m after {self.distance:.1f} m"
        last = leaving or self.distance >= LIMIT * p.trial_distance
        if fit < p.trial_fit - HOPELESS:
            return False, f"does not fit the old map: {reason}"
        if self.distance < p.trial_distance or fit < p.trial_fit or known < p.trial_known or deviation > p.trial_spread:
            return (False, f"not sure enough: {reason}") if last else (None, reason)
        if self.distance < self.next_check and not last:
            return None, reason
        self.next_check = self.distance + CHECK_DISTANCE
        lead, off = self._confirm(slam, p)
        reason = f"{reason}, leads by {lead:.2f}, {off:.2f} m off"
        if lead < p.trial_lead or off > SAME:
            return (False, f"may be elsewhere: {reason}") if last else (None, reason)
        _, surprise = innovation(self.candidate.estimate, self.entered(slam))
        # The more a place stands out, the less the joint map, which may have slipped, has a say.
        if surprise > p.gate * (1.0 + TRUST * lead):
            return False, f"contradicts the joint map: chi2 {surprise:.0f}, {reason}"
        return True, reason

    def entered(self, slam: LocalSlam) -> UncertainPose:
        """The robot's pose in the old vertex at the scan where the trial began."""
        return self.candidate.vertex.uncertain(*slam.entrance())

    def _confirm(self, slam: LocalSlam, p: TopologyParameters) -> tuple[float, float]:
        """Search the whole of the projected covariance again, with all that the trial has seen so far as one scan.

        One scan may fit in many places where a stretch of them fits in one. Where it clearly fits elsewhere than where
        the particles are, the trial starts again from there.

        Returns:
            by how much the best place beats all others, in fraction of endpoints explained, and how far the particles
            are from it, metres.
        """
        path = slam.path()
        guess = compose(self.candidate.estimate, exactly(se2.between(path[0], path[-1])))
        known = self.candidate.maps
        poses, scores = hypotheses(
            known, slam.submap(SUBMAP_SCANS), array_of(guess.pose), guess.covariance, slam.parameters
        )
        if not len(poses):
            return 0.0, math.inf
        offsets = se2.between(poses[0], poses)
        elsewhere = scores[np.hypot(offsets[:, 0], offsets[:, 1]) > APART]
        lead = float(scores[0] - elsewhere[0]) if len(elsewhere) else 1.0
        off = float(np.hypot(*se2.between(path[-1], poses[0])[:2]))
        if lead >= p.trial_lead and off > SAME:
            self._restart(slam, se2.compose(poses[0], se2.between(path[-1], path[0])))
        return lead, off

    def _restart(self, slam: LocalSlam, start: FloatArray) -> None:
        """Take the scans so far again, the first of them at ``start``."""
        scans = slam.take_back()
        slam.begin(scans[0][0], slam.particles(start, SPREAD), self.candidate.maps, mapping=False)
        self.fits.clear()
        self.knowns.clear()
        self.distance = 0.0
        for points, increment in scans[1:]:
            self.add(slam.add(points, increment), increment)
