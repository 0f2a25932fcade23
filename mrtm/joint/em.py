"""M13 as the paper prints it: the off-line optimisation by Expectation Maximisation, to compare the on-line one with.

The paper: V0 is the root; Dijkstra's tree from it is the start; find all transformations that maximise the sum over
pairs of vertices of ``L(M_m, M_n, phi_n | phi_m, T_ini)``, the log-probability of overlapping local maps, by "an Expect
Maximization method". It does not print L, the hidden variables, or the steps. What was chosen here:

- *Maps.* The occupied cells of a grid, each as a surfel: the mean of the endpoints in it and the normal there
  (``LocalMap.cloud`` and ``normals``, what the on-line alignment sees too). Cells without a normal are left out.
- *L.* The surfels of n, moved into m, are drawn from a mixture: a Gaussian around each surfel of m, drawn out
  along its surface, times a von Mises density of the normal, plus uniform clutter. Both directions, m given n and n
  given m, count.
- *E step.* The hidden variable of a surfel is which of the other map's it belongs to, if any: its responsibilities at
  the present poses (``mrtm.joint.surfels``). A pair whose relative pose has hardly moved keeps the responsibilities it
  has (partial E steps: R. Neal, G. Hinton, "A view of the EM algorithm that justifies incremental, sparse, and other
  variants", 1998).
- *M step.* All poses at once, to convergence, by Gauss-Newton on the pairs' quadratic forms; it does not see a point.
- *Step length.* Each step goes somewhat further than the M step, and less far where that would lower the sum (R.
  Salakhutdinov, S. Roweis, "Adaptive overrelaxed bound optimization methods", ICML 2003): the sum never falls.
- *Annealing.* The tree can be off by more than a wall is thick, so the Gaussians start wide and are narrowed step by
  step (S. Granger, X. Pennec, "Multi-scale EM-ICP", ECCV 2002).
- *Pairs.* Those whose surfels come within reach of each other at the present poses, found anew at each scale.
- *T_ini.* A wide Gaussian (``T_INI``) around each step of the tree: it holds what overlaps with nothing and is
  too weak to be felt elsewhere. As in the paper, edges and their covariances are not used otherwise.
"""

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from factors import GraphEdge, VertexId
from frontend import se2
from frontend.records import FloatArray
from mrtm.joint.alignment.agreement import SurfaceMap
from mrtm.joint.surfels import ALONG, REACH, IntArray, Surfels, expect
from mrtm.joint.tree import shortest_paths
from mrtm.progress import Progress

SIGMAS = (0.32, 0.16, 0.08, 0.04)
"""Metres, the standard deviations of the annealing; the last is what the cells explain."""

T_INI = np.array([1.0, 1.0, 0.1])
"""Standard deviations around a step of the tree: metres and radians."""

SETTLED = 0.02
"""A pose that moves by less than this share of sigma stands still."""

LENGTHENING = 1.2
"""Each step goes by so much further towards and beyond the M step's answer than the last, until one goes too far."""

MOST_ROUNDS = 60  # E steps a scale
MOST_STEPS = 10  # of Gauss-Newton an M step
LEVER = 5.0
"""Metres: a turn by one radian moves a map's walls about so far."""


@dataclass(frozen=True, slots=True)
class Round:
    """An E step: its scale, metres, and the log-posterior of the poses it started from; comparable within a scale."""

    sigma: float
    log_posterior: float


@dataclass(frozen=True, slots=True)
class EmResult:
    """What the EM found.

    Attributes:
        poses: root_T_vertex of every vertex the edges reach.
        rounds: in order.
        pairs: pairs of overlapping maps at the end.
        seconds: it took, compiling of kernels left out.
    """

    poses: dict[VertexId, gtsam.Pose2]
    rounds: tuple[Round, ...]
    pairs: int
    seconds: float


