"""Sightings between robots as hypotheses to be judged (M11), and what is known of their vertices, as arrays.

A sighting with a heading measures the pose of the observed robot's vertex seen from the observer's vertex in full; one
without measures where the observed robot stood, two equations. What the robots' poses within their vertices add to the
noise is counted with every sighting as if it were its own: they are far more certain than a sighting.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple, Protocol
from weakref import WeakValueDictionary

import gtsam
import numpy as np
import numpy.typing as npt

from factors import UncertainPose, VertexId, compose, inverse
from factors.sighting import Sighting

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

HypothesisId = tuple[str, int]
"""The robot that made the sighting and its running number: the key of its record."""


class Slack(NamedTuple):
    """Standard deviations of a robot's pose at a sighting that nobody stated: metres along each axis, and radians.

    Clocks that differ, poses interpolated in a turn, a target that is not the robot's middle.
    """

    xy: float
    theta: float


KEPT = 2**16  # sightings made ready to be judged

_DIGITS = 9  # of metres and radians
_HAIR = 1e-10  # of a variance


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A sighting that may be true.

    Attributes:
        id: unlike that of any other.
        observer, observed: the vertices in which the two robots were, of different robots.
        sighting: what was measured.
        tail_T_observer: the observer's pose in its vertex, covariance in the frame of the robot.
        head_T_observed: the observed robot's pose in its vertex, likewise.
        anchors: x, y, theta of these two.
        robots: the two, in the order of their names.

    Raises:
        ValueError: if both vertices are of one robot.
    """

    id: HypothesisId
    observer: VertexId
    observed: VertexId
    sighting: Sighting
    tail_T_observer: UncertainPose
    head_T_observed: UncertainPose
    anchors: tuple[list[float], list[float]] = field(init=False)
    robots: tuple[str, str] = field(init=False)

    def __post_init__(self) -> None:
        if self.observer.robot == self.observed.robot:
            raise ValueError(f"sighting {self.id}: robot {self.observer.robot} cannot sight itself")
        anchors = coordinates(self.tail_T_observer.pose), coordinates(self.head_T_observed.pose)
        object.__setattr__(self, "anchors", anchors)
        object.__setattr__(self, "robots", tuple(sorted((self.observer.robot, self.observed.robot))))


