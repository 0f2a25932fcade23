"""A robot among others: what it has recorded and heard, and the joint map it makes of that (M9 to M13)."""

from collections.abc import Mapping
from dataclasses import replace

import gtsam
import numpy as np

from factors import Edge, EdgeId, GraphEdge, SightingEdge
from mrtm.config import Config
from mrtm.joint.alignment.aligner import Aligner
from mrtm.joint.joint_map import Component, JointMap
from mrtm.joint.sightings.consistency import Judgement, Verdict, judge
from mrtm.joint.sightings.hypotheses import HypothesisId
from mrtm.team.evidence import evidence
from mrtm.team.meeting import anchored, bridges, fusing_edges, sightings
from mrtm.team.records import EdgeRecord, Key, Kind, Record, SightingRecord, VertexRecord
from mrtm.team.store import R, Store
from mrtm.team.surfaces import Surfaces
from mrtm.timing import Stages

_Conclusion = tuple[Mapping[HypothesisId, Judgement], list[Edge | SightingEdge]]

KEPT = 8  # conclusions


class Peers:
    """What robots that are played together share, as long as they hold the same records: they need not all work it out.

    Attributes:
        concluded: what sightings come to, by the hash of the store.
        settled: what all comes to, likewise.
    """

    def __init__(self) -> None:
        self.concluded: dict[bytes, _Conclusion] = {}
        self.settled: dict[bytes, Teammate] = {}


GROWN = 1.1  # times as much is known,
SEEN = 1.2  # or as many sightings: in a crowd they multiply faster than all else

ROUNDS = 10  # of alignments until the estimate has come to rest, at most


