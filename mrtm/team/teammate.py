"""A robot among others: what it has recorded and heard, and the joint map it makes of that (M9 to M11)."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import gtsam
import numpy as np

from factors import (
    AnchoredSighting,
    Edge,
    EdgeId,
    EdgeKind,
    GraphEdge,
    Sighting,
    SightingEdge,
    UncertainPose,
    VertexId,
    fusing_edge,
)
from mrtm.config import TeamParameters
from mrtm.joint.consistency import Judgement, Verdict, judge
from mrtm.joint.hypotheses import Hypothesis, HypothesisId
from mrtm.joint.joint_map import JointMap
from mrtm.joint.map_evidence import MapEvidence
from mrtm.team.lookups import Lookups
from mrtm.team.records import AnchorRecord, EdgeRecord, Key, SightingRecord, VertexRecord
from mrtm.team.store import R, Store

Between = Edge | SightingEdge

WEAK = 100.0  # times the covariance of an offset that others have measured already


class Teammate:
    """What one robot knows, and what it makes of it: everything it concludes follows from the records it holds.

    Args:
        name: the robot; None for somebody who only listens.
        parameters: of the team.

    Attributes:
        store: the records.
        joint: the joint maps they lead to, as of the last ``think``.
        judgements: of the sightings, likewise.
    """

    def __init__(self, name: str | None, parameters: TeamParameters) -> None:
        self.name = name
        self.store = Store()
        self.joint = JointMap(name)
        self.judgements: Mapping[HypothesisId, Judgement] = {}
        self._parameters = parameters
        self._maps = Lookups(self.store)
        self._fusing: dict[EdgeId, Between] = {}
        self._told: dict[Key, int] = {}  # version of each record that the joint map knows

    def judgements_between(self, robots: tuple[str, str]) -> dict[HypothesisId, Judgement]:
        """The judgements of sightings between two robots."""
        between = [r for r in self.store.of(SightingRecord) if {r.observer, r.observed} == set(robots)]
        ids = [(r.observer, r.number) for r in between]
        return {key: self.judgements[key] for key in ids if key in self.judgements}

    def think(self) -> None:
        """Bring the joint map up to date with the records."""
        robots = {record.id.robot for record in self._news(VertexRecord)}
        self.joint.learn([record.edge for record in self._news(EdgeRecord)], robots)
        if [*self._news(AnchorRecord), *self._news(SightingRecord)]:
            self._join()

    def _news(self, kind: type[R]) -> list[R]:
        """Records of a type that the joint map does not know yet."""
        news = [r for r in self.store.of(kind) if self._told.get(r.key, -1) < r.version]
        self._told.update({r.key: r.version for r in news})
        return news

    def _join(self) -> None:
        """M11: judge all sightings anew, and let the accepted ones be the fusing edges."""
        hypotheses = {h.id: h for h in self._hypotheses()}
        graphs = self.joint.robots
        evidence = MapEvidence(self._maps, graphs)
        found = judge(hypotheses.values(), graphs, evidence)
        self.judgements = found.judgements
        believed: dict[tuple[VertexId, VertexId], list[AnchoredSighting]] = {}
        for key, judgement in self.judgements.items():
            if judgement.verdict is Verdict.ACCEPTED:
                h = hypotheses[key]
                ends = min(h.observer, h.observed), max(h.observer, h.observed)
                anchored = AnchoredSighting(h.sighting, h.observer, h.observed, h.tail_T_observer, h.head_T_observed)
                believed.setdefault(ends, []).append(anchored)
        fusing: dict[EdgeId, Between] = {}
        for ends, sightings in sorted(believed.items()):
            name = f"{ends[0]}-{ends[1]}"
            edge = fusing_edge(EdgeId(name, 0), 0, sightings)
            for new in [edge] if edge else [SightingEdge(EdgeId(name, n), 0, s) for n, s in enumerate(sightings, 1)]:
                fusing[new.id] = self._versioned(new)
        for bridge in self._bridges(found.offsets, fusing.values()):
            fusing[bridge.id] = self._versioned(bridge)
        self._fusing = fusing
        self.joint.join(fusing.values())

    def _versioned(self, edge: Between) -> Between:
        """The edge as a new version of the one that stands for it now, or that one if nothing has changed."""
        old = self._fusing.get(edge.id)
        if old is None:
            return edge
        return old if _same(old, edge) else replace(edge, version=old.version + 1)

    def _bridges(self, offsets: Mapping[tuple[str, str], UncertainPose], edges: Iterable[GraphEdge]) -> Iterable[Edge]:
        """Edges between the roots of robots that only ranges and bearings join, for these to start from.

        The offset comes from the same sightings, so it gets next to no weight.
        """
        direct = {frozenset((e.tail.robot, e.head.robot)) for e in edges if e.estimate is not None}
        for (a, b), offset in offsets.items():
            if frozenset((a, b)) not in direct:
                name = EdgeId(f"{a}-{b}", 0)
                covariance = WEAK * offset.covariance
                yield Edge(name, 0, EdgeKind.FUSING, VertexId(a, 0), VertexId(b, 0), offset.pose, covariance)

    def _hypotheses(self) -> Iterable[Hypothesis]:
        """The sightings that have both ends: where both robots were, in vertices that the joint map knows."""
        anchors = {(r.robot, r.number): r for r in self.store.of(AnchorRecord)}
        known = {robot: set(graph.vertices()) for robot, graph in self.joint.robots.items()}
        for record in self.store.of(SightingRecord):
            observer, observed = anchors.get(record.observer_anchor), anchors.get(record.observed_anchor)
            if observer is None or observed is None:
                continue
            if any(a.vertex not in known.get(a.vertex.robot, ()) for a in (observer, observed)):
                continue
            yield Hypothesis(
                (record.observer, record.number),
                observer.vertex,
                observed.vertex,
                _widened(record.measurement, self._parameters),
                observer.pose,
                observed.pose,
            )


def _widened(sighting: Sighting, parameters: TeamParameters) -> Sighting:
    """A sighting with what its sensor does not know of itself: bad timing, poses between scans."""
    xy, theta = parameters.sighting_xy, parameters.sighting_theta
    heading = sighting.sigma_heading
    return replace(
        sighting,
        sigma_range=float(np.hypot(sighting.sigma_range, xy)),
        sigma_bearing=float(np.hypot(sighting.sigma_bearing, xy / max(sighting.range, xy))),
        sigma_heading=None if heading is None else float(np.hypot(heading, theta)),
    )


def _same(a: GraphEdge, b: GraphEdge) -> bool:
    """Whether two versions of an edge say the same."""
    here = gtsam.Pose2()
    close = np.allclose(a.residual(here)[0], b.residual(here)[0], rtol=0.0, atol=1e-12)
    return close and np.allclose(a.covariance, b.covariance, rtol=1e-9, atol=0.0)