class RobotGraph(Protocol):
    """One robot's own graph; :class:`mrtm.joint.graph.JointGraph` is one."""

    def __hash__(self) -> int:
        """By identity."""

    @property
    def root(self) -> VertexId:
        """The vertex that fixes the robot's own frame."""

    def estimate(self, vertex: VertexId) -> gtsam.Pose2:
        """The pose of a vertex in the robot's own frame."""

    def relatives(self, pairs: Sequence[tuple[VertexId, VertexId]]) -> list[UncertainPose]:
        """a_T_b with its covariance in the frame of b, for every pair."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class OwnMap:
    """What one robot's graph knows of the m vertices that matter.

    Attributes:
        vertices: the root first.
        poses: (m, 3) in the robot's own frame.
        relative: (m, m, 3) pose of vertex k seen from vertex i at [i, k].
        covariances: (m, m, 3, 3) theirs, in the frame of k.
        tree: (m - 1, 2) indices i, k of the vertex pairs of the tree that keeps most of what is known (Chow and Liu
            1968): relative covariances of least determinant. Its edges taken as independent are exact on a chain and
            cautious where loops were closed.
    """

    vertices: tuple[VertexId, ...]
    poses: FloatArray
    relative: FloatArray
    covariances: FloatArray
    tree: IntArray

    @classmethod
    def of(cls, graph: RobotGraph, wanted: Iterable[VertexId]) -> "OwnMap":
        """Ask a graph for its root and the ``wanted`` vertices."""
        root = graph.root
        vertices = (root, *sorted(set(wanted) - {root}))
        m = len(vertices)
        poses = np.array([coordinates(graph.estimate(vertex)) for vertex in vertices])
        relative, covariances = np.zeros((m, m, 3)), np.zeros((m, m, 3, 3))
        pairs = list(combinations(range(m), 2))
        seen = graph.relatives([(vertices[i], vertices[k]) for i, k in pairs])
        for (i, k), there in zip(pairs, seen, strict=True):
            back = inverse(there)
            relative[i, k], covariances[i, k] = coordinates(there.pose), there.covariance
            relative[k, i], covariances[k, i] = coordinates(back.pose), back.covariance
        return cls(vertices, poses, relative, covariances, _tree(covariances))

    def among(self, wanted: Iterable[VertexId]) -> "OwnMap":
        """The root and the ``wanted`` vertices only; one and the same object as long as these stay where they are.

        Its numbers are rounded, far below what matters, so that it does not change with every digit of the others.
        """
        return _among(self, frozenset(wanted))


_interned: WeakValueDictionary[tuple[tuple[VertexId, ...], bytes], OwnMap] = WeakValueDictionary()


@lru_cache(2**12)
def _among(own: OwnMap, wanted: frozenset[VertexId]) -> OwnMap:
    rows = [row for row, vertex in enumerate(own.vertices) if row == 0 or vertex in wanted]
    vertices, block = tuple(own.vertices[row] for row in rows), np.ix_(rows, rows)
    poses, relative = own.poses[rows].round(_DIGITS), own.relative[block].round(_DIGITS)
    covariances = own.covariances[block].round(2 * _DIGITS)
    name = vertices, b"".join(part.tobytes() for part in (poses, relative, covariances))
    found = _interned.get(name)
    if found is None:
        found = _interned[name] = OwnMap(vertices, poses, relative, covariances, _tree(covariances))
    return found


@dataclass(frozen=True, slots=True)
class Measurements:
    """n sightings as arrays; ``tail`` and ``head`` are rows of whatever table of vertices goes with them.

    Attributes:
        tail, head: (n,) the vertices of observer and observed.
        full: (n,) whether there is a heading.
        measured: (n, 3) with a heading tail_T_head; without, x and y of the observed robot in the observer's frame.
        noise: (n, 3, 3) with a heading the covariance in the frame of head; without, of x and y in the observer's
            frame, and a 1 that keeps it regular.
        tail_anchor, head_anchor: (n, 3) the robots' poses in their vertices.
    """

    tail: IntArray
    head: IntArray
    full: BoolArray
    measured: FloatArray
    noise: FloatArray
    tail_anchor: FloatArray
    head_anchor: FloatArray

    @classmethod
    def of(cls, hypotheses: Sequence[Hypothesis], rows: dict[VertexId, int], slack: Slack) -> "Measurements":
        """Turn hypotheses into arrays; ``rows`` is the table of vertices, ``slack`` is added to both robots' poses."""
        n = len(hypotheses)
        values = [_measured(hypothesis, slack) for hypothesis in hypotheses]
        measured = np.array([pose for pose, _ in values]).reshape(n, 3)
        noise = np.array([covariance for _, covariance in values]).reshape(n, 3, 3)
        # A hair wider: seen from far off it is so long and thin that rounding would make it indefinite.
        noise += _HAIR * np.trace(noise, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        return cls(
            np.array([rows[h.observer] for h in hypotheses], np.int64),
            np.array([rows[h.observed] for h in hypotheses], np.int64),
            np.array([h.sighting.heading is not None for h in hypotheses], np.bool_),
            measured,
            noise,
            np.array([h.anchors[0] for h in hypotheses]).reshape(n, 3),
            np.array([h.anchors[1] for h in hypotheses]).reshape(n, 3),
        )

    @classmethod
    def together(cls, parts: Iterable["Measurements"], rows: Iterable[IntArray]) -> "Measurements":
        """The sightings of all ``parts``, which have one table of vertices; each part's become some of the ``rows``."""
        every = [cls.of((), {}, Slack(0.0, 0.0)), *parts]
        order = np.argsort(np.concatenate([np.zeros(0, np.int64), *rows]))
        return cls(*(np.concatenate([getattr(part, f.name) for part in every])[order] for f in fields(cls)))

    def of_table(self, vertices: IntArray) -> "Measurements":
        """The same for the table of vertices that holds row k of the present one at ``vertices[k]``."""
        return replace(self, tail=vertices[self.tail], head=vertices[self.head])

    def rows(self, which: IntArray) -> "Measurements":
        """Some of them."""
        return Measurements(*(getattr(self, f.name)[which] for f in fields(self)))

    def __len__(self) -> int:
        return len(self.tail)


@lru_cache(KEPT)
def _measured(hypothesis: Hypothesis, slack: Slack) -> tuple[list[float], FloatArray]:
    """A row of ``measured`` and ``noise``."""
    more = np.diag([slack.xy, slack.xy, slack.theta]) ** 2
    observer, observed = (
        UncertainPose(end.pose, end.covariance + more)
        for end in (hypothesis.tail_T_observer, hypothesis.head_T_observed)
    )
    pose = hypothesis.sighting.relative_pose()
    if pose is None:
        noise = np.eye(3)
        noise[:2, :2] = _position_noise(hypothesis.sighting, observer.covariance, observed.covariance)
        return [*hypothesis.sighting.position.tolist(), 0.0], noise
    between = compose(compose(observer, pose), inverse(observed))
    return coordinates(between.pose), between.covariance


def coordinates(pose: gtsam.Pose2) -> list[float]:
    """x, y, theta."""
    return [pose.x(), pose.y(), pose.theta()]


def _position_noise(sighting: Sighting, observer: FloatArray, observed: FloatArray) -> FloatArray:
    """(2, 2) covariance of where the observed robot seems to be, in the observer's frame, both poses' (3, 3) included.

    The observed robot's heading there is not known: its pose covariance counts with its larger axis, all around.
    """
    x, y = sighting.position.tolist()
    lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
    widest = float(np.linalg.eigvalsh(observed[:2, :2])[-1])
    return np.asarray(sighting.position_covariance + lever @ observer @ lever.T + widest * np.eye(2))


def _tree(covariances: FloatArray) -> IntArray:
    """Prim's algorithm on the log determinants, from row 0."""
    m = len(covariances)
    cost = np.full((m, m), np.inf)
    off = ~np.eye(m, dtype=np.bool_)
    cost[off] = np.linalg.slogdet(covariances[off])[1]
    outside, cheapest, parent = np.ones(m, np.bool_), np.full(m, np.inf), np.zeros(m, np.int64)
    edges: list[tuple[int, int]] = []
    new = 0
    while True:
        outside[new] = False
        if not outside.any():
            return np.array(edges, np.int64).reshape(-1, 2)
        closer = outside & (cost[new] < cheapest)
        cheapest[closer], parent[closer] = cost[new, closer], new
        new = int(np.argmin(np.where(outside, cheapest, np.inf)))
        edges.append((int(parent[new]), new))
