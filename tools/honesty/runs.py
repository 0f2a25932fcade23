"""One run: a simulated building or a real log through the pipeline, and what it says about its own covariances."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from factors import EdgeKind, VertexId
from frontend import se2
from frontend.readers import open_log
from frontend.records import FloatArray
from mrtm.config import load_config
from mrtm.evaluation.ate import evaluate_ate
from mrtm.evaluation.nees import nees
from mrtm.evaluation.trajectory import TimedPoses
from mrtm.result import Event, RunResult
from mrtm.session import map_scans
from tools.simulation import BUILDINGS, OdometryNoise, simulate

VERTEX = "joint vertex"
ENTERING = "loop at entering"
JUST = 2
"""A filter that resampled at one of its last so many key scans had just resampled."""

FALSE_METRES = 0.5
FALSE_SIGMAS, FALSE_LEAST = 5.0, 0.2
"""A loop is false if it is off by FALSE_METRES, or by FALSE_SIGMAS (root of the squared Mahalanobis distance) and
FALSE_LEAST metres: a slight error of a far too small covariance is dishonest, not false."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One measured or estimated transform, and its truth.

    Attributes:
        plan: building.
        seed: of the building, the drive, the noise and the filter.
        kind: type of factor, ``VERTEX``, or ``ENTERING``: a loop edge before the visit it began is over.
        name: in words.
        true: (3,) parent_T_child.
        measured: (3,) the same as the run has it.
        covariance: (3, 3), in the frame of the child.
        heading: of the child in the plan, radians.
        since_resampling: key scans of the filter since its last resampling when the edge was made; None for a vertex.
    """

    plan: str
    seed: int
    kind: str
    name: str
    true: FloatArray
    measured: FloatArray
    covariance: FloatArray
    heading: float
    since_resampling: int | None = None

    @property
    def error(self) -> FloatArray:
        """(3,) ``Log(true^-1 * measured)``, in the frame of the child."""
        return se2.log(se2.between(self.true, self.measured))

    @property
    def nees(self) -> float:
        """``e' inv(P) e / 3``."""
        return float(nees(self.true[None], self.measured[None], self.covariance[None])[0])

    @property
    def distance(self) -> float:
        """Metres off."""
        return float(np.hypot(*self.error[:2]))

    @property
    def is_false(self) -> bool:
        """Whether this, as a loop, is not just inexact but wrong."""
        sigmas = np.sqrt(3.0 * self.nees)
        return self.distance > FALSE_METRES or bool(sigmas > FALSE_SIGMAS and self.distance > FALSE_LEAST)


@dataclass(frozen=True, slots=True)
class Innovation:
    """How far a measurement was from what the map expected, as the run itself sees it.

    Attributes:
        source: building or log.
        seed: of the run.
        kind: kind of the event.
        offset: (3,) metres, metres, radians.
        normalised: squared Mahalanobis distance over 3.
    """

    source: str
    seed: int
    kind: str
    offset: FloatArray
    normalised: float


@dataclass(frozen=True, slots=True)
class Honesty:
    """What one run says about its covariances. ``ate`` is the RMSE in metres, NaN where the truth is not known."""

    source: str
    seed: int
    ate: float
    samples: list[Sample]
    innovations: list[Innovation]


def simulated(plan: str, seed: int, laps: int, options: Sequence[str] = ()) -> Honesty:
    """Build, drive and map one building.

    Args:
        plan: name of a building of the simulator, or name/route; else its first route is driven.
        seed: of everything.
        laps: times the route is driven, if it is closed; else once.
        options: of the configuration, ``section.key=value``.
    """
    name, _, route = plan.partition("/")
    building = BUILDINGS[name](seed)
    route = route or next(iter(building.routes))
    points = building.route(route)
    closed = np.allclose(points[0, :2], points[-1, :2])
    log = simulate(building, route, noise=OdometryNoise(), seed=seed, laps=laps if closed else 1)
    result = map_scans(log.scans(), load_config(options=[f"seed={seed}", *options]))
    (robot,) = result.trajectories
    truth, estimate = {robot: TimedPoses(log.times, log.poses)}, result.trajectories[robot]
    ate = evaluate_ate(truth, {robot: TimedPoses(estimate.times, estimate.poses)})
    return Honesty(
        plan,
        seed,
        ate.translation.rmse,
        samples_of(result, log.poses, plan, seed),
        _innovations(result.events, plan, seed),
    )


def logged(path: Path, options: Sequence[str] = ()) -> Honesty:
    """Map a real log; only its innovations can be told."""
    config = load_config(options=options)
    result = map_scans(open_log(path).scans(), config)
    return Honesty(path.name, config.seed, float("nan"), [], _innovations(result.events, path.name, config.seed))


def samples_of(result: RunResult, truth: FloatArray, plan: str, seed: int) -> list[Sample]:
    """Every version of every edge that was in the graph, and every joint vertex pose but the root's.

    The true frame of a vertex is the robot's true pose at the scan that made it, its local map's first.

    Args:
        result: of a run with one robot.
        truth: (n, 3) true robot pose at each of its scans.
        plan: to file the samples under.
        seed: the same.
    """
    frames = {
        vertex: se2.compose(truth[local.scans[0]], se2.inverse(local.poses[0]))
        for vertex, local in result.local_maps.items()
    }
    since = _since_resampling(result.events)

    def sample(kind: str, name: str, a: VertexId, b: VertexId, a_T_b: gtsam.Pose2, covariance: FloatArray) -> Sample:
        true, measured = se2.between(frames[a], frames[b]), np.array([a_T_b.x(), a_T_b.y(), a_T_b.theta()])
        return Sample(plan, seed, kind, name, true, measured, covariance, float(frames[b][2]), since.get(name))

    samples = []
    for fate in result.edges:
        edge = fate.edge
        if fate.fate != "refused" and edge.estimate is not None:
            first = edge.kind is EdgeKind.LOOP and edge.version == 0 and fate.fate == "replaced"
            kind = ENTERING if first else str(edge.kind)
            samples.append(sample(kind, str(edge), edge.tail, edge.head, *edge.estimate))
    poses = result.vertex_poses
    for root, *others in result.components:
        for v in others:
            covariance = result.vertex_covariances[v]
            samples.append(sample(VERTEX, str(v), root, v, poses[root].between(poses[v]), covariance))
    return samples


def _since_resampling(events: Iterable[Event]) -> dict[str, int]:
    """Key scans since the last resampling, by the edge made on leaving a map or on closing it."""
    since, latest = {}, 0
    for event in events:
        latest = event.detail.get("since_resampling", latest)
        if "edge" in event.detail:
            since[event.detail["edge"]] = latest
    return since


def _innovations(events: Iterable[Event], source: str, seed: int) -> list[Innovation]:
    return innovations_of([(event.kind, event.detail) for event in events], source, seed)


def innovations_of(events: Iterable[tuple[str, dict[str, object]]], source: str, seed: int) -> list[Innovation]:
    """The innovations among events, given as kind and detail."""
    return [
        Innovation(source, seed, kind, np.array(detail["offset"], np.float64), float(str(detail["innovation"])))
        for kind, detail in events
        if "innovation" in detail
    ]


def finished(out: Path) -> Honesty:
    """The innovations in the ``run.json`` that a run left in ``out``; ValueError if it is not one."""
    path = out / "run.json"
    try:
        run = json.loads(path.read_text(encoding="utf-8"))
        events = [(event["kind"], event["detail"]) for event in run["events"]]
        seed = int(run["seed"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not what a run writes ({error!r}); run again") from error
    return Honesty(out.name, seed, float("nan"), [], innovations_of(events, out.name, seed))
