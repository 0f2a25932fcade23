"""What robots claim about a building: edges between their vertices, of which some are false."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors import Edge, EdgeId, EdgeKind, VertexId
from frontend.records import FloatArray

KINDS = (EdgeKind.LOOP, EdgeKind.FUSING, EdgeKind.ALIGNMENT)
"""Those that may be false."""

SIZE = 30.0  # metres, a side of the building
STEP, REACH = 7.0, 5.0  # metres from vertex to vertex, and between vertices that are the same place
PITCH = 6.0  # metres from a room to the next, which looks alike
APART, TURNED = 1.0, 0.3  # metres or radians from the truth, at least: nearer a false edge is a true one

_NOISE = {
    EdgeKind.INTER_VERTEX: np.diag([0.06, 0.06, np.radians(0.7)]) ** 2,
    EdgeKind.LOOP: np.diag([0.03, 0.03, np.radians(0.4)]) ** 2,
    EdgeKind.FUSING: np.diag([0.06, 0.1, 0.05]) ** 2,
    EdgeKind.ALIGNMENT: np.diag([0.02, 0.02, np.radians(0.2)]) ** 2,
}


@dataclass(frozen=True, slots=True, eq=False)
class Claim:
    """A measured tail_T_head that may be false.

    Attributes:
        step: when it comes: with the vertex of this index.
        covariance: (3, 3), in the frame of ``head``.
    """

    step: int
    kind: EdgeKind
    tail: VertexId
    head: VertexId
    pose: gtsam.Pose2
    covariance: FloatArray
    true: bool


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Robots, the way each went, and what they claim.

    Attributes:
        way: inter-vertex edges, from each vertex to its robot's next.
        claims: in the order in which they come.
        truth: world_T_vertex; None if it is not known.
    """

    way: list[Edge]
    claims: list[Claim]
    truth: dict[VertexId, gtsam.Pose2] | None

    def with_claims(self, claims: Sequence[Claim]) -> "Problem":
        """The same with more claims."""
        return replace(self, claims=sorted([*self.claims, *claims], key=lambda claim: claim.step))