def optimise(
    maps: Mapping[VertexId, SurfaceMap],
    edges: Collection[GraphEdge],
    root: VertexId,
    progress: Progress = lambda fraction, doing: None,
) -> EmResult:
    """Optimise all vertex poses off line (M13); see the module for what is maximised and how.

    Args:
        maps: the local maps; a vertex without one is held by its step of the tree alone.
        edges: of the topological map, for the tree.
        root: the vertex that defines the frame and stays where it is.
    """
    _compile()
    started = time.perf_counter()
    tree = shortest_paths(edges, root)
    vertices = list(tree)
    number = {vertex: k for k, vertex in enumerate(vertices)}
    poses = np.array([[b.pose.x(), b.pose.y(), b.pose.theta()] for b in tree.values()])
    steps = _prior([(number[b.parent], k, b.step) for k, b in enumerate(tree.values()) if b.parent is not None])
    surfaces = [_surface(maps.get(vertex)) for vertex in vertices]
    cell = max((maps[vertex].grid.resolution for vertex in vertices if vertex in maps), default=0.05)
    rounds: list[Round] = []
    pairs = np.empty((0, 2), np.int64)
    for level, sigma in enumerate(SIGMAS):
        progress(level / len(SIGMAS), f"EM at {sigma:.2f} m, {len(vertices)} maps")
        surfels = Surfels.of(surfaces, sigma, cell)
        pairs = _overlapping(surfels, poses)
        poses = _anneal(surfels, pairs, poses, steps, rounds)
    found = {vertex: gtsam.Pose2(*pose) for vertex, pose in zip(vertices, poses, strict=True)}
    progress(1.0, f"EM: {len(rounds)} rounds")
    return EmResult(found, tuple(rounds), len(pairs) // 2, time.perf_counter() - started)


@dataclass(frozen=True, slots=True)
class _Forms:
    """What pairs (p, 2) say of ``v = (cos, sin, x, y)`` of their relative poses: ``v' Q v / 2 - q' v``, to minimise."""

    pairs: IntArray
    quadratic: FloatArray
    linear: FloatArray

    def cost(self, poses: FloatArray) -> float:
        v = _coordinates(se2.between(poses[self.pairs[:, 0]], poses[self.pairs[:, 1]]))
        return float((v * (0.5 * np.einsum("pij,pj->pi", self.quadratic, v) - self.linear)).sum())

    def __add__(self, other: "_Forms") -> "_Forms":
        mine, theirs = (self.pairs, self.quadratic, self.linear), (other.pairs, other.quadratic, other.linear)
        pairs, quadratic, linear = (np.concatenate(both) for both in zip(mine, theirs, strict=True))
        return _Forms(pairs, quadratic, linear)


def _anneal(surfels: Surfels, pairs: IntArray, poses: FloatArray, steps: _Forms, rounds: list[Round]) -> FloatArray:
    """EM at one scale until the poses stand still."""
    still = SETTLED * surfels.sigma
    seen = np.zeros((len(pairs), 3))  # relative poses at which the responsibilities were last found
    moved = np.ones(len(pairs), np.bool_)
    quadratic, linear, gain = np.zeros((len(pairs), 4, 4)), np.zeros((len(pairs), 4)), np.zeros(len(pairs))
    best, stride, goal = -np.inf, 1.0, poses
    trial = poses
    for _ in range(MOST_ROUNDS):
        relative = se2.between(trial[pairs[:, 0]], trial[pairs[:, 1]])
        moved |= _motion(seen, relative) > 0.3 * still
        quadratic[moved], linear[moved], gain[moved] = expect(surfels, pairs[moved], relative[moved])
        seen[moved] = relative[moved]
        moved[:] = False
        log_posterior = float(gain.sum()) - steps.cost(trial)
        if log_posterior >= best:
            best, poses = log_posterior, trial
            rounds.append(Round(surfels.sigma, best))
            goal = _maximise(_Forms(pairs, quadratic, linear) + steps, poses, 0.1 * still)
            stride *= LENGTHENING
        else:
            stride = 1.0 if stride > 1.0 else 0.5 * stride
        if stride * _motion(poses, goal).max(initial=0.0) < still:
            break
        way = goal - poses
        way[:, 2] = se2.wrap(way[:, 2])
        trial = poses + stride * way
        trial[:, 2] = se2.wrap(trial[:, 2])
    return poses


def _maximise(forms: _Forms, poses: FloatArray, still: float) -> FloatArray:
    """The M step: the poses that minimise the forms, the first one fixed, by Gauss-Newton with step halving."""
    cost = forms.cost(poses)
    if len(poses) == 1:
        return poses
    for _ in range(MOST_STEPS):
        step = _gauss_newton(forms, poses)
        while True:
            better = poses.copy()
            better[1:] += step
            better[:, 2] = se2.wrap(better[:, 2])
            found = forms.cost(better)
            if found <= cost:
                break
            step *= 0.5
            if np.abs(step).max() < 1e-9:
                return poses
        poses, cost = better, found
        if _motion(step, np.zeros((1, 3))).max() < still:
            break
    return poses


def _gauss_newton(forms: _Forms, poses: FloatArray) -> FloatArray:
    """The steps (n - 1, 3) in x, y, theta of all poses but the first."""
    n = len(poses)
    a, b = forms.pairs.T
    relative = se2.between(poses[a], poses[b])
    v = _coordinates(relative)
    cos, sin = np.cos(poses[a, 2]), np.sin(poses[a, 2])
    # The derivative of v by x, y, theta of a and of b.
    jacobian = np.zeros((len(a), 4, 6))
    jacobian[:, 0, 5], jacobian[:, 1, 5] = -v[:, 1], v[:, 0]
    jacobian[:, 2, 3], jacobian[:, 2, 4] = cos, sin
    jacobian[:, 3, 3], jacobian[:, 3, 4] = -sin, cos
    jacobian[..., :3] = -jacobian[..., 3:]
    jacobian[:, 2, 2], jacobian[:, 3, 2] = relative[:, 1], -relative[:, 0]
    gradient = np.einsum("pki,pk->pi", jacobian, np.einsum("pij,pj->pi", forms.quadratic, v) - forms.linear)
    hessian = np.einsum("pki,pkl,plj->pij", jacobian, forms.quadratic, jacobian)
    rows = np.concatenate([3 * a[:, None] + np.arange(3), 3 * b[:, None] + np.arange(3)], axis=1)
    right = np.bincount(rows.ravel(), gradient.ravel(), 3 * n)[3:]
    i, j = np.broadcast_arrays(rows[:, :, None], rows[:, None, :])
    whole = coo_array((hessian.ravel(), (i.ravel(), j.ravel())), shape=(3 * n, 3 * n)).tocsc()[3:, 3:]
    return -np.asarray(spsolve(whole, right)).reshape(-1, 3)


def _prior(steps: Sequence[tuple[int, int, gtsam.Pose2]]) -> _Forms:
    """The wide Gaussians around the tree's steps, parent_T_child."""
    pairs = np.array([(a, b) for a, b, _ in steps], np.int64).reshape(-1, 2)
    v = _coordinates(np.array([[s.x(), s.y(), s.theta()] for _, _, s in steps]).reshape(-1, 3))
    stiffness = 1.0 / T_INI[[2, 2, 0, 1]] ** 2  # of cos and sin together: that of the angle
    return _Forms(pairs, np.tile(np.diag(stiffness), (len(steps), 1, 1)), stiffness * v)


def _surface(local_map: SurfaceMap | None) -> tuple[FloatArray, FloatArray]:
    if local_map is None:
        return np.empty((0, 2)), np.empty((0, 2))
    known = (local_map.normals**2).sum(axis=1) > 0.25
    return np.ascontiguousarray(local_map.cloud[known]), np.ascontiguousarray(local_map.normals[known])


def _overlapping(surfels: Surfels, poses: FloatArray) -> IntArray:
    """Ordered pairs (p, 2) of maps whose boxes, grown by the surfels' reach, overlap."""
    boxes = []
    for k, pose in enumerate(poses):
        points = surfels.points[surfels.first[k] : surfels.first[k + 1]]
        placed = se2.compose(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]
        boxes.append((placed.min(axis=0), placed.max(axis=0)) if len(points) else np.full((2, 2), np.nan))
    low, high = np.array(boxes).transpose(1, 0, 2)
    reach = REACH * ALONG * surfels.sigma
    overlap = ((low[:, None] <= high[None] + reach) & (low[None] <= high[:, None] + reach)).all(axis=2)
    np.fill_diagonal(overlap, False)
    return np.argwhere(overlap)


def _coordinates(poses: FloatArray) -> FloatArray:
    return np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2]), poses[:, :2]])


def _motion(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n,) metres by which walls move from one pose to the other."""
    return np.asarray(np.hypot(*(b - a)[:, :2].T) + LEVER * np.abs(se2.wrap(b[:, 2] - a[:, 2])))


def _compile() -> None:
    """Have numba compile before the clock starts: the on-line optimisation has its time without that too."""
    points = np.array([[0.0, 0.0], [1.0, 0.0]])
    surfels = Surfels.of([(points, np.ones((2, 2)))] * 2, 0.3, 0.05)
    expect(surfels, np.array([[0, 1]]), np.zeros((1, 3)))
