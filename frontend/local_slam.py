"""One visit to a vertex: the particle filter run over its scans, and what it leaves when the robot goes (M3)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from frontend import motion, se2
from frontend.grid import Maps
from frontend.parameters import FilterParameters
from frontend.points import Points, merge
from frontend.rbpf import ParticleFilter
from frontend.records import FloatArray
from frontend.refine import localise, refine
from frontend.tracking import OPPOSITE, Step

SOFTNESS = 0.06  # difference of two scores that makes one hypothesis e times likelier than the other
SPREAD = np.diag([0.03**2, 0.03**2, 0.01**2])  # covariance of the particles around their hypothesis


@dataclass(frozen=True, slots=True)
class Visit:
    """What a visit leaves behind.

    Attributes:
        poses: (n, 3) local_T_robot at each of its scans.
        chosen: (m,) indices of those poses whose covariance is known; the first and the last are.
        covariances: (m, 3, 3) of each, in its own tangent frame: in the map as the visit found it or, if it found
            none, from the first pose on.
        sigma: metres; how far endpoints scattered about the map, as if independent.
        spread: (3, 3) covariance of the particles at the end.
        maps: the vertex's map, a stack of one.
        since_resampling: key scans since the filter last resampled, of all of the visit's if it did not.
    """

    poses: FloatArray
    chosen: npt.NDArray[np.int64]
    covariances: FloatArray
    sigma: float
    spread: FloatArray
    maps: Maps
    since_resampling: int


class LocalSlam:
    """Runs the filter in one vertex after another."""

    def __init__(self, parameters: FilterParameters, seed: int) -> None:
        self.parameters = parameters
        self.filter = ParticleFilter(parameters, seed)
        self._points: list[Points] = []
        self._increments: list[FloatArray] = []
        self._forward: list[bool] = []  # whether these have the right sign
        self._offsets: list[FloatArray] = []  # pose seen from that at the key scan before
        self._keys: list[int] = []  # which step of the filter that was
        self._steps = 0
        self._resampled = 0  # step of the last resampling
        self._base: Maps | None = None
        self._mapping = True
        self._entrance = np.zeros(3)
        self._localised = np.empty((0, 3))  # poses of the first scans as ``entrance`` found them
        self._random = np.random.default_rng(seed)

    def begin(
        self, points: Points, poses: FloatArray, known: Maps | None = None, *, mapping: bool = True, again: bool = False
    ) -> None:
        """Start a visit with its first scan at ``poses`` (particles, 3).

        Args:
            known: what is known of the place already, a stack of one.
            mapping: without it the particles only localise in the known map until ``settle``.
            again: the robot has never left; the visit before goes on in this one.
        """
        self._base, self._mapping = known, mapping
        if not again:
            self._entrance = poses[0].copy()
        self.filter.start(poses, known, points)
        self._points, self._increments, self._forward = [points], [np.zeros(3)], [self.filter.tracker.forward]
        self._offsets, self._keys, self._steps, self._resampled = [np.zeros(3)], [0], 0, 0
        self._localised = np.empty((0, 3))
        if self._mapping:
            self.filter.insert(points, poses)

    def particles(self, pose: FloatArray, covariance: FloatArray) -> FloatArray:
        """(particles, 3) around ``pose`` (3,), ``covariance`` (3, 3) in its tangent frame; ``pose`` is the first."""
        draws = self._random.multivariate_normal(np.zeros(3), covariance, self.parameters.particles)
        draws[0] = 0.0
        return se2.compose(pose, draws)

    def spread(self, poses: FloatArray, scores: FloatArray) -> FloatArray:
        """(particles, 3) around the hypotheses, more around the better ones (M3: "generate a set of particles")."""
        weights = np.exp((scores - scores.max()) / SOFTNESS)
        chosen = self._random.choice(len(poses), self.parameters.particles, p=weights / weights.sum())
        chosen[0] = 0
        return se2.compose(poses[chosen], self.particles(np.zeros(3), SPREAD))

    def add(self, points: Points, increment: FloatArray) -> Step:
        """Take the next scan, ``increment`` (3,) of odometry after the last one."""
        p = self.parameters
        step = self.filter.track(points, increment)
        points = step.points
        at_key = self.filter.poses[self.filter.leader]
        for back, pose in enumerate(step.retraced[::-1], 1):
            self._offsets[-back], self._forward[-back] = se2.between(at_key, pose), step.forward
        offset = se2.between(at_key, step.pose)
        moved = np.hypot(offset[0], offset[1]) >= p.key_distance or abs(offset[2]) >= p.key_angle
        if moved and not self.filter.tracker.undecided:
            self._update(points)
            offset = np.zeros(3)
        self._points.append(points)
        self._increments.append(increment)
        self._forward.append(step.forward)
        self._offsets.append(offset)
        self._keys.append(self._steps)
        return step

    def settle(self) -> None:
        """The localisation in the known map holds: from now on, and in hindsight, the scans are mapped as well."""
        self._mapping = True
        paths = self.filter.paths()
        at = {step: i for i, step in reversed(list(enumerate(self._keys)))}
        for step in range(self._steps + 1):
            self.filter.insert(self._points[at[step]], paths[step])

    def finish(self) -> Visit:
        """End the visit: the best particle's path, made better by the whole map it led to."""
        if np.any(self._offsets[-1]):
            self._update(self._points[-1])
            self._offsets[-1] = np.zeros(3)
            self._keys[-1] = self._steps
        increments, variances = self._odometry()
        path = self.path()
        path[: len(self._localised)] = self._localised
        a, maps = refine(self._points, path, increments, variances, self._base, self.parameters)
        _, spread = self.filter.pose_and_covariance()
        since = self._steps - self._resampled
        return Visit(a.poses, a.chosen, a.covariances, a.sigma, spread, maps, since)

    def entrance(self) -> tuple[FloatArray, FloatArray]:
        """Pose (3,) of the visit's first scan in the known map, as all scans so far tell it, and its covariance (3, 3)
        there, in its tangent frame."""
        assert self._base is not None
        increments, variances = self._odometry()
        a = localise(self._points, self.path(), increments, variances, self._base, self.parameters)
        self._localised = a.poses
        return a.poses[0], a.covariances[0]

    def _odometry(self) -> tuple[FloatArray, FloatArray]:
        """(n, 3) increments, as far as is known with the right sign, and their variances."""
        increments = np.array(self._increments)
        increments[~np.array(self._forward)] *= OPPOSITE
        return increments, np.array([motion.variance(i, self.parameters.motion) for i in increments])

    def covariance(self) -> FloatArray:
        """(3, 3) of the robot's pose in the vertex so far, in the robot's tangent frame.

        What the particles know, and what they cannot know: the slow bending of the map they all share, which grows with
        the distance from where the visit began.
        """
        mean, covariance = self.filter.pose_and_covariance()
        distance = float(np.hypot(*(mean - self._entrance)[:2]))
        xy, theta = self.parameters.drift_xy**2 * distance, self.parameters.drift_theta**2 * distance
        return covariance + np.diag([xy, xy, theta])

    def path(self) -> FloatArray:
        """(n, 3) local_T_robot of the best particle at each scan of the visit so far."""
        best = self.filter.paths()[:, self.filter.leader]
        return se2.compose(best[self._keys], np.array(self._offsets))

    def submap(self, count: int) -> Points:
        """What ``count`` scans, evenly taken from the visit so far, saw together, in the frame of the present pose."""
        path = self.path()
        chosen = np.unique(np.linspace(0, len(path) - 1, count).astype(int))
        return merge([self._points[i] for i in chosen], se2.between(path[-1], path[chosen]))

    @property
    def length(self) -> int:
        """Scans of the visit so far."""
        return len(self._points)

    def take_back(self) -> list[tuple[Points, FloatArray]]:
        """The visit's scans with the odometry increments that led to them, as recorded, to take them anew.

        What the visit has found out about the sign of odometry is forgotten with it.
        """
        self.filter.tracker.forward = self._forward[0]
        return list(zip(self._points, self._increments, strict=True))

    def _update(self, points: Points) -> None:
        resampled = self.filter.resampled
        self.filter.update(points, self._mapping)
        self._steps += 1
        if self.filter.resampled > resampled:
            self._resampled = self._steps