class Building:
    """Robots that walk about at random, and come by the same places again and again.

    Args:
        seed: of everything.
        robots, vertices: how many, and of each robot.
    """

    def __init__(self, seed: int, robots: int = 3, vertices: int = 40) -> None:
        self._rng = np.random.default_rng(seed)
        self._truth: dict[VertexId, gtsam.Pose2] = {}
        self._taken: set[tuple[VertexId, VertexId]] = set()  # pairs of vertices with an alignment
        way = [edge for robot in "abcdefgh"[:robots] for edge in self._walk(robot, vertices)]
        self._places = {v: np.array([pose.x(), pose.y()]) for v, pose in self._truth.items()}
        self.problem = Problem(way, [], self._truth).with_claims(
            [self._claim(kind, *pair, true=True) for kind in KINDS for pair in self._met(kind)]
        )

    def false(self, shares: dict[EdgeKind, float]) -> list[Claim]:
        """Claims at random, so many that this share of all of a kind is false."""
        found = []
        for kind, share in shares.items():
            true = sum(claim.kind is kind for claim in self.problem.claims)
            found += [self._random(kind) for _ in range(round(true * share / (1.0 - share)))]
        return found

    def cluster(self, kind: EdgeKind, count: int) -> list[Claim]:
        """False claims that agree with each other: two stretches of way taken for one."""
        turn = self._rng.uniform([3.0, 3.0, 0.5], [8.0, 8.0, 2.0])
        while True:
            first = self._random(kind)
            ends = [(VertexId(v.robot, v.number + n) for v in (first.tail, first.head)) for n in range(count)]
            pairs = [(tail, head) for tail, head in ends]
            if all(v in self._truth for pair in pairs for v in pair):
                return [self._claim(kind, *pair, true=False, moved=gtsam.Pose2(*turn)) for pair in pairs]

    def look_alike(self, share: float) -> list[Claim]:
        """Loops and alignments that take a room for another in the same row: all that do so agree with each other."""
        found: list[Claim] = []
        for kind in (EdgeKind.LOOP, EdgeKind.ALIGNMENT):
            true = sum(claim.kind is kind for claim in self.problem.claims)
            while sum(claim.kind is kind for claim in found) < round(true * share / (1.0 - share)):
                tail, head = self._random_pair(kind)
                along, across = self._places[tail] - self._places[head]
                rooms = round(along / PITCH)
                if rooms and abs(across) < REACH and self._is_free(kind, tail, head):
                    moved = gtsam.Pose2(PITCH * rooms, 0.0, 0.0)
                    found.append(self._claim(kind, tail, head, true=False, moved=moved))
        return found

    def _walk(self, robot: str, vertices: int) -> list[Edge]:
        pose = gtsam.Pose2(*self._rng.uniform([0.0, 0.0, -np.pi], [SIZE, SIZE, np.pi]))
        self._truth[VertexId(robot, 0)] = pose
        edges = []
        for number in range(1, vertices):
            to = pose
            while to is pose or not (0.0 < to.x() < SIZE and 0.0 < to.y() < SIZE):
                to = pose.compose(gtsam.Pose2(0.0, 0.0, self._rng.uniform(-np.pi, np.pi))).compose(
                    gtsam.Pose2(STEP, 0.0, 0.0)
                )
            tail, head = VertexId(robot, number - 1), VertexId(robot, number)
            covariance = _NOISE[EdgeKind.INTER_VERTEX]
            measured = self._noisy(pose.between(to), covariance)
            edges.append(Edge(EdgeId(robot, number), 0, EdgeKind.INTER_VERTEX, tail, head, measured, covariance))
            self._truth[head] = pose = to
        return edges

    def _met(self, kind: EdgeKind) -> list[tuple[VertexId, VertexId]]:
        """Pairs of vertices between which there is a true claim of a kind: at most one for the later one's."""
        found = []
        for head, place in self._places.items():
            if kind is EdgeKind.LOOP:
                others = [VertexId(head.robot, i) for i in range(head.number - 2)]
            elif kind is EdgeKind.FUSING:  # in sight of each other at the same time, or a little later
                others = [v for v in self._truth if v.robot < head.robot and abs(v.number - head.number) < 3]
            else:
                others = [v for v in self._truth if v.robot < head.robot]
            near = [v for v in others if np.hypot(*(self._places[v] - place)) < REACH]
            if near:
                tail = near[int(self._rng.integers(len(near)))]
                self._is_free(kind, tail, head)
                found.append((tail, head))
        return found

    def _random_pair(self, kind: EdgeKind) -> tuple[VertexId, VertexId]:
        """Two vertices that a claim of a kind may be about."""
        vertices = list(self._truth)
        while True:
            tail, head = (vertices[int(i)] for i in self._rng.choice(len(vertices), 2, replace=False))
            if (tail.robot == head.robot) is (kind is EdgeKind.LOOP) and abs(tail.number - head.number) > 1:
                return tail, head

    def _random(self, kind: EdgeKind) -> Claim:
        while True:
            tail, head = self._random_pair(kind)
            pose = gtsam.Pose2(*self._rng.uniform([-STEP, -STEP, -np.pi], [STEP, STEP, np.pi]))
            off = self._truth[tail].between(self._truth[head]).between(pose)
            far = np.hypot(off.x(), off.y()) > APART or abs(off.theta()) > TURNED
            if far and self._is_free(kind, tail, head):
                return Claim(max(tail.number, head.number), kind, tail, head, pose, _NOISE[kind], False)

    def _claim(
        self, kind: EdgeKind, tail: VertexId, head: VertexId, true: bool, moved: gtsam.Pose2 | None = None
    ) -> Claim:
        """The true transform with noise, or as if all that is around ``head`` were ``moved`` in the world."""
        at = self._truth[head] if moved is None else moved.compose(self._truth[head])
        pose = self._noisy(self._truth[tail].between(at), _NOISE[kind])
        return Claim(max(tail.number, head.number), kind, tail, head, pose, _NOISE[kind], true)

    def _is_free(self, kind: EdgeKind, tail: VertexId, head: VertexId) -> bool:
        """Two maps have one alignment."""
        if kind is not EdgeKind.ALIGNMENT:
            return True
        free = (tail, head) not in self._taken
        self._taken.add((tail, head))
        return free

    def _noisy(self, pose: gtsam.Pose2, covariance: FloatArray) -> gtsam.Pose2:
        return pose.compose(gtsam.Pose2.Expmap(self._rng.multivariate_normal(np.zeros(3), covariance)))
