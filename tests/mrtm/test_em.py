from functools import partial
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from scipy.optimize import approx_fprime

from factors import Edge, VertexId
from frontend import se2
from frontend.local_map import LocalMap
from frontend.records import FloatArray
from mrtm.joint import surfels
from mrtm.joint.em import SIGMAS, EmResult, optimise
from mrtm.joint.surfels import Surfels, expect
from tests.mrtm.surface_world import CORRIDOR, ROOMS, box_walls, distance, edge, map_at, surface

V = [VertexId("red", k) for k in range(5)]
TRUTH = {
    V[0]: gtsam.Pose2(1.0, 1.0, 0.2),
    V[1]: gtsam.Pose2(6.0, 3.0, -1.1),
    V[2]: gtsam.Pose2(11.0, 2.0, 2.5),
    V[3]: gtsam.Pose2(18.0, 3.5, -3.0),
}
SEEN = {V[0]: [0], V[1]: [0, 1], V[2]: [1, 2], V[3]: [2]}
"""Which rooms each vertex knows."""


def world(seed: int, noise: float = 0.01) -> tuple[dict[VertexId, LocalMap], list[Edge]]:
    """Four maps of three rooms, and edges that are wrong by some 0.15 m and 2 degrees each."""
    rng = np.random.default_rng(seed)
    maps = {v: map_at(pose, [w for r in SEEN[v] for w in box_walls(ROOMS[r])], noise, rng) for v, pose in TRUTH.items()}
    wrong = [gtsam.Pose2(*rng.normal(0.0, [0.1, 0.1, 0.035])) for _ in range(3)]
    edges = [edge(k, V[k], V[k + 1], TRUTH[V[k]].between(TRUTH[V[k + 1]]).compose(wrong[k])) for k in range(3)]
    return maps, edges


def errors(result: EmResult, root: VertexId = V[0]) -> FloatArray:
    """Metres and degrees of every vertex, seen from the root."""
    return np.array([distance(TRUTH[root].between(TRUTH[v]), pose) for v, pose in result.poses.items()])


@pytest.mark.parametrize("seed", range(4))
def test_finds_the_truth_from_a_wrong_tree(seed: int) -> None:
    maps, edges = world(seed)
    found = errors(optimise(maps, edges, V[0]))
    assert found[:, 0].max() < 0.01
    assert found[:, 1].max() < 0.1


def test_the_root_stays_and_may_be_any_vertex() -> None:
    maps, edges = world(1)
    result = optimise(maps, edges, V[2])
    assert distance(result.poses[V[2]], gtsam.Pose2()) == (0.0, 0.0)
    assert errors(result, V[2])[:, 0].max() < 0.005


def test_log_posterior_rises_at_every_scale() -> None:
    maps, edges = world(2)
    rounds = optimise(maps, edges, V[0]).rounds
    assert tuple(dict.fromkeys(r.sigma for r in rounds)) == SIGMAS
    for sigma in SIGMAS:
        values = [r.log_posterior for r in rounds if r.sigma == sigma]
        assert np.diff(values).min(initial=0.0) >= 0.0


def test_a_map_that_overlaps_with_nothing_follows_its_step_of_the_tree() -> None:
    maps, edges = world(3)
    rng = np.random.default_rng(9)
    far = gtsam.Pose2(60.0, 0.0, 1.0)
    maps[V[4]] = map_at(far, [(60.0, 0.0, 65.0, 0.0)], 0.01, rng)
    step = TRUTH[V[3]].between(far)
    result = optimise(maps, [*edges, edge(3, V[3], V[4], step)], V[0])
    metres, degrees = distance(result.poses[V[3]].between(result.poses[V[4]]), step)
    assert metres < 1e-3
    assert degrees < 1e-2


def test_a_vertex_without_a_map_follows_too() -> None:
    maps, edges = world(3)
    step = gtsam.Pose2(2.0, 1.0, 0.5)
    result = optimise(maps, [*edges, edge(3, V[1], V[4], step)], V[0])
    assert distance(result.poses[V[1]].between(result.poses[V[4]]), step)[0] < 1e-3


def test_along_a_bare_corridor_nothing_is_made_up() -> None:
    rng = np.random.default_rng(4)
    one, other = gtsam.Pose2(10.0, 1.0, 0.0), gtsam.Pose2(20.0, 1.0, 0.3)
    # The second map ends elsewhere, so that no end of a wall helps.
    maps = {V[0]: map_at(one, CORRIDOR, 0.01, rng), V[1]: map_at(other, [(5, 0, 25, 0), (25, 2, 5, 2)], 0.01, rng)}
    wrong = gtsam.Pose2(20.3, 1.15, 0.33)
    found = one.compose(optimise(maps, [edge(0, V[0], V[1], one.between(wrong))], V[0]).poses[V[1]])
    assert abs(found.y() - 1.0) < 0.005
    assert abs(found.theta() - 0.3) < 0.001
    assert abs(found.x() - 20.3) < 0.05


def test_the_two_sides_of_a_wall_are_not_one_surface() -> None:
    rng = np.random.default_rng(5)
    left, right = gtsam.Pose2(4.0, 2.0, 0.0), gtsam.Pose2(12.0, 2.0, 0.0)
    maps = {V[0]: map_at(left, box_walls(ROOMS[0]), 0.01, rng), V[1]: map_at(right, box_walls(ROOMS[1]), 0.01, rng)}
    step = left.between(right)
    result = optimise(maps, [edge(0, V[0], V[1], step)], V[0])
    assert abs(result.poses[V[1]].x() - step.x()) < 0.02  # a wall is 0.12 m thick


