"""Which edges that may be false a graph believes: one way in and one way out for loops, fusing and alignment edges.

An edge that says what the estimate says already is believed. So is one that its uncertainty explains, where the
estimate is sure enough to tell a true edge from a false one; any other is doubted: it is known, and without effect. It
is judged again when the estimate has come nearer. Several doubted edges that agree with each other come in together,
if they strain what cannot be false by no more than a slip, and put out those fewer ones that they contradict. Whatever
believed edge the estimate then contradicts is doubted again.

How many edges a change has looked at is bounded, but for sets that are to come in together: those are held against the
whole graph.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from itertools import islice

import numpy as np
from scipy.special import chdtrc, chdtri

from factors import FULL_WEIGHT, EdgeId, GraphEdge
from factors.noise import FloatArray
from mrtm.joint.agreeing import agreeing, clique
from mrtm.joint.equations import CERTAIN, FUSED, Equations
from mrtm.joint.sightings.innovation import share_passing
from mrtm.joint.sightings.pairs import LEAST_SUPPORT, outnumbers
from mrtm.joint.smoother import TOGETHER

GATE = {2: 26.99, 3: 30.0}
"""chi2 of so many degrees of freedom that a true edge has at most: one in 720,000 has more. Loops of real logs need
that of three, as their errors have heavier tails than they claim."""

ALLOWED = 0.001
"""Chance that an edge which comes in by itself is false: that it was, by the share of those that are doubted, and that
the estimate explains it none the less."""

PRIOR = 0.002
"""False edges met before the first: robots look twice before they close a loop or align two maps."""

DISTINCT = 0.01
"""Two edges agree where fewer than this share of random false ones would do so with either."""

CHECKED = 64  # believed edges, and doubted ones, that a change has looked at beside the new ones
LOOKED = 128  # doubted edges that a new doubted one is held against, the latest
ROUNDS = 8  # of edges that come in and go out after a change, beside the new ones
NEARER = 0.5  # of the chi2 that a doubted edge had when it was judged, for it to be judged again

GROWN = 1.5
"""Times as many must agree for another look at a set of doubted edges: it takes the whole graph."""

MORE = 1.02
"""Times as many edges the graph must have as when a set did not fit, for the next to be tried."""

SLIP = 100.0
"""chi2 by which edges that agree may strain those that cannot be false, beside their own noise: the robot may have
slipped along a wall by ten times what it thinks. Look-alike places are farther apart."""


class Doubts:
    """The memory of one graph's doubts: which doubted edges agree, and which others are to be looked at next."""

    def __init__(self) -> None:
        self._agreeing: defaultdict[EdgeId, set[EdgeId]] = defaultdict(set)
        self._failed: dict[EdgeId, int] = {}  # size of the last set of doubted edges with it that could not come in
        self._tried = 0  # edges that the graph had when a set last could not come in
        self._next = 0  # place among all edges of the next believed one to be checked

    def forget(self, gone: Iterable[EdgeId]) -> None:
        """What was found of edges that go, or change, holds no longer."""
        for i in gone:
            self._failed.pop(i, None)
            for j in self._agreeing.pop(i, ()):
                self._agreeing[j].discard(i)

    def settle(self, equations: Equations, new: Collection[EdgeId]) -> None:
        """Bring a graph that has changed to rest: let in, and put out, until nothing is due.

        Args:
            new: edges just added, which are doubted so far; whether one is among them is asked often.
        """
        suspects = self._suspects(equations)
        went_before: set[EdgeId] = set()
        unseen = 1  # of the doubted ones, to be looked at before the graph is at rest
        for _ in range(ROUNDS + len(new)):
            if unseen <= 0:
                return
            again = list(islice((i for i in equations.doubted if i not in new), CHECKED))
            for i in again:  # to the end of the queue
                equations.doubted[i] = equations.doubted.pop(i)
            unseen -= CHECKED
            waiting = [i for i in (*new, *again) if i in equations.doubted and i not in went_before]
            came = self._let_in(equations, waiting)
            if not came:
                came = self._let_in_together(equations, [i for i in new if i in waiting])
            went = self._put_out(equations, suspects + came)
            went_before |= {*went}
            if came or went:
                unseen = len(equations.doubted) + 1

    def _let_in(self, equations: Equations, waiting: Sequence[EdgeId]) -> list[EdgeId]:
        """Those that the estimate agrees with, if they are most; else those that its uncertainty explains as well."""
        misfits = {i: equations.misfit(equations.edges[i]) for i in waiting}
        near = [i for i, chi2 in misfits.items() if chi2 <= FULL_WEIGHT[len(equations.edges[i].covariance)]]
        if near and 2 * len(near) >= len(waiting):
            equations.believe(near)
            return near
        nearer = [i for i, chi2 in misfits.items() if i not in near and chi2 < NEARER * equations.doubted[i]]
        nearer = near + nearer
        for first in range(0, len(nearer), TOGETHER):
            if true := _told_true(equations, nearer[first : first + TOGETHER]):
                # At their full weight first: the kernel, which does not know of the drift, would hold them off.
                equations.believe(true, kernel=False)
                equations.put_under_kernel(true)
                return true
        return []

    def _let_in_together(self, equations: Equations, new: Iterable[EdgeId]) -> list[EdgeId]:
        """The first set of edges around a new one that agree with each other and with what cannot be false."""
        for i in new:
            if len(equations.edges) < MORE * self._tried:
                break
            others = [j for j in islice(reversed(equations.doubted), LOOKED) if j != i]
            for j in agreeing(equations, i, others, _agree):
                self._agreeing[i].add(j)
                self._agreeing[j].add(i)
            members = clique(i, self._agreeing, equations.doubted)
            if len(members) < max(LEAST_SUPPORT, *(GROWN * self._failed.get(j, 0) for j in members)):
                continue
            if (went := _contradicted(equations, members)) is not None:
                return [*members, *went]
            self._failed.update(dict.fromkeys(members, len(members)))
            self._tried = len(equations.edges)
        return []

    def _put_out(self, equations: Equations, suspects: Iterable[EdgeId]) -> list[EdgeId]:
        """Of some edges the one that the estimate contradicts most."""
        worst, most = None, 1.0
        for i in suspects:
            edge = equations.edges[i]
            strain = 0.0 if i in equations.doubted else equations.misfit(edge) / GATE[len(edge.covariance)]
            if strain > most and equations.may_go([i]):
                worst, most = i, strain
        if worst is None:
            return []
        equations.doubt([worst])
        return [worst]

    def _suspects(self, equations: Equations) -> list[EdgeId]:
        """The next of all edges that may be false."""
        if self._next >= len(equations.edges):
            self._next = 0
        chosen = islice(equations.edges.items(), self._next, self._next + CHECKED)
        self._next += CHECKED
        return [i for i, edge in chosen if edge.kind not in CERTAIN]


