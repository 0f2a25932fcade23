"""The three ways from the same local maps to a joint map."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors import Edge, EdgeKind, GraphEdge, VertexId
from mrtm.joint.em import optimise
from mrtm.joint.tree import tree_poses
from mrtm.moving import moved
from mrtm.progress import Progress
from mrtm.result import Latency, RunResult

PAPER_EDGES = frozenset(EdgeKind) - {EdgeKind.ALIGNMENT}
"""The kinds of edges that the paper's robots have when M13 begins. Alignments are the on-line form of M13 itself."""

ON_LINE_STAGES = ("joint map", "alignment")
"""What of a run's time is optimisation; which sightings to believe (M11) has to be judged whatever comes after."""


@dataclass(frozen=True, slots=True)
class Way:
    """A joint map made one way.

    Attributes:
        name: "tree only", "off-line EM" or "on line".
        result: the run, with the vertex poses, trajectories and edges of this way; ``vertex_covariances`` are those of
            the on-line way or none.
        seconds: of optimisation, once, from all local maps and edges: what one who hears all needs at the end.
        updates: how often robots brought their joint maps up to date in the whole run.
        over_run: seconds of optimisation for all of these updates; of the EM estimated, in proportion to the maps that
            were known at each.
        longest: seconds of the longest single step, for which a robot that needs the map has to wait.
        available: team time since when there is such a map, in words.
    """

    name: str
    result: RunResult
    seconds: float
    updates: int
    over_run: float
    longest: float
    available: str


def three_ways(result: RunResult, progress: Progress) -> tuple[Way, Way, Way]:
    """Tree only (before optimisation, the paper's Fig. 4a), off-line EM (M13, Fig. 4b) and on line, in this order."""
    since = "from 0 s on"
    if result.team is not None and result.team.common_frame is not None:
        since = f"from {result.team.common_frame:.0f} s on"
    tree: dict[VertexId, gtsam.Pose2] = {}
    em: dict[VertexId, gtsam.Pose2] = {}
    tree_seconds = em_seconds = 0.0
    for number, component in enumerate(result.components):
        root, joint = component[0], result.vertex_poses[component[0]]
        edges = _paper_edges(result, component)
        started = time.perf_counter()
        poses = tree_poses(edges, root)
        tree_seconds += time.perf_counter() - started
        tree |= {v: joint.compose(pose) for v, pose in poses.items()}

        def report(fraction: float, doing: str, done: int = number) -> None:
            progress((done + fraction) / len(result.components), doing)

        found = optimise({v: result.local_maps[v] for v in component if v in result.local_maps}, edges, root, report)
        em_seconds += found.seconds
        em |= {v: joint.compose(pose) for v, pose in found.poses.items()}
    # The robots' clock stops for the off-line optimisation: it is one step.
    off_line = f"{em_seconds:.2f} s after the end"
    paper = replace(result, edges=[fate for fate in result.edges if fate.edge.kind in PAPER_EDGES])
    updates = [latency for latency in result.latencies if latency.robot is not None]
    shares = sum(latency.vertices for latency in updates) / max(1, sum(map(len, result.components)))
    on_line = [_optimising(latency) for latency in updates]
    once = sum(_optimising(latency) for latency in result.latencies if latency.robot is None)
    n = len(updates)
    return (
        Way("tree only", moved(paper, tree), tree_seconds, n, shares * tree_seconds, tree_seconds, since),
        Way("off-line EM", moved(paper, em), em_seconds, n, shares * em_seconds, em_seconds, off_line),
        Way("on line", result, once, n, sum(on_line), max(on_line, default=once), since),
    )


def _optimising(latency: Latency) -> float:
    return sum(latency.seconds.get(stage, 0.0) for stage in ON_LINE_STAGES)


def _paper_edges(result: RunResult, component: Sequence[VertexId]) -> list[GraphEdge]:
    """The accepted edges of a component that M13 starts from, so completed that they reach all of it.

    M11 inserts a transformation between two robots. Where they only have sightings without a heading, none of which is
    one, the joint estimate lends what M11 would need: the transformation along one of these sightings.
    """
    inside = set(component)
    accepted = [fate.edge for fate in result.edges if fate.fate == "accepted" and fate.edge.tail in inside]
    edges = [edge for edge in accepted if edge.kind in PAPER_EDGES]
    while len(reached := tree_poses(edges, component[0])) < len(component):
        bridge = next((edge for edge in accepted if (edge.tail in reached) != (edge.head in reached)), None)
        if bridge is None:
            raise ValueError(f"no edge joins {min(inside - reached.keys())} to the rest of its component")
        tail_T_head = result.vertex_poses[bridge.tail].between(result.vertex_poses[bridge.head])
        edges.append(Edge(bridge.id, bridge.version, EdgeKind.FUSING, bridge.tail, bridge.head, tail_T_head, np.eye(3)))
    return edges
