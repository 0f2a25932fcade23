"""Two robots drive through one simulated building; every pair of their local maps is a case with known truth."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from time import perf_counter

import numpy as np

from factors import UncertainPose
from frontend import se2
from frontend.records import FloatArray
from mrtm.config import load_config
from mrtm.joint.alignment.agreement import overlap
from mrtm.joint.alignment.align import Alignment, align
from mrtm.joint.alignment.surface import Surface, partners
from mrtm.robot.poses import array_of, pose_of
from mrtm.session import map_scans
from mrtm.team.map_codec import pack_map, unpack_map
from tools.simulation import BUILDINGS, FloorPlan, OdometryNoise, simulate
from tools.simulation.construction import Points, wall

LEAST_AREA, LEAST_COMMON = 20.0, 200  # m^2 and points of true overlap: less need not be found
FALSE_METRES, FALSE_SIGMAS = 0.3, 5.0  # beyond both an accepted alignment is false
ROOM, ROOMS = 6.0, 4


@dataclass(frozen=True, slots=True)
class Placed:
    """A local map and plan_T_local."""

    surface: Surface
    frame: FloatArray


@dataclass(frozen=True, slots=True)
class Case:
    """One alignment and its truth.

    Attributes:
        plan: building.
        kind: "true": the guess is drawn from its covariance; "displaced": it is far outside; "elsewhere": the maps
            do not overlap, but the guess says so.
        true: (3,) a_T_b.
        seconds: it took.
        alignment: None if nothing met.
    """

    plan: str
    kind: str
    true: FloatArray
    seconds: float
    alignment: Alignment | None

    @property
    def accepted(self) -> bool:
        """Whether it would become an edge."""
        return self.alignment is not None and self.alignment.accepted

    @property
    def error(self) -> FloatArray:
        """(3,) ``Log(true^-1 * estimate)``, NaN without an alignment."""
        if self.alignment is None:
            return np.full(3, np.nan)
        return se2.log(se2.between(self.true, array_of(self.alignment.estimate.pose)))

    @property
    def nees(self) -> float:
        """``e' inv(P) e / 3``; NaN without an alignment."""
        if self.alignment is None:
            return float("nan")
        error = self.error
        return float(error @ np.linalg.solve(self.alignment.estimate.covariance, error)) / 3.0

    @property
    def is_false(self) -> bool:
        """Accepted, and not just inexact but wrong."""
        far = bool(np.hypot(*self.error[:2]) > FALSE_METRES)
        return self.accepted and far and 3.0 * self.nees > FALSE_SIGMAS**2


def twins(seed: int = 0) -> FloorPlan:
    """A corridor with equal rooms, equally furnished: ``ROOM`` metres wide each. Route ``rooms``."""
    rng = np.random.default_rng(seed)
    length = ROOM * ROOMS
    boxes = [(*rng.uniform((1.0, 2.0), (5.0, 5.0)), *rng.uniform(0.3, 0.9, 2), rng.uniform(0, np.pi)) for _ in range(6)]
    boxes = [box for box in boxes if abs(box[0] - 3.0) > 1.2]
    doors: Points = [((i + 0.5) * ROOM,) for i in range(ROOMS)]
    walls = wall((0, -2), (length, -2)) + wall((0, 0), (length, 0), doors) + wall((0, 6), (length, 6))
    for i in range(ROOMS + 1):
        walls += wall((i * ROOM, -2.0 if i in (0, ROOMS) else 0.0), (i * ROOM, 6))
    plan = FloorPlan("twins", walls)
    route: list[tuple[float, ...]] = [(1.0, -1.0)]
    for i in range(ROOMS):
        middle = (i + 0.5) * ROOM
        plan.boxes.extend((i * ROOM + x, y, *rest) for x, y, *rest in boxes)
        route += [(middle, -1.0), (middle, 1.0), (middle, 3.5, 1.0), (middle, 1.0), (middle, -1.0)]
    plan.routes["rooms"] = [*route, (length - 1.0, -1.0)]
    return plan


PLANS = {**BUILDINGS, "twins": twins}


def drive(name: str, seed: int) -> tuple[list[Placed], list[Placed]]:
    """The local maps of two robots in one building: the second goes another way round, with other errors.

    Args:
        name: of a plan, or plan/route; else its first route.
        seed: of everything.
    """
    building, _, route = name.partition("/")
    plan = PLANS[building](seed)
    route = route or next(iter(plan.routes))
    points = plan.routes[route]
    if points[0][:2] == points[-1][:2]:
        half = len(points) // 2
        points = [*points[half:-1], *points[: half + 1]]
    back = replace(plan, routes={route: points[::-1]})
    return _maps(plan, route, 2 * seed), _maps(back, route, 2 * seed + 1)


def _maps(plan: FloorPlan, route: str, seed: int) -> list[Placed]:
    log = simulate(plan, route, noise=OdometryNoise(), seed=seed)
    # A small travel square where everything is small: several maps that must be told apart.
    options = ["frontend.travel_square=8", "frontend.sensing_range=8"] if plan.name == "twins" else []
    result = map_scans(log.scans(), load_config(options=[f"seed={seed}", *options]))
    placed = []
    for m in result.local_maps.values():
        grid, cloud, normals = unpack_map(pack_map(m.grid, m.cloud, m.normals), plan.name)  # as robots align them
        frame = se2.compose(log.poses[m.scans[0]], se2.inverse(m.poses[0]))
        placed.append(Placed(Surface.of(replace(m, grid=grid, cloud=cloud, normals=normals)), frame))
    return placed


def cases(plan: str, seed: int, sigma: FloatArray) -> Iterator[tuple[str, FloatArray, UncertainPose, Surface, Surface]]:
    """Kind, true a_T_b, guess, a and b of every case of a building.

    Args:
        plan, seed: see ``drive``.
        sigma: (3,) standard deviations of a guess.
    """
    rng = np.random.default_rng(seed)
    covariance = np.diag(sigma**2)
    first, second = drive(plan, seed)

    def overlaps(a: Placed, b: Placed, a_T_b: FloatArray) -> bool:
        area = overlap(a.surface.lookup, b.surface.lookup, a_T_b)
        return area >= LEAST_AREA and len(partners(a.surface, b.surface, a_T_b, 0.25)[1]) >= LEAST_COMMON

    for a, b in product(first, second):
        true = se2.between(a.frame, b.frame)
        drawn = sigma * rng.standard_normal(3)
        angle, far = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(6.0, 9.0) * max(sigma[0], 0.5)
        moved = np.array([far * np.cos(angle), far * np.sin(angle), drawn[2]])
        if overlaps(a, b, true):
            yield "true", true, UncertainPose(pose_of(se2.compose(true, drawn)), covariance), a.surface, b.surface
            yield "displaced", true, UncertainPose(pose_of(se2.compose(true, moved)), covariance), a.surface, b.surface
        elif overlap(a.surface.lookup, b.surface.lookup, true) == 0.0:
            other = second[int(rng.integers(len(second)))]
            guess = se2.compose(se2.between(a.frame, other.frame), drawn)
            yield "elsewhere", true, UncertainPose(pose_of(guess), covariance), a.surface, b.surface


def run(plan: str, seed: int, sigma: FloatArray) -> list[Case]:
    """Align every case of a building."""
    results = []
    for kind, true, guess, a, b in cases(plan, seed, sigma):
        start = perf_counter()
        alignment = align(a, b, guess)
        results.append(Case(plan, kind, true, perf_counter() - start, alignment))
    return results
