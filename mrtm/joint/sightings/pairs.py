"""Whether the sightings between two robots, by themselves, tell where the robots' frames lie to each other."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import count, islice

import gtsam
import numpy as np

from factors import UncertainPose, VertexId
from mrtm.joint.alignment.agreement import Decision
from mrtm.joint.sightings.consensus import Candidate, candidates
from mrtm.joint.sightings.hypotheses import BoolArray, Hypothesis, IntArray, Measurements, OwnMap, Slack

Evidence = Callable[[VertexId, VertexId, UncertainPose, bool], Decision]
"""What the local maps around two vertices of different robots say of a pose tail_T_head. The last argument tells that
nothing matters but whether they contradict it: that is found a hundred times faster."""

LEAST_SUPPORT = 4
"""Sightings that must agree: two or three false ones that agree by chance or by one common fault defeat any method."""

LEAST_SURPLUS = 9
"""Numbers measured beyond the three an offset takes: those of four sightings with a heading, or of six without."""

KEPT = 2**12  # pairs of robots as their sightings were

MOST_LOOKS = 5
"""Offsets of one pair that the local maps are asked about."""


def outnumbers(support: int, rival: int) -> bool:
    """Whether ``support`` sightings are clearly more than ``rival`` others that agree on something else."""
    return support >= 2 * rival + 2


@dataclass(frozen=True, slots=True)
class Finding:
    """What the n sightings of one pair say.

    Attributes:
        sets: those that agree with each other, as far as they were looked at, the largest first; no two share one.
        joined: the set that is believed, None if none is yet.
        lifted: whether it took the local maps to believe it.
        vetoed: sets whose offset the local maps contradict.
        rival: support of the largest set against the best one.
        root: the row of the second robot's root in the frames of the sets.
    """

    sets: tuple[Candidate, ...]
    joined: Candidate | None
    lifted: bool
    vetoed: tuple[Candidate, ...]
    rival: int
    root: int

    def set_of(self, row: int) -> Candidate | None:
        """The set that sighting ``row`` is in."""
        return next((s for s in self.sets if s.members[row]), None)


class Proposed:
    """Sets of sightings of one pair that agree, the largest first, found as they are asked for, and kept.

    Args:
        first, second: own maps of the two robots.
        hypotheses: all sightings between them, in the order of their ids.
        slack: what is added to the poses' uncertainty.
    """

    def __init__(self, first: OwnMap, second: OwnMap, hypotheses: tuple[Hypothesis, ...], slack: Slack) -> None:
        self.vertices, self.split = first.vertices + second.vertices, len(first.vertices)
        table = {vertex: row for row, vertex in enumerate(self.vertices)}
        self.sightings = Measurements.of(hypotheses, table, slack)
        self._found: list[Candidate] = []
        self._source = candidates(first, second, self.sightings)

    @staticmethod
    @lru_cache(KEPT)
    def of(first: OwnMap, second: OwnMap, hypotheses: tuple[Hypothesis, ...], slack: Slack) -> "Proposed":
        """The same object for the same arguments: most pairs have nothing new when sightings are judged again."""
        return Proposed(first, second, hypotheses, slack)

    def __iter__(self) -> Iterator[Candidate]:
        for place in count():
            if place == len(self._found):
                found = next(self._source, None)
                if found is None:
                    return
                self._found.append(found)
            yield self._found[place]


def find(proposed: Proposed, evidence: Evidence | None) -> Finding:
    """Decide about one pair: the largest set, if it is large enough and clearly larger than the next.

    Local maps that overlap at its offset and contradict it veto it. A set that is too small, or has a rival, is
    believed if the maps agree with it and with no other.
    """
    stream = iter(proposed)
    sets = list(islice(stream, 2))
    vetoed: list[Candidate] = []

    def look(candidate: Candidate, veto: bool) -> Decision:
        if evidence is None:
            return Decision.UNDECIDED
        return evidence(*_where(candidate, proposed.sightings, proposed.vertices, proposed.split), veto)

    while sets[len(vetoed) :]:
        best, rest = sets[len(vetoed)], sets[len(vetoed) + 1 :]
        rival = rest[0].support if rest else 0
        enough = best.support >= LEAST_SUPPORT and best.surplus >= LEAST_SURPLUS
        if not (enough and outnumbers(best.support, rival)):
            break
        if look(best, veto=True) is not Decision.CONTRADICTS:
            return Finding(tuple(sets), best, False, tuple(vetoed), rival, proposed.split)
        vetoed.append(best)
        sets.extend(islice(stream, 1))
    looked = sets[len(vetoed) :]
    rival = looked[1].support if len(looked) > 1 else 0
    if evidence is None or not looked:
        return Finding(tuple(sets), None, False, tuple(vetoed), rival, proposed.split)
    more = list(islice(stream, MOST_LOOKS - len(looked) + 1))
    sets, looked = sets + more, (looked + more)[:MOST_LOOKS]
    unseen = max((s.support for s in sets[len(vetoed) + len(looked) :]), default=0)
    said = [look(candidate, veto=False) for candidate in looked]
    agreeing = [candidate for candidate, word in zip(looked, said, strict=True) if word is Decision.AGREES]
    vetoed += [candidate for candidate, word in zip(looked, said, strict=True) if word is Decision.CONTRADICTS]
    lifted = len(agreeing) == 1 and agreeing[0].support > unseen
    return Finding(tuple(sets), agreeing[0] if lifted else None, lifted, tuple(vetoed), rival, proposed.split)


def _where(
    candidate: Candidate, sightings: Measurements, rows: tuple[VertexId, ...], first: int
) -> tuple[VertexId, VertexId, UncertainPose]:
    """The two vertices between which most members were seen, the first robot's first, and their relative pose."""
    ends = _ends(candidate.members, sightings, first)
    pairs, counts = np.unique(ends, axis=0, return_counts=True)
    tail, head = pairs[int(np.argmax(counts))]
    pose, covariance = candidate.frame.predict(np.array([tail]), np.array([head]))
    return rows[tail], rows[head], UncertainPose(gtsam.Pose2(*pose[0]), covariance[0])


def _ends(members: BoolArray, sightings: Measurements, first: int) -> IntArray:
    ends = np.column_stack([sightings.tail[members], sightings.head[members]])
    return np.where((ends[:, :1] < first), ends, ends[:, ::-1])
