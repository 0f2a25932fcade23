"""The back end by itself: public pose graphs fed edge by edge, beside bare iSAM2 and a batch solve."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import gtsam
import numpy as np

from factors import Edge, EdgeKind, VertexId, factor_of, prior_factor, without_kernel
from frontend.records import FloatArray
from mrtm.evaluation import TimedPoses, evaluate_ate
from mrtm.joint.equations import misfit
from mrtm.joint.graph import JointGraph
from tools.bench.machine import Setting
from tools.bench.pose_graphs import ROBOT, PoseGraph
from tools.bench.table import markdown

CHECKS = 20
"""Times at which the estimate is compared with the optimum of what is in the graph by then."""


class Backend(Protocol):
    """Takes edges one by one."""

    def add(self, edge: Edge) -> None:
        """Take an edge, and have the estimate of its head ready."""

    def values(self) -> gtsam.Values:
        """The estimate of every pose, by index."""


class BareIsam:
    """GTSAM's iSAM2 as it comes, without kernels."""

    def __init__(self) -> None:
        self._isam = gtsam.ISAM2(gtsam.ISAM2Params())
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.push_back(prior_factor(0, gtsam.Pose2()))
        values.insert(0, gtsam.Pose2())
        self._isam.update(graph, values)
        self._poses = 1

    def add(self, edge: Edge) -> None:
        """See ``Backend``."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.push_back(_factor(edge))
        if edge.head.number == self._poses:
            before = self._isam.calculateEstimatePose2(edge.tail.number)
            values.insert(edge.head.number, before.compose(edge.measurement))
            self._poses += 1
        self._isam.update(graph, values)
        self._isam.calculateEstimatePose2(edge.head.number)

    def values(self) -> gtsam.Values:
        """See ``Backend``."""
        return self._isam.calculateEstimate()


class Joint:
    """The project's joint graph.

    Args:
        robust: loops come under their kernel; else they are taken for edges that cannot be false.
    """

    def __init__(self, robust: bool) -> None:
        self._graph = JointGraph(VertexId(ROBOT, 0))
        self._robust = robust

    def add(self, edge: Edge) -> None:
        """See ``Backend``."""
        self._graph.update(add=[edge if self._robust else replace(edge, kind=EdgeKind.INTER_VERTEX)])
        self._graph.estimate(edge.head)

    def values(self) -> gtsam.Values:
        """See ``Backend``."""
        values = gtsam.Values()
        for vertex, pose in self._graph.estimates().items():
            values.insert(vertex.number, pose)
        return values


BACKENDS: dict[str, Callable[[], Backend]] = {
    "bare iSAM2": BareIsam,
    "joint graph, no kernels": lambda: Joint(robust=False),
    "joint graph": lambda: Joint(robust=True),
}


@dataclass(frozen=True, slots=True)
class Fed:
    """A graph fed to a back end.

    Attributes:
        name: of the back end.
        seconds: (n,) processor time of every step, one edge each; of a batch solve, its one.
        cost: at the end, half the sum of chi2 of all edges and the prior, without kernels.
        gap: metres, the largest distance of any pose from the optimum at the end; ``worst_gap``: at any check.
        ate: metres, RMSE against the truth; None if that is not known.
    """

    name: str
    seconds: FloatArray
    cost: float
    gap: float
    worst_gap: float
    ate: float | None


def feed(graph: PoseGraph, name: str, tell: Callable[[str], None]) -> Fed:
    """Feed a graph to the back end ``name``, edge by edge."""
    backend = BACKENDS[name]()
    misfit(graph.edges[0], gtsam.Pose2(), gtsam.Pose2())  # its kernel is read before the clock starts
    everything = _problem([])
    seconds, gaps = [], []
    every = -(-len(graph.edges) // CHECKS)
    for number, edge in enumerate(graph.edges, 1):
        started = time.process_time()
        backend.add(edge)
        seconds.append(time.process_time() - started)
        everything.push_back(_factor(edge))
        if number % every == 0 or number == len(graph.edges):
            found = backend.values()
            gaps.append(_apart(found, _polished(everything, found)))
            tell(f"{graph.name}, {name}: {number} of {len(graph.edges)} edges, {sum(seconds):.1f} s")
    return Fed(name, np.array(seconds), everything.error(found), gaps[-1], max(gaps), _ate(graph, found))


def solve(graph: PoseGraph) -> Fed:
    """All at once: orientations first (LAGO), then Levenberg-Marquardt."""
    problem = _problem(graph.edges)
    started = time.process_time()
    found = gtsam.LevenbergMarquardtOptimizer(problem, gtsam.lago.initialize(problem)).optimize()
    seconds = time.process_time() - started
    gap = _apart(found, _polished(problem, found))
    return Fed("batch", np.array([seconds]), problem.error(found), gap, gap, _ate(graph, found))


def backend_report(graphs: Sequence[tuple[PoseGraph, Sequence[Fed]]], setting: Setting, note: str, picture: str) -> str:
    """The table as Markdown."""
    lines = ["# The back end at scale", "", *([f"**{note}**", ""] if note else []), *setting.lines()]
    lines += [
        "- a step is one edge: update, and the estimate of its pose; processor time; bare iSAM2 has GTSAM's default "
        "parameters",
        "- cost is without kernels, for all alike; gap is the distance of the worst pose from the optimum of the edges "
        f"that are in, at the end and at the worst of {CHECKS} checks on the way",
        "",
        f"![time of every step]({picture})",
        "",
    ]
    header = (
        "back end", "mean, ms", "p99, ms", "worst, ms", "all, s", "cost", "gap at the end, mm", "worst gap, mm",
        "ATE, m",
    )  # fmt: skip
    for graph, fed in graphs:
        poses = 1 + sum(edge.kind is EdgeKind.INTER_VERTEX for edge in graph.edges)
        lines += [f"## {graph.name}: {poses} poses, {len(graph.edges)} edges", ""]
        rows = [
            [
                f.name,
                *(f"{1e3 * t:.2f}" for t in (f.seconds.mean(), np.percentile(f.seconds, 99), f.seconds.max())),
                f"{f.seconds.sum():.1f}",
                f"{f.cost:.3f}",
                f"{1e3 * f.gap:.2f}",
                f"{1e3 * f.worst_gap:.2f}",
                "" if f.ate is None else f"{f.ate:.3f}",
            ]
            for f in fed
        ]
        lines += [*markdown(header, rows), ""]
    return "\n".join(lines)


def _factor(edge: Edge) -> gtsam.NoiseModelFactor:
    return without_kernel(factor_of(edge, edge.tail.number, edge.head.number))


def _problem(edges: Sequence[Edge]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(prior_factor(0, gtsam.Pose2()))
    for edge in edges:
        graph.push_back(_factor(edge))
    return graph


def _polished(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    """The optimum near a start that is almost there."""
    params = gtsam.GaussNewtonParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(1e-12)
    return gtsam.GaussNewtonOptimizer(graph, start, params).optimize()


def _positions(values: gtsam.Values) -> FloatArray:
    return np.array([values.atPose2(key).translation() for key in range(values.size())])


def _apart(a: gtsam.Values, b: gtsam.Values) -> float:
    return float(np.hypot(*(_positions(a) - _positions(b)).T).max())


def _ate(graph: PoseGraph, values: gtsam.Values) -> float | None:
    if graph.truth is None:
        return None
    times = np.arange(values.size(), dtype=np.float64)
    poses = [values.atPose2(key) for key in range(values.size())]
    found = TimedPoses(times, np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses]))
    return evaluate_ate({ROBOT: TimedPoses(times, graph.truth)}, {ROBOT: found}).translation.rmse