def test_a_single_vertex_and_no_overlap_at_all_are_fine() -> None:
    maps, _ = world(0)
    alone = optimise(maps, [], V[0])
    assert list(alone.poses) == [V[0]]
    assert alone.pairs == 0
    assert list(optimise({}, world(0)[1], V[0]).poses) == V[:4]


def test_many_maps_of_one_place_end_up_on_each_other() -> None:
    rng = np.random.default_rng(6)
    vertices = [VertexId(robot, k) for robot in ("red", "blue") for k in range(6)]
    poses = {v: gtsam.Pose2(rng.uniform(1, 7), rng.uniform(1, 4), rng.uniform(-3, 3)) for v in vertices}
    maps = {v: map_at(pose, box_walls(ROOMS[0]), 0.01, rng) for v, pose in poses.items()}
    edges = [
        edge(k, a, b, poses[a].between(poses[b]).compose(gtsam.Pose2(*rng.normal(0, [0.08, 0.08, 0.02]))))
        for k, (a, b) in enumerate(pairwise(vertices))
    ]
    result = optimise(maps, edges, vertices[0])
    off = [distance(poses[vertices[0]].between(poses[v]), result.poses[v])[0] for v in vertices]
    assert max(off) < 0.005
    assert result.pairs == 66


# The E step against plain formulas.


def two_surfaces() -> list[tuple[FloatArray, FloatArray]]:
    one, other = (surface(box_walls(ROOMS[0])), surface(box_walls(ROOMS[0])[:3]))
    return [one, other]


def slow(one: Surfels, pose: FloatArray) -> float:
    """The log-likelihood of map 1's surfels given map 0, over that of clutter: every surfel against every other."""
    first = one.first
    y, n = one.points[first[0] : first[1]], one.normals[first[0] : first[1]]
    x, m = one.points[first[1] : first[2]], one.normals[first[1] : first[2]]
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    d = (x @ turn.T + pose[:2])[:, None] - y[None]
    off = (d * n[None]).sum(axis=2) / one.sigma
    beside = (n[None, :, 0] * d[..., 1] - n[None, :, 1] * d[..., 0]) / (surfels.ALONG * one.sigma)
    facing = (m @ turn.T) @ n.T
    half = 0.5 * (off**2 + beside**2)
    density = np.where(half <= 0.5 * surfels.REACH**2, np.exp(-half + surfels.FACING * (facing - 1.0)), 0.0)
    clutter = surfels.ALONG * one.sigma * np.sqrt(2 * np.pi) / one.spacing * np.exp(-0.5 * surfels.CLUTTER**2)
    return float(np.log1p(density.sum(axis=1) / clutter).sum())


@pytest.mark.parametrize("sigma", [0.04, 0.1, 0.32])
def test_likelihood_is_that_of_the_mixture(sigma: float) -> None:
    s = Surfels.of(two_surfaces(), sigma, 0.05)
    for pose in np.array([[0.0, 0.0, 0.0], [0.1, -0.07, 0.02], [3.0, 1.0, 1.0], [50.0, 0.0, 0.0]]):
        _, _, gain = expect(s, np.array([[0, 1]]), pose[None])
        assert gain[0] == pytest.approx(slow(s, pose), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("pose", [[0.03, -0.02, 0.01], [0.1, 0.05, -0.03]])
def test_forms_have_the_gradient_of_the_likelihood(pose: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    """Fisher's identity: at the poses of the E step the expected log-likelihood has the slope of the likelihood.

    The walls are long, so the pulls along them, which the forms leave out, add up to little.
    """
    s = Surfels.of(two_surfaces(), 0.1, 0.05)
    at = np.array(pose)
    quadratic, linear, _ = expect(s, np.array([[0, 1]]), at[None])
    v = np.array([np.cos(at[2]), np.sin(at[2]), at[0], at[1]])
    by_v = linear[0] - quadratic[0] @ v
    expected = np.array([by_v[2], by_v[3], -v[1] * by_v[0] + v[0] * by_v[1]])

    monkeypatch.setattr(surfels, "REACH", 6.0)  # ``slow`` goes further; the kernel has its own since it was compiled
    slope = approx_fprime(at, partial(slow, s), 1e-6)
    # The kernel leaves out what is beyond three standard deviations, a few parts in a thousand of the weight.
    assert slope == pytest.approx(expected, rel=0.03, abs=0.03 * np.abs(expected).max())


def test_forms_are_symmetric_and_do_not_fall_below_nothing() -> None:
    s = Surfels.of(two_surfaces(), 0.1, 0.05)
    quadratic, _, _ = expect(s, np.array([[0, 1], [1, 0]]), np.zeros((2, 3)))
    assert quadratic == pytest.approx(quadratic.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(quadratic).min() > 0


def test_sampling_thins_but_keeps_every_wall() -> None:
    points, normals = surface(box_walls(ROOMS[0]))
    thin = Surfels.of([(points, normals)], 0.32, 0.05)
    assert len(points) / 10 < len(thin.points) < len(points) / 4
    distances = np.hypot(*(points[:, None] - thin.points[None]).transpose(2, 0, 1)).min(axis=1)
    assert distances.max() < 0.64
    for axis in ([1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]):
        assert (thin.normals @ axis > 0.9).any()


def test_empty_maps_have_no_surfels() -> None:
    nothing = (np.empty((0, 2)), np.empty((0, 2)))
    s = Surfels.of([nothing, surface(box_walls(ROOMS[0]))], 0.1, 0.05)
    _, _, gain = expect(s, np.array([[0, 1], [1, 0]]), se2.inverse(np.zeros((2, 3))))
    assert gain.tolist() == [0.0, 0.0]
