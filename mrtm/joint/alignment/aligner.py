"""Keeps the alignments of a joint map up to date (M13, on line): which pairs of maps, when again, with what outcome.

An alignment is tried when two maps of a component may overlap. It is tried again when one of the maps has changed, or
when the estimate has moved so far that the old answer was to another question.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import islice

import gtsam
import numpy as np

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId, squared_mahalanobis
from frontend.records import FloatArray
from mrtm.joint.alignment.align import Alignment, align
from mrtm.joint.alignment.candidates import Candidate, pairs
from mrtm.joint.alignment.surface import Surface
from mrtm.joint.graph import JointGraph

Pair = tuple[VertexId, VertexId]

MOVED = 4.0
"""Squared Mahalanobis distance, as the first guess saw it, beyond which a new guess is another question."""

CONTRADICTED = 30.0
"""chi2 of 3 degrees of freedom, as for loops: an alignment so far from the joint estimate is taken back."""

SCREENED = 2
"""Pairs whose overlap is worked out, for each that is tried at most."""

AGAIN = 3
"""Refused pairs of which is worked out whether their guess has become surer, when nothing else is due."""

SURER = 4.0
"""Times the volume of the first guess's covariance over the new one's for a refused pair to be worth another look."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """An alignment that was tried.

    Attributes:
        maps: the two as they were.
        guess: a_T_b as it was known.
        found: what came of it; None if nothing of the maps could meet.
        edge: if it is believed.
        refusal: why not, in words; empty if it is.
    """

    maps: tuple[Surface, Surface]
    guess: UncertainPose
    found: Alignment | None
    edge: Edge | None
    refusal: str


class Aligner:
    """The alignments of one joint map."""

    def __init__(self) -> None:
        self.attempts: dict[Pair, Attempt] = {}
        self._versions: dict[Pair, int] = {}

    def edges(self) -> list[Edge]:
        """Those believed."""
        return [a.edge for a in self.attempts.values() if a.edge is not None]

    def overlaps(self) -> dict[EdgeId, tuple[FloatArray, FloatArray]]:
        """Of those believed, which places of their two maps they rest on: ``Alignment.shares``."""
        return {a.edge.id: a.found.shares for a in self.attempts.values() if a.edge is not None and a.found is not None}

    def keep_within(self, groups: Iterable[Collection[str]]) -> None:
        """Forget alignments between robots that are not, or no longer, in one of the ``groups``.

        The guess was wrong then; if the robots come together again it is to another question.
        """
        group = {robot: number for number, robots in enumerate(groups) for robot in robots}
        self.attempts = {p: a for p, a in self.attempts.items() if group[p[0].robot] == group[p[1].robot]}

    def joins(self, one: str, other: str) -> bool:
        """Whether an alignment between maps of two robots is believed."""
        return any(a.edge and {v.robot for v in pair} == {one, other} for pair, a in self.attempts.items())

    def look(self, graph: JointGraph, maps: Mapping[VertexId, Surface], most: int) -> bool:
        """Try the pairs of a component that are due, at most so many; whether any was, or a believed one went.

        Args:
            graph: of the component; its edges are not touched.
            maps: of its closed vertices.
        """
        poses = graph.estimates()
        closed = {v: found for v in poses if (found := maps.get(v))}

        def wanted(a: VertexId, b: VertexId) -> bool:
            return self._open((a, b), (closed[a], closed[b]), poses)

        looks = SCREENED * most
        asked: dict[Pair, UncertainPose] = {}

        def relatives(pairs: list[Pair]) -> list[UncertainPose]:
            guesses = graph.relatives(pairs)
            asked.update(zip(pairs, guesses, strict=True))
            return guesses

        near = pairs(closed, poses, relatives, wanted, most=looks, looks=looks)
        apart = sorted(asked.keys() - {(c.a, c.b) for c in near})
        gone = any(pair in self.attempts and self.attempts[pair].edge for pair in apart)
        for a, b in apart:
            self.attempts[a, b] = Attempt((closed[a], closed[b]), asked[a, b], None, None, "they hardly overlap")
        due = [c for c in near if self._due((c.a, c.b), (closed[c.a], closed[c.b]), c.guess)][:most]
        refused = (p for p, a in self.attempts.items() if not a.edge and {*p} <= closed.keys())
        again = list(islice(refused, 0 if due else AGAIN))
        for pair, guess in zip(again, graph.relatives(again), strict=True):
            self.attempts[pair] = self.attempts.pop(pair)  # the next time it is another's turn
            if self._due(pair, (closed[pair[0]], closed[pair[1]]), guess):
                due.append(Candidate(*pair, guess))
        for a, b, guess in due:
            self._try((a, b), (closed[a], closed[b]), guess)
        return bool(due) or gone

    def take_back(self, graph: JointGraph) -> list[EdgeId]:
        """Give up alignments in ``graph`` that the joint estimate contradicts; their edges are to be removed.

        But those wait that the graph doubts while the question is what it was: more that agree with them may come.
        """
        gone = []
        present, doubted = {edge.id for edge in graph.edges()}, graph.doubted()
        for (a, b), attempt in self.attempts.items():
            if attempt.edge is None or attempt.edge.id not in present:
                continue
            chi2 = graph.chi2(attempt.edge.id)
            waits = attempt.edge.id in doubted and _moved(attempt, graph.estimate(a).between(graph.estimate(b))) < MOVED
            if chi2 > CONTRADICTED and not waits:
                reason = f"taken back: chi2 {chi2:.1f} from the joint estimate, more than {CONTRADICTED}"
                self.attempts[a, b] = Attempt(attempt.maps, attempt.guess, attempt.found, None, reason)
                gone.append(attempt.edge.id)
        return gone

    def _open(self, pair: Pair, maps: tuple[Surface, Surface], poses: Mapping[VertexId, gtsam.Pose2]) -> bool:
        """Whether the pair, as its maps are now, is new, or has moved since it was refused."""
        old = self.attempts.get(pair)
        if old is None or not _unchanged(old, maps):
            return True
        return old.edge is None and _moved(old, poses[pair[0]].between(poses[pair[1]])) > MOVED

    def _due(self, pair: Pair, maps: tuple[Surface, Surface], guess: UncertainPose) -> bool:
        """Whether a pair without an alignment is worth a try, the first or another."""
        old = self.attempts.get(pair)
        if old is None or not _unchanged(old, maps):
            return True
        return _moved(old, guess.pose) > MOVED or np.linalg.det(old.guess.covariance) > SURER**2 * np.linalg.det(
            guess.covariance
        )

    def _try(self, pair: Pair, maps: tuple[Surface, Surface], guess: UncertainPose) -> None:
        found = align(*maps, guess)
        edge, refusal = None, "nothing of the maps can meet"
        if found is not None:
            refusal = found.refusal or ""
            if not refusal:
                version = self._versions[pair] = self._versions.get(pair, -1) + 1
                name = EdgeId(f"{pair[0]}={pair[1]}", 0)
                pose, covariance = found.estimate
                edge = Edge(name, version, EdgeKind.ALIGNMENT, *pair, pose, covariance)
        self.attempts[pair] = Attempt(maps, guess, found, edge, refusal)


def _moved(attempt: Attempt, a_T_b: gtsam.Pose2) -> float:
    """Squared Mahalanobis distance, as the guess saw it."""
    offset = gtsam.Pose2.Logmap(attempt.guess.pose.between(a_T_b))
    return float(squared_mahalanobis(offset, attempt.guess.covariance))


def _unchanged(attempt: Attempt, maps: tuple[Surface, Surface]) -> bool:
    return attempt.maps[0] is maps[0] and attempt.maps[1] is maps[1]
