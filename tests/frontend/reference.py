"""What the front end's numba kernels compute, slowly and obviously: plain Python and float64, one beam at a time.

Written from the docstrings, not translated from the kernels. Constants are the kernels' own. Maps are arrays of cells,
row by row, not of tiles. Matching finds a cell with ``int``, which rounds towards zero: a strip one cell wide outside
the map counts as its outermost cells.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from frontend import grid, matching, points
from frontend.records import FloatArray

Cell = tuple[int, int]  # column, row
Floats = npt.NDArray[np.floating[Any]]
CAUCHY = 3.0  # standard deviations of a prior or of odometry beyond which it loses its say


def moved(pose: FloatArray, vectors: Floats, *, turn_only: bool = False) -> FloatArray:
    """(n, 2) points (or directions) of the robot frame in the frame of ``pose``."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turned: FloatArray = np.asarray(vectors, np.float64) @ np.array([[c, s], [-s, c]])
    return turned if turn_only else np.asarray(turned + pose[:2])


# --- points ---------------------------------------------------------------------------------------------------------


def endpoints(
    ranges: FloatArray, angles: FloatArray, mount: FloatArray, sensing_range: float, stride: int
) -> tuple[FloatArray, FloatArray]:
    """(n, 4) hits with normals and (m, 2) clear ends, robot frame."""
    spacing = abs(angles[1] - angles[0]) if len(angles) > 1 else 0.0
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    usable = (ranges > points.MIN_RANGE) & (ranges < sensing_range)
    xy = (np.where(usable, ranges, 0.0)[:, None] * directions).astype(np.float32).astype(np.float64)
    hits, clear = [], []
    for i in range(0, len(ranges), stride):
        if usable[i]:
            gap = points.GAP + points.GAP_STEPS * ranges[i] * spacing
            reach = max(points.REACH, points.REACH_STEPS * ranges[i] * spacing)
            group = [xy[i], *_beside(xy, usable, i, -1, gap, reach), *_beside(xy, usable, i, 1, gap, reach)]
            normal = _normal(np.array(group))
            hits.append((*moved(mount, xy[i : i + 1])[0], *moved(mount, normal[None], turn_only=True)[0]))
        elif sensing_range <= ranges[i] < np.inf:
            clear.append(moved(mount, sensing_range * directions[i : i + 1])[0])
    return np.array(hits).reshape(-1, 4), np.array(clear).reshape(-1, 2)


def _beside(
    xy: FloatArray, usable: npt.NDArray[np.bool_], i: int, direction: int, gap: float, reach: float
) -> list[FloatArray]:
    found: list[FloatArray] = []
    for k in range(i + direction, i + direction * (points.MAX_NEIGHBOURS + 1), direction):
        if not 0 <= k < len(xy) or not usable[k] or math.dist(xy[k], xy[k - direction]) > gap:
            break
        if found and math.dist(xy[k], xy[i]) > reach:
            break
        found.append(xy[k])
    return found


def _normal(group: FloatArray) -> FloatArray:
    """Unit normal of the surface through a group of points, facing the origin from the first; zero if there is none."""
    if len(group) < 3:
        return np.zeros(2)
    (across, along), vectors = np.linalg.eigh(np.cov(group.T, bias=True))
    if across > points.FLATNESS * along:
        return np.zeros(2)
    return np.asarray(vectors[:, 0] * -np.sign(vectors[:, 0] @ group[0]))


# --- map ------------------------------------------------------------------------------------------------------------


