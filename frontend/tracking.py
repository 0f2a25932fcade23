"""Following one robot pose through a map from scan to scan, and finding out when odometry lies.

Public logs have stretches of reverse driving recorded as forward, or the other way round, and jumps.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from frontend import motion, se2
from frontend.grid import Layers
from frontend.matching import match, search
from frontend.moving import Movers
from frontend.parameters import FilterParameters
from frontend.points import Points
from frontend.records import FloatArray

MIN_POINTS = 10  # fewer endpoints than this say nothing
GOOD_FIT = 0.75  # a match that explains less than this of the known space, or
GOOD_KNOWN = 0.25  # that has less than this in known space, is searched around
CLOSE = 1.5  # metres within which a body can hide so much that all else fits badly
LOST_FIT = 0.45  # below this also far around
TURN = 0.08  # radians between the headings from which to match where odometry has the robot
MARGIN = 0.05  # by how much a searched match must beat the plain one
OPPOSITE = np.array([-1.0, -1.0, 1.0])
HOLD = 0.7  # metres driven under the opposite sign without a scan that speaks for it, after which it is given up
NO_GRIP, FULL_GRIP = 0.01, 0.06  # share of a scan's information that lies along the way driven
STILL = 0.005  # metres: a robot that moves less between two scans has no direction
EVIDENCE = 0.2  # of a scan's log-likelihood, in telling forward from backward
REVERSED = 16.0  # log-likelihood at which odometry is taken to have the wrong sign,
REVERSED_SCANS = 4  # and the least number of scans that must say so
DISBELIEF = 0.08  # what it costs, in fit, to contradict odometry e times more


@dataclass(slots=True)
class Step:
    """Where the best particle is at one scan, and how sure of it.

    Attributes:
        pose: (3,) local_T_robot.
        fit: fraction of the endpoints in known space that the map explains, 0 to 1.
        known: fraction of all endpoints that lie in known space.
        log_likelihood: of the scan, relative to that of a perfect fit.
        hessian: (3, 3) information of the scan on the pose, map coordinates.
        points: what of the scan stands still; ``pose`` and ``hessian`` are of that alone, and no more is for the map.
        searched: 0 if the plain match was good; 1 or 2 for a search around or far around the expected pose.
        reversed: odometry was found to have changed its sign,
        forward: and whether it has the right one now.
        retraced: (k, 3) where the robot then was at the k scans before: already there it had the new sign.
    """

    pose: FloatArray
    fit: float
    known: float
    log_likelihood: float
    hessian: FloatArray
    points: Points
    searched: int = 0
    reversed: bool = False
    forward: bool = True
    retraced: FloatArray = field(default_factory=lambda: np.empty((0, 3)))


class Tracker:
    """Tracks one particle between the steps of the filter.

    Attributes:
        pose: (3,) local_T_robot at the last scan.
        motion: (3,) what odometry says of the way since the tracker was last told where it is,
        variances: (3,) and of that the variances.
        forward: odometry has the right sign, as far as is known.
        doubt: log-likelihood by which the opposite sign explains the last scans better.
        movers: what has moved since the scans before.
    """

    def __init__(self, parameters: FilterParameters) -> None:
        self._parameters = parameters
        self.forward = True
        self._unsure = 0.0  # metres driven under the opposite sign since a scan last spoke for it
        self.movers = Movers()
        self.rest(np.zeros(3))

    def rest(self, pose: FloatArray) -> None:
        """The robot is at ``pose`` (3,), as far as the filter knows."""
        self.pose = pose
        self.motion, self.variances, self.doubt = np.zeros(3), np.zeros(3), 0.0
        self._start_mirror()

    def _start_mirror(self) -> None:
        """Let the second track go on from where the first is."""
        self._mirrored, self._mirror_motion = [self.pose], self.motion

    @property
    def undecided(self) -> bool:
        """Whether it is open which way the robot drives, and a few more scans will tell: drawing waits for them."""
        return self.doubt >= REVERSED / REVERSED_SCANS and len(self._mirrored) <= 2 * REVERSED_SCANS

    def track(self, layers: Layers, points: Points, increment: FloatArray) -> Step:
        """Follow the robot over one odometry ``increment`` (3,) by matching ``points`` to its map.

        A second track runs along under the opposite sign of the odometry; where it has explained the scans better for
        a while, it becomes the first.
        """
        increment = increment * (1.0 if self.forward else OPPOSITE)
        added = motion.variance(increment, self._parameters.motion)
        self.variances += added
        step, merit = self._follow(layers, points, self.pose, increment, added)
        self.motion = se2.compose(self.motion, increment)
        turned_over = False
        if abs(increment[0]) + abs(increment[1]) < STILL:
            self._mirrored.append(se2.compose(self._mirrored[-1], increment))
            self._mirror_motion = se2.compose(self._mirror_motion, increment)
        else:
            mirrored, mirrored_merit = self._follow(layers, points, self._mirrored[-1], increment * OPPOSITE, added)
            self._mirrored.append(mirrored.pose)
            self._mirror_motion = se2.compose(self._mirror_motion, increment * OPPOSITE)
            # One scan proves little: its time may be off by a good part of the way driven. Nor does a bare corridor, or
            # what of a scan lies in known space where that ends. The wrong one may have little to hold on to.
            comparable = min(step.known, mirrored.known)
            grip = max(_grip(step, increment), _grip(mirrored, increment))
            evidence = comparable * grip * (mirrored_merit - merit)
            self.doubt = max(0.0, self.doubt + min(evidence, REVERSED / REVERSED_SCANS))
            # A wrong sign is the exception: it is held only as long as the scans go on saying so.
            held = not self.forward and evidence > -1.0
            self._unsure = self._unsure + float(np.hypot(increment[0], increment[1])) if held else 0.0
            turned_over = self.doubt >= REVERSED or self._unsure > HOLD
            if turned_over:
                self._unsure = 0.0
                self.forward = not self.forward
                self.motion, self.doubt = self._mirror_motion, 0.0
                step = mirrored
                step.retraced = np.array(self._mirrored[1:-1]).reshape(-1, 3)
        if len(points.hits) >= MIN_POINTS and not _good(step):
            step = self._search(layers, points, se2.compose(self.pose, increment), increment, step)
        followed = not step.searched and not turned_over
        if followed:
            # Where the whole scan fits badly, a body close by may be why. If it still does without it, it is the path
            # that is wrong, and the walls seem to move.
            good = _good(step)
            standing = self.movers.standing(points, se2.between(self.pose, step.pose), math.inf if good else CLOSE)
            if standing is not points:
                prior, information = se2.compose(self.pose, increment), np.diag(1.0 / added)
                again = self._match(layers, standing, step.pose.copy(), prior, information)
                followed = good or _good(again)
                if followed:  # the fit stays that of the whole scan
                    step.pose, step.hessian, step.points = again.pose, again.hessian, standing
        if not followed:
            self.movers.start(points)
        step.reversed, step.forward = turned_over, self.forward
        self.pose = step.pose
        if self.doubt == 0.0:
            self._start_mirror()
        return step

    def _follow(
        self, layers: Layers, points: Points, pose: FloatArray, increment: FloatArray, variances: FloatArray
    ) -> tuple[Step, float]:
        """The match after one increment, and its log-likelihood together with that of the increment it implies."""
        prior = se2.compose(pose, increment)
        step = self._match(layers, points, prior.copy(), prior, np.diag(1.0 / variances))
        off = se2.between(prior, step.pose)
        surprise = 4.5 * math.log1p(float(off @ (off / variances)) / 9.0)
        # As if all of the scan were in known space: driving back into it must not look better for that alone.
        return step, EVIDENCE * step.log_likelihood / max(step.known, 0.1) - surprise

    def _match(
        self, layers: Layers, points: Points, start: FloatArray, prior: FloatArray, information: FloatArray
    ) -> Step:
        hessian = np.empty((3, 3))
        fit, near, free, log_likelihood = match(
            *layers, points.hits, start, prior, information, self._parameters.sigma, hessian
        )
        known = near + free
        start[2] = se2.wrap(start[2])
        return Step(start, fit / max(1, known), known / max(1, len(points.hits)), log_likelihood, hessian, points)

    def _search(self, layers: Layers, points: Points, prior: FloatArray, increment: FloatArray, best: Step) -> Step:
        """The match is poor: odometry may be wrong. Look around, and if that does not help, far around.

        A match far from what odometry says must explain so much more of the scan.
        """
        stride = max(1, len(points.hits) // 90)
        moved = float(np.hypot(increment[0], increment[1]))
        turned = abs(float(increment[2]))
        noise = motion.variance(increment, self._parameters.motion)

        def merit(step: Step) -> float:
            off = se2.between(prior, step.pose)
            surprise = math.log1p(float(off @ (off / noise)) / 9.0)
            return step.fit * step.known - DISBELIEF * surprise

        for level, (reach_xy, reach_theta) in enumerate(
            ((0.3 + 0.5 * moved, 0.2 + 0.3 * turned), (1.0 + 2.0 * moved, 0.6 + 0.5 * turned)), start=1
        ):
            reach_xy, reach_theta = min(reach_xy, 3.0), min(reach_theta, math.pi)
            information = np.diag(9.0 / np.array([reach_xy, reach_xy, reach_theta]) ** 2)
            peaks = np.empty((12, 3))
            found = search(
                *layers, points.hits, prior, reach_xy, 0.15, reach_theta, 0.04, information, stride,
                peaks, np.empty(12),
            )  # fmt: skip
            # The lattice is coarse beside the width of a surface, and a few centimetres aside it may miss the best. A
            # turn that odometry missed is the commonest error, and there matches from turned headings are dense enough.
            turns = np.arange(TURN, reach_theta, TURN)
            turned_aside = prior + np.outer(np.concatenate((turns, -turns)), [0.0, 0.0, 1.0])
            for start in np.vstack((turned_aside, peaks[:found])):
                step = self._match(layers, points, start, prior, information * 0.1)
                step.searched = level
                if merit(step) > merit(best) + MARGIN:
                    best = step
            if best.fit >= LOST_FIT:
                break
        return best


def _good(step: Step) -> bool:
    return step.fit >= GOOD_FIT and step.known >= GOOD_KNOWN


def _grip(step: Step, increment: FloatArray) -> float:
    """How well a scan tells the place along the way driven, 0 (a bare corridor) to 1."""
    heading = float(step.pose[2]) + math.atan2(increment[1], increment[0])
    along = np.array([math.cos(heading), math.sin(heading)])
    information = step.hessian[:2, :2]
    share = float(along @ information @ along) / max(float(np.trace(information)), 1e-9)
    return min(1.0, max(0.0, (share - NO_GRIP) / (FULL_GRIP - NO_GRIP)))
