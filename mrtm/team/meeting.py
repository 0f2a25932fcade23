"""M11: from the records of sightings to the edges between robots."""

from collections.abc import Iterable, Mapping
from functools import lru_cache

import numpy as np

from factors import (
    AnchoredSighting,
    Edge,
    EdgeId,
    EdgeKind,
    GraphEdge,
    SightingEdge,
    UncertainPose,
    VertexId,
    fusing_edge,
)
from mrtm.joint.graph import JointGraph
from mrtm.joint.sightings.hypotheses import KEPT, Hypothesis, Slack
from mrtm.team.records import AnchorRecord, SightingRecord
from mrtm.team.store import Store

WEAK = 100.0  # times the covariance of an offset that others have measured already


def sightings(store: Store, graphs: Mapping[str, JointGraph]) -> list[Hypothesis]:
    """The sightings that have both ends: where both robots were, in vertices that the robots' graphs know."""
    anchors = {(r.robot, r.number): r for r in store.of(AnchorRecord)}
    known = {vertex for graph in graphs.values() for vertex in graph.vertices()}
    found = []
    for record in store.of(SightingRecord):
        observer, observed = anchors.get(record.observer_anchor), anchors.get(record.observed_anchor)
        if observer and observed and observer.vertex in known and observed.vertex in known:
            found.append(_hypothesis(record, observer, observed))
    return found


@lru_cache(KEPT)
def _hypothesis(record: SightingRecord, observer: AnchorRecord, observed: AnchorRecord) -> Hypothesis:
    """One object for the same records, whoever holds them: what follows from it need not be found again."""
    name = record.observer, record.number
    return Hypothesis(name, observer.vertex, observed.vertex, record.measurement, observer.pose, observed.pose)


@lru_cache(KEPT)
def anchored(hypothesis: Hypothesis, slack: Slack) -> AnchoredSighting:
    """A believed sighting for fusing; both robots' poses have the ``slack`` that all sightings turned out to need."""
    more = np.diag([slack.xy, slack.xy, slack.theta]) ** 2
    observer, observed = (
        UncertainPose(pose, covariance + more)
        for pose, covariance in (hypothesis.tail_T_observer, hypothesis.head_T_observed)
    )
    return AnchoredSighting(hypothesis.sighting, hypothesis.observer, hypothesis.observed, observer, observed)


def fusing_edges(believed: Iterable[AnchoredSighting]) -> list[Edge | SightingEdge]:
    """One edge for each pair of vertices; where its sightings do not fix the pose, one for each of these."""
    pairs: dict[tuple[VertexId, VertexId], list[AnchoredSighting]] = {}
    for sighting in believed:
        ends = sighting.observer_vertex, sighting.observed_vertex
        pairs.setdefault((min(ends), max(ends)), []).append(sighting)
    edges: list[Edge | SightingEdge] = []
    for (tail, head), between in sorted(pairs.items()):
        edges.extend(_between(tail, head, tuple(between)))
    return edges


@lru_cache(KEPT)
def _between(tail: VertexId, head: VertexId, sightings: tuple[AnchoredSighting, ...]) -> list[Edge | SightingEdge]:
    name = f"{tail}-{head}"
    edge = fusing_edge(EdgeId(name, 0), 0, sightings)
    if edge is not None:
        return [edge]
    # One with a heading that yet fixes no pose comes from where a robot hardly knew its own: it adds nothing.
    alone = [(n, s) for n, s in enumerate(sightings, 1) if s.sighting.heading is None]
    return [SightingEdge(EdgeId(name, n), 0, s) for n, s in alone]


def bridges(offsets: Mapping[tuple[str, str], UncertainPose], edges: Iterable[GraphEdge]) -> list[Edge]:
    """Edges between the roots of robots that only ranges and bearings join, for these to start from.

    The offset comes from the same sightings, so it gets next to no weight.
    """
    direct = {frozenset((e.tail.robot, e.head.robot)) for e in edges if e.estimate is not None}
    return [
        Edge(
            EdgeId(f"{VertexId(a, 0)}-{VertexId(b, 0)}", 0), 0, EdgeKind.FUSING,
            VertexId(a, 0), VertexId(b, 0), offset.pose, WEAK * offset.covariance,
        )
        for (a, b), offset in offsets.items()
        if frozenset((a, b)) not in direct
    ]  # fmt: skip