@dataclass
class Map:
    """One map, ``cells`` x ``cells``; the layers as in ``grid.Maps``."""

    cells: int
    resolution: float
    capacity: int = 30000
    surfels: list[npt.NDArray[np.float32]] = field(default_factory=lambda: [np.zeros(5, np.float32)])

    def __post_init__(self) -> None:
        self.log_odds = np.zeros((self.cells, self.cells), int)
        self.index = np.zeros((self.cells, self.cells), int)

    def cell(self, xy: FloatArray) -> Cell:
        u, v = np.floor(np.asarray(xy, np.float64) / self.resolution + self.cells / 2)
        return int(u), int(v)

    def add(self, pose: FloatArray, hits: Floats, clear: Floats, sensor: FloatArray) -> None:
        ends, normals = moved(pose, hits[:, :2]), moved(pose, hits[:, 2:], turn_only=True)
        start = moved(pose, sensor[None])[0]
        for end in ends:
            self._carve(start, end, spare=1)
        for end in moved(pose, clear):
            self._carve(start, end, spare=0)
        for end, normal in zip(ends, normals, strict=True):
            self._hit(end, normal)

    def _carve(self, start: FloatArray, end: FloatArray, spare: int) -> None:
        """One step a cell along the longer axis; the last ``spare`` cells are left alone."""
        way = (end - start) / self.resolution
        length = float(np.abs(way).max())
        for i in range(int(length) - spare):
            u, v = cell = self.cell(start + i / length * way * self.resolution)
            before = self.log_odds[v, u] if self._inside(cell) else -grid.LIMIT
            if before > -grid.LIMIT:
                self.log_odds[v, u] = before - grid.MISS
                owner = self.index[v, u]
                if before >= grid.DEAD > before - grid.MISS and owner and self._home(owner) == cell:
                    self.surfels[owner][grid.N] = 0

    def _hit(self, end: FloatArray, normal: FloatArray) -> None:
        u, v = cell = self.cell(end)
        if not self._inside(cell, margin=grid.REACH):
            return
        self.log_odds[v, u] = min(grid.LIMIT, self.log_odds[v, u] + grid.HIT)
        owner, values = self.index[v, u], np.array((*end, *normal))
        if owner and self._home(owner) == cell:
            surfel = self.surfels[owner]
            n = min(float(surfel[grid.N]) + 1, grid.MAX_HITS)
            mean = surfel[1:].astype(np.float64)
            surfel[:] = n, *(mean + (values - mean) / n)
        elif len(self.surfels) < self.capacity:
            self.surfels.append(np.array((1, *values), np.float32))
            self._claim(cell, end)

    def _claim(self, home: Cell, end: FloatArray) -> None:
        """The cells around a new surfel point to it, unless a living one is at least as near."""
        reach = grid.REACH
        for dv in range(-reach, reach + 1):
            for du in range(-reach, reach + 1):
                u, v = home[0] + du, home[1] + dv
                owner = self.surfels[self.index[v, u]]
                centre = (np.array((u, v)) + 0.5 - self.cells / 2) * self.resolution
                taken = self.index[v, u] > 0 and owner[grid.N] > 0
                if math.hypot(du, dv) > reach:
                    continue
                if (u, v) == home or not taken or math.dist(centre, end) < math.dist(centre, owner[1:3].astype(float)):
                    self.index[v, u] = len(self.surfels) - 1

    def _home(self, k: int) -> Cell:
        return self.cell(self.surfels[k][1:3].astype(np.float64))

    def _inside(self, cell: Cell, margin: int = 0) -> bool:
        return all(margin <= x < self.cells - margin for x in cell)


# --- matching -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pairing:
    """An endpoint and the surfel that it is compared with: ``directions`` (1 or 2, 2) the residual is measured in."""

    hit: FloatArray
    surfel: FloatArray
    directions: FloatArray
    sigma: float


@dataclass
class Evaluation:
    """A match at one pose; ``gradient`` and ``hessian`` are those of the scan alone."""

    fit: float
    near: int
    free: int
    log_likelihood: float
    hessian: FloatArray
    gradient: FloatArray
    pairings: list[Pairing]


def evaluate(
    maps: grid.Maps, hits: Floats, pose: FloatArray, sigma: float, gate: float = matching.LAST_GATE
) -> Evaluation:
    """``matching.match``'s view of one pose in map 0 of a stack."""
    result = Evaluation(0.0, 0, 0, 0.0, np.zeros((3, 3)), np.zeros(3), [])
    log_odds, index = grid.in_rows(maps.log_odds[0]), grid.in_rows(maps.index[0])
    for hit in hits.astype(np.float64):
        u, v = (int(x) for x in moved(pose, hit[None, :2])[0] / maps.resolution + len(index) / 2)
        if not (0 <= u < len(index) and 0 <= v < len(index)):
            continue
        pairing = _pair(maps.surfels[0, index[v, u]].astype(np.float64), hit, pose, sigma, gate)
        if pairing is not None:
            e, jacobian = residual(pairing, pose)
            m = float(e @ e)
            weight = (1.0 + m / matching.CORE**2) ** -2
            result.hessian += weight * jacobian.T @ jacobian
            result.gradient += weight * jacobian.T @ e
            result.near += 1
            result.fit += 1.0 / (1.0 + m / 4.0)
            result.log_likelihood -= geman_mcclure(m)
            result.pairings.append(pairing)
        elif log_odds[v, u] < matching.FREE:
            result.free += 1
            result.log_likelihood -= geman_mcclure(math.inf)
    return result


