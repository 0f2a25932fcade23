"""Which sightings between robots to believe, and how the robots' frames lie to each other (M11, before any edge).

1. Each pair of robots by itself (``pairs``): the largest set of sightings that agree on the offset of the two frames,
   if it is large enough, clearly larger than the next, and not contradicted by the local maps.
2. The pairs so found, strongest first, make a tree (``joining``). A pair that would close a cycle must fit what the
   tree predicts; if not, it is the weakest of its cycle and left out.
3. Every sighting between robots that are then connected, directly or through others, is judged against the joint
   solution of all the others (chi2, 99.9 %): a single true one is accepted, a false one refused.

If sightings scatter about the joint solution more than was stated of them, this starts again with some slack.

All of it is a function of what is known and nothing else, whatever order it comes in: robots that hold the same
records come to the same verdicts, and a sighting accepted at one meeting may come out refused at a later one.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np

from factors import UncertainPose, VertexId
from mrtm.joint.sightings.hypotheses import Hypothesis, HypothesisId, OwnMap, RobotGraph, Slack
from mrtm.joint.sightings.joining import Joining, Pair
from mrtm.joint.sightings.pairs import LEAST_SUPPORT, Evidence, Finding, outnumbers

SLACKS = (Slack(0.0, 0.0), Slack(0.05, 0.05), Slack(0.1, 0.1), Slack(0.15, 0.2))
"""Tried in this order until one explains the scatter. Sightings cut out of real logs needed the third and fourth;
beyond that one in three hundred random false sightings would pass."""

UNEXPLAINED = (4, 0.01)
"""So many, and this share of all, may lie just outside their gates before the stated noise is doubted: random false
ones do so too, and must not be talked into a set of four."""


class Verdict(StrEnum):
    """What becomes of a sighting."""

    ACCEPTED = "accepted"
    WAITING = "waiting"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class Judgement:
    """The verdict on one sighting, why, and the numbers.

    Attributes:
        reason: one line.
        support: sightings of the same two robots that agree with it, itself included.
        rival: the most sightings of the same two robots that agree on something else.
        chi2: of the sighting against everything else in the joint solution; None if its robots are not connected.
    """

    id: HypothesisId
    verdict: Verdict
    reason: str
    support: int
    rival: int
    chi2: float | None


@dataclass(frozen=True, slots=True)
class Consistency:
    """All verdicts, and what follows from the accepted sightings.

    Attributes:
        judgements: one for each hypothesis, in the order of their ids.
        offsets: for each pair of robots with an accepted sighting, names in order, the pose of the second one's own
            frame in the first one's; covariance in the frame of the second, drift of both since their roots included.
        components: robots that are connected, groups of two or more, names in order.
        slack: by how much the robots' poses at the sightings were less certain than stated; add it to them before
            accepted sightings become edges.
    """

    judgements: dict[HypothesisId, Judgement]
    offsets: dict[Pair, UncertainPose]
    components: tuple[tuple[str, ...], ...]
    slack: Slack


def judge(
    hypotheses: Iterable[Hypothesis], graphs: Mapping[str, RobotGraph], evidence: Evidence | None = None
) -> Consistency:
    """Decide about all sightings known.

    Args:
        hypotheses: in any order, no id twice.
        graphs: each robot's own, by name; a sighting of a robot without one waits. One that changes is another graph.
        evidence: what local maps say of an offset; without it only sightings count.

    Raises:
        ValueError: two hypotheses have the same id.
        GraphError: a graph lacks a vertex of a sighting.
    """
    ordered = sorted(hypotheses, key=lambda h: h.id)
    for one, other in itertools.pairwise(ordered):
        if one.id == other.id:
            raise ValueError(f"sighting {one.id} is there twice")
    usable = [h for h in ordered if set(h.robots) <= graphs.keys()]
    joining, slack = _explain(usable, _own_maps(usable, graphs), evidence)
    known: dict[HypothesisId, Judgement] = {}
    for pair, rows in joining.rows.items():
        believed = int(np.count_nonzero(joining.believed[rows]))
        for place, row in enumerate(rows.tolist()):
            known[usable[row].id] = _judgement(usable[row], joining, pair, row, place, believed)
    judgements = {h.id: known.get(h.id) or _unknown(h, graphs) for h in ordered}
    return Consistency(judgements, joining.offsets(), joining.components(), slack)


def _own_maps(hypotheses: Sequence[Hypothesis], graphs: Mapping[str, RobotGraph]) -> dict[str, OwnMap]:
    wanted: dict[str, set[VertexId]] = {robot: set() for robot in sorted({r for h in hypotheses for r in h.robots})}
    for h in hypotheses:
        wanted[h.observer.robot].add(h.observer)
        wanted[h.observed.robot].add(h.observed)
    return {robot: _own_map(graphs[robot], frozenset(vertices)) for robot, vertices in wanted.items()}


@lru_cache(512)
def _own_map(graph: RobotGraph, wanted: frozenset[VertexId]) -> OwnMap:
    return OwnMap.of(graph, wanted)


def _explain(
    hypotheses: Sequence[Hypothesis], maps: Mapping[str, OwnMap], evidence: Evidence | None
) -> tuple[Joining, Slack]:
    """The joining with the least slack that leaves few sightings out which the most slack takes in."""

    def few(count: int, total: int) -> bool:
        return count <= UNEXPLAINED[0] + UNEXPLAINED[1] * total

    tight = Joining(hypotheses, maps, evidence, SLACKS[0])
    near = tight.within(SLACKS[-1])
    if not tight.open() and few(int(near.sum()), int(tight.believed.sum())):
        return tight, SLACKS[0]
    loose = Joining(hypotheses, maps, evidence, SLACKS[-1])
    for slack in SLACKS[:-1]:
        joining = tight if slack == SLACKS[0] else Joining(hypotheses, maps, evidence, slack)
        left_out = loose.believed & ~joining.believed
        if few(int(left_out.sum()), int(loose.believed.sum())):
            return joining, slack
    return loose, SLACKS[-1]


def _unknown(hypothesis: Hypothesis, graphs: Mapping[str, RobotGraph]) -> Judgement:
    missing = " and ".join(robot for robot in hypothesis.robots if robot not in graphs)
    return Judgement(hypothesis.id, Verdict.WAITING, f"nothing is known of the map of {missing}", 1, 0, None)


def _judgement(hypothesis: Hypothesis, joining: Joining, pair: Pair, row: int, place: int, believed: int) -> Judgement:
    """Verdict and reason for sighting ``row``, the one at ``place`` of its pair, of which so many are ``believed``."""
    finding, rows = joining.findings[pair], joining.rows[pair]
    names = f"{pair[0]} and {pair[1]}"
    own = next((s for s in finding.sets if s.members[place]), None)
    support = own.support if own else 1
    rival = max((s.support for s in finding.sets if s is not own), default=0)
    chi2, gate = float(joining.chi2[row]), float(joining.gates[row])
    if np.isnan(chi2):
        if own in finding.vetoed:
            verdict, reason = Verdict.REFUSED, f"the local maps of {names} contradict each other where it puts them"
        else:
            verdict, reason = Verdict.WAITING, _doubt(finding, names, support, rival)
        return Judgement(hypothesis.id, verdict, reason, support, rival, None)
    if joining.believed[row]:
        support = believed
        word = "the local maps agree" if joining.lifted[row] else f"chi2 {chi2:.1f} of at most {gate:.1f}"
        verdict, reason = Verdict.ACCEPTED, f"{support} of {len(rows)} sightings of {names} agree, {word}"
    elif chi2 < gate:
        verdict = Verdict.WAITING
        reason = f"the joint estimate of {names} is too uncertain here to tell a true sighting from a false one"
    elif own is finding.joined and joining.contradicting.get(pair) is False:
        verdict = Verdict.WAITING
        reason = f"{support} sightings of {names} agree, but not with the way between them through other robots"
    else:
        verdict = Verdict.REFUSED
        reason = f"chi2 {chi2:.1f} of at most {gate:.1f} against the joint estimate of {names}"
    return Judgement(hypothesis.id, verdict, reason, support, rival, chi2)


def _doubt(finding: Finding, names: str, support: int, rival: int) -> str:
    """Why a pair is not joined, as one of its sightings sees it."""
    if support < LEAST_SUPPORT:
        return f"{support} of {names} agree, at least {LEAST_SUPPORT} must"
    if not outnumbers(support, rival):
        return f"{support} of {names} agree, but {rival} others agree on something else"
    return f"{support} of {names} agree, too few without headings"
