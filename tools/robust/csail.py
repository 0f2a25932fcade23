"""The public two-robot set of MIT CSAIL: odometry of both, 128 closures between their poses, and 250 false ones."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from factors import Edge, EdgeId, EdgeKind, VertexId
from frontend.records import FloatArray
from tools.robust.problem import Claim, Problem

FOLDER = Path("posegraphs", "csail_2robots")

_SECOND = 523  # the second robot's first pose


def csail(data: Path) -> Problem:
    """What both robots measured, with the false closures.

    Args:
        data: a folder in which FOLDER is.

    Raises:
        OSError: a file cannot be read.
    """
    folder = data / FOLDER
    way = [
        Edge(EdgeId(tail.robot, head.number), 0, EdgeKind.INTER_VERTEX, tail, head, pose, covariance)
        for name in ("CSAIL_robot1.g2o", "CSAIL_robot2.g2o")
        for tail, head, pose, covariance in _read(folder / name)
    ]
    true = {(tail, head) for tail, head, *_ in _read(folder / "CSAIL_interrobot_loop_closures.g2o")}
    claims = [
        Claim(
            max(tail.number, head.number),
            EdgeKind.LOOP if tail.robot == head.robot else EdgeKind.FUSING,
            tail, head, pose, covariance, (tail, head) in true,
        )
        for tail, head, pose, covariance in _read(folder / "CSAIL_interrobot_loop_closures_outliers.g2o")
    ]  # fmt: skip
    return replace(Problem(way, [], None), claims=sorted(claims, key=lambda claim: claim.step))


def _read(path: Path) -> Iterator[tuple[VertexId, VertexId, gtsam.Pose2, FloatArray]]:
    """Tail, head, tail_T_head and its (3, 3) covariance of every edge."""
    for words in map(str.split, path.read_text(encoding="ascii").splitlines()):
        if words and words[0] == "EDGE_SE2":
            x, y, theta, *upper = map(float, words[3:12])
            information = np.zeros((3, 3))
            information[np.triu_indices(3)] = upper
            information += np.triu(information, 1).T
            covariance = np.asarray(np.linalg.inv(information), np.float64)
            yield _vertex(int(words[1])), _vertex(int(words[2])), gtsam.Pose2(x, y, theta), covariance


def _vertex(number: int) -> VertexId:
    return VertexId("one", number) if number < _SECOND else VertexId("two", number - _SECOND)
