"""What a joint map says in the end of every scan and every local map: where they lie, maps bent as all edges ask."""

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from factors import GraphEdge, VertexId
from frontend.local_map import LocalMap
from frontend.records import FloatArray
from mrtm.joint.alignment.aligner import Aligner
from mrtm.joint.bending import BentMap, Holding, bend
from mrtm.joint.joint_map import Component
from mrtm.result import Trajectory
from mrtm.team.member import MemberRun


def bent_maps(components: Sequence[Component], aligner: Aligner, runs: Sequence[MemberRun]) -> dict[VertexId, BentMap]:
    """Every vertex's map as it lies in its component's frame.

    An alignment holds where the two maps overlap; what a robot's own front end measured, where it went from one map
    into the other; what sightings tell is too weak to bend a map, and taken as of the origins.

    Args:
        components: joint graphs at their optimum.
        aligner: which made their alignments.
        runs: of all their robots.
    """
    maps = {vertex: local_map for run in runs for vertex, local_map in run.local_maps.items()}
    crossings = _crossings(runs, maps)
    overlaps = aligner.overlaps()

    def holding(edge: GraphEdge) -> Holding:
        return Holding(edge, *(overlaps.get(edge.id) or crossings.get((edge.tail, edge.head)) or ()))

    found: dict[VertexId, BentMap] = {}
    for component in components:
        graph = component.graph
        doubted = graph.doubted()
        believed = [holding(edge) for edge in graph.edges() if edge.id not in doubted]
        found |= bend(graph.estimates(), believed, {v: m.bends for v, m in maps.items() if len(m.bends.places)})
    return found


def trajectory(run: MemberRun, maps: Mapping[VertexId, BentMap]) -> Trajectory:
    """A robot's, through its bent maps."""
    poses = np.zeros((len(run.times), 3))
    for index in np.unique(run.vertices):
        inside = run.vertices == index
        poses[inside] = maps[VertexId(run.robot, int(index))].placed(run.poses[inside])
    return Trajectory(run.times, poses, run.vertices)


def map_poses(maps: Mapping[VertexId, BentMap], local_maps: Mapping[VertexId, LocalMap]) -> dict[VertexId, gtsam.Pose2]:
    """joint_T_local of each local map where it lies best as a whole: a grid is drawn rigid."""
    return {vertex: maps[vertex].rigid(local_map.poses) for vertex, local_map in local_maps.items()}


def _crossings(
    runs: Sequence[MemberRun], maps: Mapping[VertexId, LocalMap]
) -> dict[tuple[VertexId, VertexId], tuple[FloatArray, FloatArray]]:
    """Where robots went from one vertex's map into another's, or back: how that moves with the places of each."""
    found: dict[tuple[VertexId, VertexId], list[tuple[FloatArray, FloatArray]]] = {}
    for run in runs:
        for scan in np.flatnonzero(np.diff(run.vertices)).tolist():
            old, new = (VertexId(run.robot, int(run.vertices[at])) for at in (scan, scan + 1))
            if {old, new} <= maps.keys():
                at_old, at_new = (
                    maps[vertex].bends.following(run.poses[at : at + 1, :2])[0]
                    for vertex, at in ((old, scan), (new, scan + 1))
                )
                found.setdefault((old, new), []).append((at_old, at_new))
                found.setdefault((new, old), []).append((at_new, at_old))
    return {ends: (_mean(both, 0), _mean(both, 1)) for ends, both in found.items()}


def _mean(both: Sequence[tuple[FloatArray, FloatArray]], end: int) -> FloatArray:
    return np.asarray(np.mean([ends[end] for ends in both], axis=0))
