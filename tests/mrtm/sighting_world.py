"""Made-up teams: robots whose own graphs drift, and sightings between them of which a share is false."""

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
import numpy.typing as npt

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId
from factors.sighting import Sighting
from mrtm.joint.graph import JointGraph
from mrtm.joint.sightings.hypotheses import Hypothesis

FloatArray = npt.NDArray[np.float64]

STEP = np.diag([0.06, 0.06, np.radians(0.7)]) ** 2
ANCHOR = np.diag([0.02, 0.02, np.radians(0.3)]) ** 2
SIGMA = (0.05, 0.02, 0.05)


@dataclass
class TeamWorld:
    """``robots`` robots walk about a floor of ``size`` metres, each with ``vertices`` vertices about 7 m apart.

    Attributes:
        truth: the true pose of every vertex on the floor.
        graphs: what each robot knows, in a frame of its own: odometry edges with honest noise.
        hypotheses: the sightings made so far.
        true: the ids of those that are true.
    """

    seed: int
    robots: int
    vertices: int = 6
    size: float = 25.0
    headings: bool = True
    hypotheses: list[Hypothesis] = field(default_factory=list)
    true: set[tuple[str, int]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.names = [f"r{k}" for k in range(self.robots)]
        self.truth: dict[VertexId, gtsam.Pose2] = {}
        self.graphs: dict[str, JointGraph] = {}
        for name in self.names:
            self._drive(name)

    def _drive(self, name: str) -> None:
        pose = gtsam.Pose2(*self.rng.uniform([0, 0, -np.pi], [self.size, self.size, np.pi]))
        graph = JointGraph(VertexId(name, 0))
        self.truth[VertexId(name, 0)] = pose
        for k in range(1, self.vertices):
            while True:
                to = pose.compose(gtsam.Pose2(0.0, 0.0, self.rng.uniform(-2.0, 2.0))).compose(
                    gtsam.Pose2(7.0, 0.0, 0.0)
                )
                if 0 < to.x() < self.size and 0 < to.y() < self.size:
                    break
                pose = pose.compose(gtsam.Pose2(0.0, 0.0, 0.5))
            tail, head = VertexId(name, k - 1), VertexId(name, k)
            measured = self._noisy(self.truth[tail].between(to), STEP)
            graph.update(add=[Edge(EdgeId(name, k), 0, EdgeKind.INTER_VERTEX, tail, head, measured, STEP)])
            self.truth[head] = pose = to
        self.graphs[name] = graph

    def offset(self, a: str, b: str) -> gtsam.Pose2:
        """The true a_T_b between the frames of two robots' roots."""
        return self.truth[VertexId(a, 0)].between(self.truth[VertexId(b, 0)])

    def sight(self, a: str, b: str, count: int, false: float = 0.0, at: int | None = None) -> None:
        """Add ``count`` sightings between two robots, in either direction, of which each is ``false`` with that
        probability: a random place within 10 m. ``at`` holds the one that is ``a`` to one vertex."""
        for _ in range(count):
            self._sight(a, b, self.rng.random() < false, at)

    def cluster(self, a: str, b: str, count: int) -> None:
        """Add false sightings that agree with each other, somewhere off."""
        shift = gtsam.Pose2(*self.rng.uniform([3.0, 3.0, 0.5], [8.0, 8.0, 2.0]))
        for _ in range(count):
            self._sight(a, b, True, None, shift)

    def _sight(self, a: str, b: str, false: bool, at: int | None, shift: gtsam.Pose2 | None = None) -> None:
        swap = self.rng.random() < 0.5
        while True:
            u = VertexId(a, int(self.rng.integers(self.vertices)) if at is None else at)
            pose_a = self.truth[u].compose(gtsam.Pose2(*self.rng.uniform([-3, -3, -np.pi], [3, 3, np.pi])))
            pose_b = pose_a.compose(gtsam.Pose2(*self.rng.uniform([-8, -8, -np.pi], [8, 8, np.pi])))
            v = min((v for v in self.truth if v.robot == b), key=lambda v: _apart(self.truth[v], pose_b))
            if _apart(self.truth[v], pose_b) < 6.0 and _apart(pose_a, pose_b) > 0.5:
                break
        anchor_a, anchor_b = self._anchor(self.truth[u].between(pose_a)), self._anchor(self.truth[v].between(pose_b))
        if shift is not None:  # as if b's whole map lay elsewhere: all such sightings agree
            origin = self.truth[VertexId(b, 0)]
            pose_b = origin.compose(shift).compose(origin.between(pose_b))
        elif false:
            pose_b = pose_a.compose(gtsam.Pose2(*self.rng.uniform([-7, -7, -np.pi], [7, 7, np.pi])))
        if swap:
            u, v, pose_a, pose_b, anchor_a, anchor_b = v, u, pose_b, pose_a, anchor_b, anchor_a
        relative = pose_a.between(pose_b)
        noise = self.rng.normal(0.0, SIGMA)
        sighting = Sighting(
            max(float(np.hypot(relative.x(), relative.y()) + noise[0]), 0.1),
            float(np.arctan2(relative.y(), relative.x()) + noise[1]),
            relative.theta() + float(noise[2]) if self.headings else None,
            SIGMA[0],
            SIGMA[1],
            SIGMA[2] if self.headings else None,
        )
        key = (u.robot, len(self.hypotheses))
        self.hypotheses.append(Hypothesis(key, u, v, sighting, anchor_a, anchor_b))
        if not false:
            self.true.add(key)

    def _anchor(self, pose: gtsam.Pose2) -> UncertainPose:
        return UncertainPose(self._noisy(pose, ANCHOR), ANCHOR)

    def _noisy(self, pose: gtsam.Pose2, covariance: FloatArray) -> gtsam.Pose2:
        return pose.compose(gtsam.Pose2.Expmap(self.rng.multivariate_normal(np.zeros(3), covariance)))


def without_heading(hypothesis: Hypothesis) -> Hypothesis:
    """The same sighting by a sensor that does not tell headings."""
    return replace(hypothesis, sighting=replace(hypothesis.sighting, heading=None, sigma_heading=None))


def _apart(a: gtsam.Pose2, b: gtsam.Pose2) -> float:
    return float(np.hypot(a.x() - b.x(), a.y() - b.y()))
