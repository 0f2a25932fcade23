"""Coming back to a place (M6 and M3): which known vertex the robot may be in, and whether it really is.

A projected pose is a guess. The robot enters the old vertex on trial: its particles only localise in the old map, which
stays as it is, until a stretch of driving has shown that the map explains what the laser sees and that the particles
agree. Only then does the vertex count as re-entered; else the trial is undone.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import gtsam
import numpy as np

from factors import UncertainPose, VertexId, compose
from frontend import se2
from frontend.rbpf import Step
from frontend.records import FloatArray
from mrtm.config import TopologyParameters
from mrtm.robot.topology import Vertex


@dataclass(frozen=True, slots=True)
class Candidate:
    """A known vertex in which the robot may be: its pose there, ``local_T_robot``, covariance in the robot's frame."""

    vertex: Vertex
    estimate: UncertainPose


def candidates(
    robot: UncertainPose, vertices: list[Vertex], seen_from_here: Callable[[VertexId], UncertainPose],
    half_width: float, reach: float,
) -> list[Candidate]:  # fmt: skip
    """M6: project the robot's pose into every vertex; those where it lies inside the travel square, best first.

    Best is the least determinant of the projected covariance (M6b). An uncertain pose counts as inside if it is so
    within ``reach`` standard deviations, at most half the square's half width.

    Args:
        robot: pose in the vertex it leaves.
        seen_from_here: projection to another vertex: here_T_vertex.
        half_width: of the travel square, metres.
    """
    found = []
    for vertex in vertices:
        here_T_vertex = seen_from_here(vertex.id)
        vertex_T_robot = compose(_inverse(here_T_vertex), robot)
        pose = vertex_T_robot.pose
        deviation = np.sqrt(np.linalg.eigvalsh(vertex_T_robot.covariance[:2, :2])[1])
        if max(abs(pose.x()), abs(pose.y())) <= half_width + min(reach * deviation, 0.5 * half_width):
            found.append(Candidate(vertex, vertex_T_robot))
    return sorted(found, key=lambda c: float(np.linalg.det(c.estimate.covariance)))


def _inverse(a_T_b: UncertainPose) -> UncertainPose:
    adjoint = a_T_b.pose.AdjointMap()
    return UncertainPose(a_T_b.pose.inverse(), adjoint @ a_T_b.covariance @ adjoint.T)


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
        distance: metres driven so far.
        next_check: distance at which the next attempt to confirm it is due.
    """

    candidate: Candidate
    left: UncertainPose
    first_scan: int
    resume: bool
    fits: list[float] = field(default_factory=list)
    knowns: list[float] = field(default_factory=list)
    distance: float = 0.0
    next_check: float = 0.0

    def restart(self) -> None:
        """Forget the scans so far, which are to be taken again from another start."""
        self.fits.clear()
        self.knowns.clear()
        self.distance = 0.0

    def limit(self, p: TopologyParameters) -> float:
        """Metres after which there must be a verdict."""
        return 3.0 * p.trial_distance

    def add(self, step: Step, increment: FloatArray) -> None:
        """Take note of one more scan."""
        self.fits.append(step.fit)
        self.knowns.append(step.known)
        self.distance += float(np.hypot(increment[0], increment[1])) + 0.3 * abs(float(increment[2]))

    def verdict(self, covariance: FloatArray, p: TopologyParameters, leaving: bool) -> tuple[bool | None, str]:
        """Accept (True), refuse (False) or wait (None), and the reason in words.

        Args:
            covariance: (3, 3) of the robot's pose in the old map.
            leaving: the robot is about to leave the vertex: decide now.
        """
        if len(self.fits) < p.trial_scans:
            return (False, "left before it was sure") if leaving else (None, "")
        # The worse of the whole stretch and its end: a robot that drifts off the old map fits well at first.
        fit, known = (float(min(np.mean(v), np.mean(v[-p.trial_scans :]))) for v in (self.fits, self.knowns))
        spread = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1]))
        numbers = f"fit {fit:.2f}, known {known:.2f}, spread {spread:.2f} m after {self.distance:.1f} m"
        good = fit >= p.trial_fit and known >= p.trial_known and spread <= p.trial_spread
        if good and self.distance >= p.trial_distance:
            return True, numbers
        if fit < p.trial_fit - 0.2:
            return False, f"does not fit the old map: {numbers}"
        if leaving or self.distance >= self.limit(p):
            reason = "ambiguous" if spread > p.trial_spread else "does not fit the old map"
            return False, f"{reason}: {numbers}"
        return None, numbers


def pose_of(xytheta: FloatArray) -> gtsam.Pose2:
    """The (3,) array as a pose."""
    return gtsam.Pose2(float(xytheta[0]), float(xytheta[1]), float(se2.wrap(xytheta[2])))


def array_of(pose: gtsam.Pose2) -> FloatArray:
    """The pose as a (3,) array."""
    return np.array([pose.x(), pose.y(), pose.theta()])