class Teammate:
    """What one robot knows, and what it makes of it: everything it concludes follows from the records it holds.

    On the way it keeps what it has concluded, and so what it makes of the same records depends, within the noise, on
    the order in which they came. ``settle`` ends that.

    Args:
        name: the robot; None for somebody who only listens.
        config: of the run.
        stages: counts the time of every stage.
        peers: those it is played with.
        store: what it knows already.

    Attributes:
        store: the records.
        joint: the joint maps they lead to, as of the last ``think``.
        judgements: of the sightings, likewise.
        aligner: the alignments of maps, likewise.
    """

    def __init__(
        self, name: str | None, config: Config, stages: Stages, peers: Peers, store: Store | None = None
    ) -> None:
        self.name = name
        self.store = Store() if store is None else store
        self.joint = JointMap()
        self.judgements: Mapping[HypothesisId, Judgement] = {}
        self.aligner = Aligner()
        self._config = config
        self._stages = stages
        self._peers = peers
        self._maps = Surfaces(self.store)
        self._found: dict[EdgeId, Edge | SightingEdge] = {}  # what the sightings last came to,
        self._fusing: dict[EdgeId, Edge | SightingEdge] = {}  # and these as versions
        self._told: dict[Key, Record] = {}  # what the joint map knows
        self._held = b""  # the hash of what was known when sightings were last judged
        self._thought = 0, 0  # how many records, and sightings, were known at the last ``think``

    def judgements_between(self, robots: tuple[str, str]) -> dict[HypothesisId, Judgement]:
        """The judgements of sightings between two robots."""
        seen = (item.record for robot in robots for item in self.store.run(robot, Kind.SIGHTING))
        between = (r for r in seen if isinstance(r, SightingRecord) and r.observed in robots)
        ids = ((r.observer, r.number) for r in between)
        return {key: self.judgements[key] for key in ids if key in self.judgements}

    def is_due(self) -> bool:
        """Whether there are GROWN times as many records, or SEEN times as many sightings, as at the last ``think``.

        Who thinks only then spends on all the thinking about a growing store a fixed number of times the last.
        """
        sizes = zip((GROWN, SEEN), self._size(), self._thought, strict=True)
        return any(now >= times * max(before, 1) for times, now, before in sizes)

    def learn(self) -> None:
        """Bring the robots' own maps up to date with the records, and the joint map with these."""
        self._hear()
        self._enter()

    def think(self) -> None:
        """Bring the joint map up to date with the records."""
        self._thought = self._size()
        self._hear()
        if self.store.summary() != self._held:
            self._fuse()

    def _hear(self) -> None:
        """Bring the robots' own maps up to date with the records."""
        vertices, edges = self._news(VertexRecord), self._news(EdgeRecord)
        with self._stages("joint map"):
            self.joint.learn((record.edge for record in edges), {record.id.robot for record in vertices})
        self._told |= {record.key: record for record in vertices}
        self._told |= {record.key: record for record in edges}

    def _size(self) -> tuple[int, int]:
        return len(self.store), self.store.count(SightingRecord)

    def settle(self) -> None:
        """``think`` and ``align`` anew, from the records alone; with this the robot is at its end.

        Whoever holds the same records comes to the same, which they share.
        """
        held = self.store.summary()
        if held not in self._peers.settled:
            fresh = Teammate(None, self._config, self._stages, Peers(), self.store)
            fresh.think()
            fresh.align(ROUNDS)
            with self._stages("joint map"):
                for component in fresh.joint.components():
                    component.graph.optimize_fully()
            self._peers.settled[held] = fresh
        settled = self._peers.settled[held]
        self.joint, self.judgements, self.aligner = settled.joint, settled.judgements, settled.aligner

    def align(self, rounds: int = 1) -> None:
        """M13, on line: align the maps of the components that are due, in so many rounds at most."""
        most = self._config.joint.alignments
        for _ in range(rounds if most else 0):
            with self._stages("alignment"):
                tried = [self.aligner.look(c.graph, self._maps, most) for c in self._components()]
            if any(tried):
                self._enter()
            with self._stages("alignment"):
                gone = [edge for c in self._components() for edge in self.aligner.take_back(c.graph)]
            if gone:
                self._enter()
            if not any(tried):
                return

    def _components(self) -> list[Component]:
        """Those to care for: the robot's own, or all."""
        everything = self.joint.components()
        return [c for c in everything if self.name is None or self.name in c.robots]

    def _news(self, kind: type[R]) -> list[R]:
        """Records of a type that the joint map does not know yet."""
        return [record for record in self.store.of(kind) if self._told.get(record.key) is not record]

    def _fuse(self) -> None:
        """M11: judge all sightings anew, and let the accepted ones be the fusing edges."""
        with self._stages("judging"):
            held = self.store.summary()
            concluded = self._peers.concluded
            if held not in concluded:
                concluded[held] = self._conclude()
                while len(concluded) > KEPT:
                    del concluded[next(iter(concluded))]
            self.judgements, edges = concluded[held]
            self._held = held
        self._fusing = {edge.id: self._versioned(edge) for edge in edges}
        self._found = {edge.id: edge for edge in edges}
        self._enter()

    def _conclude(self) -> "_Conclusion":
        """What the records say of the sightings, and the edges between robots that follow."""
        graphs = self.joint.robots
        found = {hypothesis.id: hypothesis for hypothesis in sightings(self.store, graphs)}
        consistency = judge(found.values(), graphs, evidence(self._maps, graphs))
        believed = [found[key] for key, j in consistency.judgements.items() if j.verdict is Verdict.ACCEPTED]
        edges = fusing_edges(anchored(hypothesis, consistency.slack) for hypothesis in believed)
        return consistency.judgements, [*edges, *bridges(consistency.offsets, edges)]

    def _versioned(self, edge: Edge | SightingEdge) -> Edge | SightingEdge:
        """The edge as a new version of the one that stands for it now, or that one if nothing has changed."""
        old = self._fusing.get(edge.id)
        if old is None:
            return edge
        return old if self._found[edge.id] is edge or _same(old, edge) else replace(edge, version=old.version + 1)

    def _enter(self) -> None:
        """Let the fusing edges, and the alignments within what they join, be what the joint map holds."""
        together = self.joint.connected(self._fusing.values())
        self.aligner.keep_within(together)
        with self._stages("joint map"):
            self.joint.join([*self._fusing.values(), *self.aligner.edges()])


def _same(a: GraphEdge, b: GraphEdge) -> bool:
    """Whether two versions of an edge say the same."""
    here = gtsam.Pose2()
    close = np.allclose(a.residual(here)[0], b.residual(here)[0], rtol=0.0, atol=1e-12)
    return bool(close and np.allclose(a.covariance, b.covariance, rtol=1e-9, atol=0.0))