def chance(covariance: FloatArray) -> float:
    """Share of random false edges that would pass the gate, given the (n, n) covariance of their innovation."""
    n = len(covariance)
    spread = np.sqrt(np.maximum(np.linalg.det(covariance), 0.0))
    return float(share_passing(spread, np.array(n == 3), np.array(GATE[n])))


def _agree(chi2: float, covariance: FloatArray) -> bool:
    return chi2 <= GATE[len(covariance)] and chance(covariance) < DISTINCT


def _told_true(equations: Equations, ids: Sequence[EdgeId]) -> list[EdgeId]:
    """Those of some doubted edges that the estimate explains, each after those before it have come in."""
    edges, true = [equations.edges[i] for i in ids], []
    expectation = equations.expectation(edges)
    for n, edge in enumerate(edges):
        equations.doubted[edge.id] = math.inf  # not judged
        chi2 = expectation.misfit(n)
        if chi2 <= FULL_WEIGHT[len(edge.covariance)] or _is_told_true(equations, edge, *expectation.innovation(n)):
            true.append(edge.id)
            expectation.take(n)
        else:
            equations.doubted[edge.id] = chi2
    return true


def _is_told_true(equations: Equations, edge: GraphEdge, chi2: float, covariance: FloatArray) -> bool:
    """Whether the estimate explains an edge, given its innovation, and would hardly explain a false one.

    What sightings fuse to was chosen among all others with the same care (``consistency``).
    """
    if chi2 > GATE[len(covariance)]:
        return False
    passing = 0.0 if edge.kind in FUSED else chance(covariance)
    return passing < ALLOWED or passing * _share_of_false(equations) < ALLOWED


def _share_of_false(equations: Equations) -> float:
    """Of the edges that may be false, as far as they have been judged."""
    count = sum(edge.kind not in CERTAIN for edge in equations.edges.values())
    judged = sum(chi2 < math.inf for chi2 in equations.doubted.values())
    return (PRIOR + judged) / count


def _contradicted(equations: Equations, members: Sequence[EdgeId]) -> list[EdgeId] | None:
    """Let edges in at once and put out those they contradict, which are returned; None if it cannot be, and all is as
    it was.

    They must be clearly more than those that go, and may strain what stays no more than true ones would.
    """
    before = equations.cost()
    equations.believe(members, kernel=False)
    went = [i for i in _strained(equations) if i not in members]
    may = outnumbers(len(members), len(went)) if went else True
    if may and went and (may := equations.may_go(went)):
        out = _spare(equations, went, members)
        equations.doubt(out)
        before = equations.cost()
        equations.believe([i for i in out if i not in went], kernel=False)
    if may and not _strained(equations) and equations.cost() - before <= _set_gate(len(members)) + SLIP:
        equations.put_under_kernel(members)
        return went
    again = [i for i in went if i in equations.doubted]
    if again:  # first, as they may hold what the members do now
        equations.believe(again)
    equations.doubt(members)
    return None


def _spare(equations: Equations, went: Sequence[EdgeId], members: Sequence[EdgeId]) -> list[EdgeId]:
    """Those that went, and with them all members but what then holds vertices: by itself that strains nothing."""
    out = [*went, *members]
    if equations.may_go(out):
        return out
    out = [*went]
    for i in members:
        if equations.may_go([*out, i]):
            out.append(i)
    return out


def _strained(equations: Equations) -> list[EdgeId]:
    """Believed edges that may be false and that the estimate contradicts."""
    return [
        i
        for i, edge in equations.edges.items()
        if edge.kind not in CERTAIN
        and i not in equations.doubted
        and equations.misfit(edge) > GATE[len(edge.covariance)]
    ]


def _set_gate(count: int) -> float:
    """What so many true edges add to the least sum of squares at most, more as seldom as one alone beyond its gate."""
    return float(chdtri(3 * count, chdtrc(3, GATE[3])))
