"""The Rao-Blackwellised particle filter of step M3: each particle a path and its own local map.

The proposal is improved by scan matching (Grisetti, Stachniss, Burgard, IEEE T-RO 23(1), 2007): every particle is moved
to the best match between what odometry says and what its map says, and drawn from the Gaussian there. Particles work
on *key scans*, a fraction of a metre apart; between them the best particle alone is tracked.

Random numbers are hashed from (seed, step, particle), so the result does not depend on the number of threads.
"""

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from frontend import se2
from frontend.grid import Maps, insert
from frontend.matching import match
from frontend.parameters import FilterParameters
from frontend.points import Points
from frontend.records import FloatArray
from frontend.tracking import Step, Tracker


@njit(cache=True, nogil=True)
def _mix(state, value):  # type: ignore[no-untyped-def]
    z = (state ^ np.uint64(value)) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True, nogil=True)
def _uniform(seed, step, particle, draw):  # type: ignore[no-untyped-def]
    """A uniform number in (0, 1) hashed from its arguments (splitmix64)."""
    z = _mix(_mix(_mix(_mix(np.uint64(0), seed), step), particle), draw)
    return ((z >> np.uint64(11)) + 0.5) / 9007199254740992.0


@njit(cache=True, nogil=True)
def _draw(mean, covariance, seed, step, particle):  # type: ignore[no-untyped-def]
    """Move ``mean`` (3,) in place by a draw of the Gaussian with ``covariance`` (3, 3)."""
    l00 = math.sqrt(max(covariance[0, 0], 1e-18))
    l10 = covariance[1, 0] / l00
    l20 = covariance[2, 0] / l00
    l11 = math.sqrt(max(covariance[1, 1] - l10 * l10, 1e-18))
    l21 = (covariance[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(max(covariance[2, 2] - l20 * l20 - l21 * l21, 1e-18))
    r = math.sqrt(-2.0 * math.log(_uniform(seed, step, particle, 0)))
    a = 2.0 * math.pi * _uniform(seed, step, particle, 1)
    g0 = r * math.cos(a)
    g1 = r * math.sin(a)
    r = math.sqrt(-2.0 * math.log(_uniform(seed, step, particle, 2)))
    g2 = r * math.cos(2.0 * math.pi * _uniform(seed, step, particle, 3))
    mean[0] += l00 * g0
    mean[1] += l10 * g0 + l11 * g1
    mean[2] += l20 * g0 + l21 * g1 + l22 * g2


@njit(cache=True, nogil=True, parallel=True)
def _propose(log_odds, index, surfels, resolution, hits, priors, variances, independence, sigma, seed, step, poses, log_weights, covariances):  # type: ignore[no-untyped-def]  # noqa: E501  # fmt: skip
    """Match, draw and weigh every particle; ``poses`` holds the starts and receives the draws."""
    for p in prange(len(poses)):
        theta = priors[p, 2]
        c = math.cos(theta)
        s = math.sin(theta)
        information = np.zeros((3, 3))
        information[0, 0] = c * c / variances[0] + s * s / variances[1]
        information[1, 1] = s * s / variances[0] + c * c / variances[1]
        information[0, 1] = information[1, 0] = c * s * (1.0 / variances[0] - 1.0 / variances[1])
        information[2, 2] = 1.0 / variances[2]
        hessian = np.empty((3, 3))
        _, _, _, log_likelihood = match(
            log_odds[p], index[p], surfels[p], resolution, hits, poses[p], priors[p], information, sigma, hessian
        )
        e = poses[p] - priors[p]
        q = 0.0
        for i in range(3):
            for j in range(3):
                q += e[i] * information[i, j] * e[j]
        posterior = hessian + information
        covariance = np.linalg.inv(posterior)
        # Endpoints of one scan share the errors of the map: in weights they count as fewer independent ones.
        log_weights[p] += (
            independence * log_likelihood
            - 4.5 * math.log(1.0 + q / 9.0)
            - 0.5 * math.log(np.linalg.det(posterior) / np.linalg.det(information))
        )
        _draw(poses[p], covariance, seed, step, p)
        covariances[p] = covariance


@njit(cache=True, nogil=True, parallel=True)
def _insert_all(log_odds, index, surfels, counts, touched, resolution, poses, hits, clear, sensor):  # type: ignore[no-untyped-def]
    for p in prange(len(poses)):
        counts[p] = insert(
            log_odds[p], index[p], surfels[p], counts[p], touched[p], resolution, poses[p], hits, clear, sensor
        )


class ParticleFilter:
    """Builds one local map after another; ``start`` begins the next one."""

    def __init__(self, parameters: FilterParameters, seed: int) -> None:
        p = parameters
        self.parameters = p
        self.maps = Maps.empty(p.particles, p.map_width, p.resolution)
        self.poses = np.zeros((p.particles, 3))
        self._seed = seed
        self._steps = 0
        self._log_weights = np.zeros(p.particles)
        self._covariances = np.zeros((p.particles, 3, 3))
        self._history: list[tuple[FloatArray, npt.NDArray[np.int64]]] = []
        self.resampled = 0
        self.leader = 0
        self.tracker = Tracker(parameters)

    def start(self, poses: FloatArray, known: Maps | None = None, scan: Points | None = None) -> None:
        """Begin a local map: M1 and M7a with ``poses`` all zero and nothing known; M3's re-entry with the poses drawn
        from the projected covariance and the map that the vertex has already (a stack of one).

        Args:
            poses: (particles, 3) local_T_robot.
            known: what all particles know already.
            scan: taken there; where it was tracked last, the scans before still tell what moves.
        """
        count = self.parameters.particles
        if known is None:
            self.maps.clear()
        else:
            self.maps.copy_from(known, np.zeros(count, np.int64))
        self.poses = poses.copy()
        self._log_weights[:] = 0.0
        self._covariances[:] = 0.0
        self._history = [(self.poses.copy(), np.arange(count))]
        self.leader = 0
        self.tracker.rest(self.poses[0].copy())
        if scan is not None:
            self.tracker.movers.start(scan)

    @property
    def weights(self) -> FloatArray:
        """(particles,) normalised weights."""
        w = np.exp(self._log_weights - self._log_weights.max())
        return np.asarray(w / w.sum())

    def track(self, points: Points, increment: FloatArray) -> Step:
        """Follow the best particle over one odometry ``increment`` (3,) by matching ``points`` to its map."""
        return self.tracker.track(self.maps.layers(self.leader), points, increment)

    def update(self, points: Points, mapping: bool) -> None:
        """One filter step on a key scan: propose, weigh, resample, map. ``track`` has been called for it before.

        Without ``mapping`` the maps stay as they are: the particles only localise.
        """
        p = self.parameters
        self._steps += 1
        priors = se2.compose(self.poses, self.tracker.motion)
        moved = se2.between(self.poses[self.leader], self.tracker.pose)
        self.poses = se2.compose(self.poses, moved)
        if np.any(self.tracker.variances > 0.0):
            _propose(
                self.maps.log_odds, self.maps.index, self.maps.surfels, self.maps.resolution, points.hits, priors,
                self.tracker.variances, p.independence, p.sigma, self._seed, self._steps, self.poses,
                self._log_weights, self._covariances,
            )  # fmt: skip
            self.poses[:, 2] = se2.wrap(self.poses[:, 2])
        # The heaviest particle survives resampling, in its place.
        self.leader = int(np.argmax(self._log_weights))
        parents = self._resample()
        self._history.append((self.poses.copy(), parents))
        if mapping:
            self.insert(points, self.poses)
        self.tracker.rest(self.poses[self.leader].copy())

    def insert(self, points: Points, poses: FloatArray) -> None:
        """Add a scan to every particle's map, at ``poses`` (particles, 3)."""
        m = self.maps
        _insert_all(
            m.log_odds, m.index, m.surfels, m.counts, m.touched, m.resolution,
            poses, points.hits, points.clear, points.sensor,
        )  # fmt: skip

    def _resample(self) -> npt.NDArray[np.int64]:
        """Systematic resampling when the effective number of particles falls below half (Grisetti 2007, eq. 18-19).

        Surviving particles keep their place, so that their maps need not be copied.
        """
        count = self.parameters.particles
        weights = self.weights
        parents = np.arange(count)
        if 1.0 / float(weights @ weights) >= 0.5 * count:
            return parents
        self.resampled += 1
        u = (_uniform(self._seed, self._steps, count, 0) + np.arange(count)) / count
        drawn = np.minimum(np.searchsorted(np.cumsum(weights), u), count - 1)
        copies = np.bincount(drawn, minlength=count)
        parents[copies == 0] = np.repeat(np.arange(count), np.maximum(copies - 1, 0))
        self.maps.copy_from(self.maps, parents)
        self.poses = self.poses[parents]
        self._covariances = self._covariances[parents]
        self._log_weights[:] = 0.0
        return parents

    def paths(self) -> FloatArray:
        """(k, particles, 3) where each of today's particles was at the start and at each key scan since."""
        ancestor = np.arange(self.parameters.particles)
        paths = np.empty((len(self._history), len(ancestor), 3))
        for k in range(len(self._history) - 1, -1, -1):
            poses, parents = self._history[k]
            paths[k] = poses[ancestor]
            ancestor = parents[ancestor]
        return paths

    def pose_and_covariance(self) -> tuple[FloatArray, FloatArray]:
        """Mean pose (3,) and its covariance (3, 3) in the robot's tangent frame.

        The spread of the particles plus the mean width of their proposals: after resampling all particles may descend
        from one, and the spread alone would claim certainty.
        """
        mean, spread = se2.mean_and_covariance(self.poses, self.weights)
        width = np.tensordot(self.weights, self._covariances, axes=1)
        c, s = np.cos(mean[2]), np.sin(mean[2])
        rotation = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return mean, spread + rotation @ width @ rotation.T


def first_run() -> bool:
    """Whether the filter's kernels are still to be compiled on this machine."""
    cache = _propose.stats.cache_path
    return cache is None or not any(Path(cache).glob("rbpf._propose*.nbi"))
