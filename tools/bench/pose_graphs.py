"""The public pose graphs of the back end's benchmark: M3500 and city10000, as edges of the joint graph."""

import lzma
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from factors import Edge, EdgeId, EdgeKind, VertexId
from frontend.records import FloatArray

ROBOT = "robot"
_EDGES = ("EDGE_SE2", "EDGE2")  # g2o's name and iSAM's; the order of the information's numbers is the same
_FILES = {
    "M3500": ("input_M3500_g2o.g2o.xz", None),
    "city10000": ("isam_city10000.txt.xz", "city10000_groundtruth.txt.xz"),
}


@dataclass(frozen=True, slots=True)
class PoseGraph:
    """A pose graph in the order in which a robot would have made it.

    Attributes:
        name: by which it is known.
        edges: every edge once both its poses are there, that to the pose before first; loops are of kind LOOP.
        truth: (n, 3) pose 0_T_pose; None if it is not known.
    """

    name: str
    edges: list[Edge]
    truth: FloatArray | None


def find_pose_graphs(directories: Sequence[Path], poses: int | None = None) -> list[PoseGraph]:
    """Those that are in a folder ``posegraphs`` of one of the directories.

    Args:
        poses: of each, so many; all if not given.
    """
    found = []
    for name, (measured, true) in _FILES.items():
        folder = next((d / "posegraphs" for d in directories if (d / "posegraphs" / measured).exists()), None)
        if folder is not None:
            edges = _ordered(_read(folder / measured), poses)
            truth = None if true is None else _chained(_read(folder / true))[:poses]
            found.append(PoseGraph(name, edges, truth))
    return found


def _read(path: Path) -> Iterator[tuple[int, int, gtsam.Pose2, FloatArray]]:
    """Tail, head, tail_T_head and its (3, 3) information of every edge."""
    with lzma.open(path, "rt", encoding="ascii") as stream:
        for words in map(str.split, stream):
            if words and words[0] in _EDGES:
                x, y, theta, *upper = map(float, words[3:12])
                information = np.zeros((3, 3))
                information[np.triu_indices(3)] = upper
                information += np.triu(information, 1).T
                yield int(words[1]), int(words[2]), gtsam.Pose2(x, y, theta), information


def _ordered(rows: Iterator[tuple[int, int, gtsam.Pose2, FloatArray]], poses: int | None) -> list[Edge]:
    kept = [row for row in rows if poses is None or max(row[:2]) < poses]
    kept.sort(key=lambda row: (max(row[:2]), -min(row[:2])))
    return [
        Edge(
            EdgeId(ROBOT, number),
            0,
            EdgeKind.INTER_VERTEX if abs(head - tail) == 1 else EdgeKind.LOOP,
            VertexId(ROBOT, tail),
            VertexId(ROBOT, head),
            measured,
            np.linalg.inv(information).astype(np.float64),
        )
        for number, (tail, head, measured, information) in enumerate(kept)
    ]


def _chained(rows: Iterator[tuple[int, int, gtsam.Pose2, FloatArray]]) -> FloatArray:
    poses = {0: gtsam.Pose2()}
    for tail, head, step, _ in rows:
        if head == tail + 1:
            poses[head] = poses[tail].compose(step)
    return np.array([[pose.x(), pose.y(), pose.theta()] for _, pose in sorted(poses.items())])
