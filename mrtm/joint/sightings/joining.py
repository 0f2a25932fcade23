"""From pairs of robots whose frames are known to each other to components, and which sightings fit them."""

import heapq
from collections.abc import Iterable, Mapping, Sequence

import gtsam
import numpy as np

from factors import UncertainPose, VertexId, adjoint_transport
from frontend import se2
from mrtm.joint.sightings.common_frame import CommonFrame, examine, solve
from mrtm.joint.sightings.hypotheses import BoolArray, Hypothesis, IntArray, Measurements, OwnMap, Slack
from mrtm.joint.sightings.innovation import gates, share_passing
from mrtm.joint.sightings.pairs import LEAST_SUPPORT, Evidence, Proposed, find, outnumbers

Pair = tuple[str, str]

CHANCE = 0.01
"""A sighting is believed only where fewer than this share of random false ones, anywhere within 10 m, would fit."""

_ROUNDS = 12


class Joining:
    """Joins robots by their sightings and judges each sighting by all others.

    Args:
        hypotheses: between robots that have a graph, in the order of their ids.
        maps: each robot's own, by name, in the order of the names.
        evidence: what local maps say of an offset.
        slack: what is added to the poses' uncertainty.

    Attributes:
        believed: (n,) which sightings.
        chi2: (n,) of each against all others that are believed; NaN if they do not connect its robots.
        gates: (n,) what a true one has at most, 99.9 %.
        lifted: (n,) believed because the local maps agree.
        findings: what each pair says by itself.
        rows: (k,) the sightings of each pair.
        contradicting: pairs that agree among themselves, but not with the way through other robots, and whether that
            way is the clearly better founded.
    """

    def __init__(
        self, hypotheses: Sequence[Hypothesis], maps: Mapping[str, OwnMap], evidence: Evidence | None, slack: Slack
    ) -> None:
        self._hypotheses, self._maps = hypotheses, maps
        table = self._table(maps)
        self._at = {robot: np.array([table[v] for v in own.vertices], np.int64) for robot, own in self._maps.items()}
        self._poses = np.zeros((len(table), 3))
        self._frames: dict[str, tuple[CommonFrame, dict[str, int]]] = {}
        n = len(hypotheses)
        self.believed, self.lifted = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        self.chi2, self._decidable = np.full(n, np.nan), np.zeros(n, np.bool_)
        members: dict[Pair, list[int]] = {}
        for row, h in enumerate(hypotheses):
            members.setdefault(h.robots, []).append(row)
        self.rows = {pair: np.array(members[pair], np.int64) for pair in sorted(members)}
        proposed = {pair: self._proposed(pair, rows, slack) for pair, rows in self.rows.items()}
        seen = (p.sightings.of_table(np.array([table[v] for v in p.vertices])) for p in proposed.values())
        self._sightings = Measurements.together(seen, self.rows.values())
        self.gates = gates(self._sightings.full)
        self.findings = {pair: find(p, None) for pair, p in proposed.items()}
        self.contradicting: dict[Pair, bool] = {}
        self._settle(self._span(proposed, evidence))

    def _proposed(self, pair: Pair, rows: IntArray, slack: Slack) -> Proposed:
        """What the sightings of a pair propose, seen by the vertices that these have to do with."""
        hypotheses = tuple(self._hypotheses[row] for row in rows.tolist())
        ends = [vertex for h in hypotheses for vertex in (h.observer, h.observed)]
        a, b = (self._maps[robot].among(v for v in ends if v.robot == robot) for robot in pair)
        return Proposed.of(a, b, hypotheses, slack)

    def within(self, slack: Slack) -> BoolArray:
        """(n,) which sightings would fit where they are believed not to, if the poses were uncertain by ``slack``."""
        fits = np.zeros(len(self.believed), np.bool_)
        for robots in self.components():
            which = np.array([j for j in self._inside(robots).tolist() if not self.believed[j]], np.int64)
            if len(which):
                frame, _ = self._frames[robots[0]]
                wide = Measurements.of([self._hypotheses[j] for j in which.tolist()], self._table(robots), slack)
                examined = examine(frame, wide, np.zeros(len(which), np.bool_))
                fits[which] = (examined.chi2 < self.gates[which]) & (
                    share_passing(examined.spread, self._sightings.full[which], self.gates[which]) < CHANCE
                )
        return fits

    def open(self) -> bool:
        """Whether there is a pair with sightings enough, yet nothing connects its robots."""
        return any(len(rows) >= LEAST_SUPPORT and np.isnan(self.chi2[rows]).all() for rows in self.rows.values())

    def components(self) -> tuple[tuple[str, ...], ...]:
        """Robots connected by believed sightings, groups of two or more."""
        connected = [pair for pair, rows in self.rows.items() if self.believed[rows].any()]
        groups = _groups(self._maps, connected)
        return tuple(sorted({tuple(sorted(group)) for group in groups.values() if len(group) > 1}))

    def offsets(self) -> dict[Pair, UncertainPose]:
        """Where the frames of pairs that are joined directly lie: that of the second robot in that of the first."""
        offsets = {}
        joined = [pair for pair, rows in self.rows.items() if self.believed[rows].any()]
        for robots in self.components():
            inside = [pair for pair in joined if pair[0] in robots]
            frame, first = self._frames[robots[0]]
            ends = np.array([[first[a], first[b]] for a, b in inside]).T
            for pair, between, covariance in zip(inside, *frame.predict(*ends), strict=True):
                root_a, root_b = (gtsam.Pose2(*self._maps[robot].poses[0]) for robot in pair)
                pose = root_a.compose(gtsam.Pose2(*between)).compose(root_b.inverse())
                offsets[pair] = UncertainPose(pose, adjoint_transport(root_b, covariance))
        return offsets

    def _inside(self, robots: Sequence[str]) -> IntArray:
        """The sightings between any two of some robots, ascending."""
        inside = [rows for (a, b), rows in self.rows.items() if a in robots and b in robots]
        return np.sort(np.concatenate(inside))

    def _table(self, robots: Iterable[str]) -> dict[VertexId, int]:
        """The rows of the vertices of some robots one after the other."""
        return {v: row for row, v in enumerate(v for robot in robots for v in self._maps[robot].vertices)}

    def _among(self, robots: Sequence[str], rows: IntArray) -> Measurements:
        """Some sightings, for a table of the vertices of some robots one after the other."""
        place = np.full(len(self._poses), -1, np.int64)
        vertices = self._vertices(robots)
        place[vertices] = np.arange(len(vertices))
        return self._sightings.rows(rows).of_table(place)

    def _vertices(self, robots: Sequence[str]) -> IntArray:
        return np.concatenate([self._at[robot] for robot in robots])

    def _span(self, proposed: Mapping[Pair, Proposed], evidence: Evidence | None) -> list[Pair]:
        """Believe the strongest pairs as far as they make trees, and place their robots; the pairs left over.

        The local maps, which take long to answer, are asked about the pairs that would make the tree, and no other.
        """
        at = {robot: np.zeros(3) for robot in self._maps}
        groups = _groups(self._maps, [])
        closing: list[Pair] = []

        def weakness(pair: Pair) -> tuple[bool, int, Pair]:
            finding = self.findings[pair]
            best = finding.joined or next(iter(finding.sets), None)
            return finding.joined is None, finding.rival - (best.support if best else 0), pair

        queue = [(weakness(pair), evidence is None) for pair in self.findings]
        heapq.heapify(queue)
        while queue:
            (*_, (a, b)), asked = heapq.heappop(queue)
            finding = self.findings[a, b]
            if groups[a] is groups[b]:
                if finding.joined is not None:
                    closing.append((a, b))
                continue
            if not asked:
                before, finding = finding, find(proposed[a, b], evidence)
                self.findings[a, b] = finding
                if before.joined is not None and before.joined is not finding.joined:
                    heapq.heappush(queue, (weakness((a, b)), True))
                    continue
            if finding.joined is None:
                continue
            root, own = finding.root, self._maps[b]
            a_T_b = se2.compose(finding.joined.frame.poses[root], se2.inverse(own.poses[0]))
            shift = se2.compose(se2.compose(at[a], a_T_b), se2.inverse(at[b]))
            for robot in groups[b]:
                at[robot] = se2.compose(shift, at[robot])
            _unite(groups, a, b)
            self._believe((a, b))
        for robot, own in self._maps.items():
            self._poses[self._at[robot]] = se2.compose(at[robot], own.poses)
        return closing

    def _settle(self, closing: list[Pair]) -> None:
        """Take the pairs that close cycles, judge every sighting by the rest, and again until nothing changes.

        A closing pair has to fit the tree with at least half of its sightings: it is the weakest of its cycle.
        """
        self._solve()
        fits = self.chi2 < self.gates
        for pair in closing:
            joined = self.findings[pair].joined
            assert joined is not None
            if np.mean(fits[self.rows[pair][joined.members]]) >= 0.5:
                self._believe(pair)
            else:
                self.contradicting[pair] = outnumbers(self._weakest_way(pair), joined.support)
        for left in reversed(range(_ROUNDS)):
            self._solve()
            passed = (self.chi2 < self.gates) & (self._decidable | self.lifted)
            if left < _ROUNDS // 2:
                passed &= self.believed  # a set that flickers has to shrink, and so comes to rest
            if np.array_equal(passed, self.believed):
                return
            self.believed = passed
        self._solve()

    def _believe(self, pair: Pair) -> None:
        finding = self.findings[pair]
        assert finding.joined is not None
        rows = self.rows[pair][finding.joined.members]
        self.believed[rows], self.lifted[rows] = True, finding.lifted

    def _weakest_way(self, pair: Pair) -> int:
        """The least support on the best way between two robots through others."""
        edges = {p: int(np.count_nonzero(self.believed[rows])) for p, rows in self.rows.items() if p != pair}
        for least in sorted({support for support in edges.values() if support}, reverse=True):
            groups = _groups(self._maps, [p for p, support in edges.items() if support >= least])
            if groups[pair[0]] is groups[pair[1]]:
                return least
        return 0

    def _solve(self) -> None:
        """Solve every component, and examine every sighting within one."""
        self.chi2[:], self._decidable[:], self._frames = np.nan, False, {}
        for robots in self.components():
            which, vertices = self._inside(robots), self._vertices(robots)
            sightings, believed = self._among(robots, which), self.believed[which]
            try:
                frame = solve([self._maps[robot] for robot in robots], sightings, believed, self._poses[vertices])
                examined = examine(frame, sightings, believed)
            except np.linalg.LinAlgError:  # numbers beyond double precision: nothing can be said
                self.believed[which] = False
                continue
            self._poses[vertices] = frame.poses
            self.chi2[which] = examined.chi2
            self._decidable[which] = share_passing(examined.spread, sightings.full, self.gates[which]) < CHANCE
            first, row = {}, 0
            for robot in robots:
                first[robot], row = row, row + len(self._at[robot])
            self._frames |= dict.fromkeys(robots, (frame, first))


def _groups(robots: Mapping[str, object], connected: Sequence[Pair]) -> dict[str, set[str]]:
    """For each robot all it is connected with, the same set for all of them."""
    groups = {robot: {robot} for robot in robots}
    for a, b in connected:
        _unite(groups, a, b)
    return groups


def _unite(groups: dict[str, set[str]], a: str, b: str) -> None:
    if groups[a] is not groups[b]:
        groups[a] |= groups[b]
        for robot in groups[b]:
            groups[robot] = groups[a]
