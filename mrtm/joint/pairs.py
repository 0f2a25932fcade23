"""Whether the sightings between two robots, by themselves, tell where the robots' frames lie to each other."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import gtsam
import numpy as np

from factors import UncertainPose, VertexId
from mrtm.joint.agreement import Decision
from mrtm.joint.consensus import Candidate, candidates
from mrtm.joint.hypotheses import BoolArray, IntArray, Measurements, OwnMap

Evidence = Callable[[VertexId, VertexId, UncertainPose], Decision]
"""What the local maps around two vertices of different robots say of a pose tail_T_head."""

LEAST_SUPPORT = 4
"""Sightings that must agree: two or three false ones that agree by chance or by one common fault defeat any method."""

LEAST_SURPLUS = 9
"""Numbers measured beyond the three an offset takes: those of four sightings with a heading, or of six without."""

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
    """

    sets: tuple[Candidate, ...]
    joined: Candidate | None
    lifted: bool
    vetoed: tuple[Candidate, ...]
    rival: int

    def set_of(self, row: int) -> Candidate | None:
        """The set that sighting ``row`` is in."""
        return next((s for s in self.sets if s.members[row]), None)


def find(first: OwnMap, second: OwnMap, sightings: Measurements, evidence: Evidence | None) -> Finding:
    """Decide about one pair: the largest set, if it is large enough and clearly larger than the next.

    Local maps that overlap at its offset and contradict it veto it. A set that is too small, or has a rival, is
    believed if the maps agree with it and with no other.
    """
    stream = candidates(first, second, sightings)
    sets = list(islice(stream, 2))
    vetoed: list[Candidate] = []
    rows = first.vertices + second.vertices

    def look(candidate: Candidate) -> Decision:
        if evidence is None:
            return Decision.UNDECIDED
        return evidence(*_where(candidate, sightings, rows, len(first.vertices)))

    while sets[len(vetoed) :]:
        best, rest = sets[len(vetoed)], sets[len(vetoed) + 1 :]
        rival = rest[0].support if rest else 0
        enough = best.support >= LEAST_SUPPORT and best.surplus >= LEAST_SURPLUS
        if not (enough and outnumbers(best.support, rival)):
            break
        if look(best) is not Decision.CONTRADICTS:
            return Finding(tuple(sets), best, False, tuple(vetoed), rival)
        vetoed.append(best)
        sets.extend(islice(stream, 1))
    looked = sets[len(vetoed) :]
    rival = looked[1].support if len(looked) > 1 else 0
    if evidence is None or not looked:
        return Finding(tuple(sets), None, False, tuple(vetoed), rival)
    more = list(islice(stream, MOST_LOOKS - len(looked) + 1))
    sets, looked = sets + more, (looked + more)[:MOST_LOOKS]
    unseen = max((s.support for s in sets[len(vetoed) + len(looked) :]), default=0)
    said = [look(candidate) for candidate in looked]
    agreeing = [candidate for candidate, word in zip(looked, said, strict=True) if word is Decision.AGREES]
    vetoed += [candidate for candidate, word in zip(looked, said, strict=True) if word is Decision.CONTRADICTS]
    lifted = len(agreeing) == 1 and agreeing[0].support > unseen
    return Finding(tuple(sets), agreeing[0] if lifted else None, lifted, tuple(vetoed), rival)


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