def _pair(surfel: FloatArray, hit: FloatArray, pose: FloatArray, sigma: float, gate: float) -> Pairing | None:
    if surfel[grid.N] == 0 or math.dist(moved(pose, hit[None, :2])[0], surfel[1:3]) >= gate:
        return None
    length = math.hypot(*surfel[3:])
    if length <= matching.COHERENCE:
        return Pairing(hit, surfel, np.eye(2), matching.POST * sigma)
    normal = surfel[3:] / length
    if np.any(hit[2:]) and moved(pose, hit[None, 2:], turn_only=True)[0] @ normal <= matching.FACING:
        return None
    return Pairing(hit, surfel, normal[None], sigma)


def residual(pairing: Pairing, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residual in standard deviations (k,) and its derivative by x, y, theta (k, 3)."""
    arm = moved(pose, pairing.hit[None, :2], turn_only=True)[0]
    e = pairing.directions @ (arm + pose[:2] - pairing.surfel[1:3])
    jacobian = pairing.directions @ np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
    return e / pairing.sigma, jacobian / pairing.sigma


def geman_mcclure(m: float) -> float:
    """Robust cost of a squared residual of m variances; CORE^2 / 2 at most."""
    return 0.5 * matching.CORE**2 if math.isinf(m) else 0.5 * m / (1.0 + m / matching.CORE**2)


def cost(pairings: list[Pairing], pose: FloatArray, prior: FloatArray, information: FloatArray) -> float:
    """What a match minimises, the pairings kept: Geman-McClure over endpoints, Cauchy (three sigma) on the prior."""
    off = pose - prior
    scan = sum(geman_mcclure(float(e @ e)) for e in (residual(pairing, pose)[0] for pairing in pairings))
    return scan + 0.5 * CAUCHY**2 * math.log1p(float(off @ information @ off) / CAUCHY**2)


def search_score(maps: grid.Maps, hits: Floats, pose: FloatArray, centre: FloatArray, information: FloatArray) -> float:
    """``matching.search``'s score of one pose."""
    near = free = 0
    turned = np.append(centre[:2], pose[2])
    shift = (pose - centre)[:2] / maps.resolution
    log_odds, index = grid.in_rows(maps.log_odds[0]), grid.in_rows(maps.index[0])
    for at in (moved(turned, hits[:, :2]) / maps.resolution + len(index) / 2).astype(np.float32):
        u, v = (int(x) for x in at + shift)
        if 0 <= u < len(index) and 0 <= v < len(index):
            near += index[v, u] > 0
            free += index[v, u] == 0 and log_odds[v, u] < matching.FREE
    off = pose - centre
    return (near - free) / len(hits) - 0.05 * math.log1p(float(off @ information @ off) / 9.0)


# --- smoothing ------------------------------------------------------------------------------------------------------


def smooth(
    poses: FloatArray, matched: FloatArray, hessians: FloatArray, motions: FloatArray, variances: FloatArray
) -> FloatArray:
    """``refine._smooth`` as one dense least-squares problem, its derivatives by differences."""
    n = len(poses)

    def odometry(flat: FloatArray) -> FloatArray:
        x = flat.reshape(n, 3)
        rows = []
        for i in range(1, n):
            there = moved(np.array([0.0, 0.0, -x[i - 1, 2]]), x[i : i + 1, :2] - x[i - 1, :2])[0]
            turn = math.remainder(x[i, 2] - x[i - 1, 2] - motions[i, 2], 2.0 * math.pi)
            rows.append((*(there - motions[i, :2]), turn))
        return np.array(rows).ravel()

    flat = poses.ravel()
    step = 1e-6
    jacobian = np.column_stack([(odometry(flat + d) - odometry(flat - d)) / (2 * step) for d in step * np.eye(3 * n)])
    e = odometry(flat)
    whitened = (e**2 / variances[1:].ravel()).reshape(-1, 3)
    weights = np.repeat(1.0 / (1.0 + whitened.sum(axis=1) / CAUCHY**2), 3) / variances[1:].ravel()
    normal = jacobian.T @ (weights[:, None] * jacobian)
    right = -jacobian.T @ (weights * e)
    for i in range(n):
        at = slice(3 * i, 3 * i + 3)
        normal[at, at] += hessians[i]
        right[at] -= hessians[i] @ (poses[i] - matched[i])
    return np.asarray((flat + np.linalg.solve(normal, right)).reshape(n, 3))
