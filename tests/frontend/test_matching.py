"""Scan matching against the reference, in rooms with a known answer, and where there is little or nothing to match."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from frontend import matching, se2
from frontend.grid import Maps
from frontend.points import Points
from frontend.records import FloatArray
from tests.frontend import reference
from tests.frontend.simulated import CORRIDOR, RESOLUTION, ROOM, drawn, look, room

SIGMA = 0.02
LOOSE = np.diag([1.0, 1.0, 1.0]) * 1e-3
STIFF = np.eye(3) * 1e15
AT = np.array([-0.7, 0.4, 1.1])


def matched(
    maps: Maps, points: Points, start: FloatArray, prior: FloatArray, information: FloatArray
) -> tuple[FloatArray, FloatArray, tuple[float, int, int, float]]:
    """Pose, Hessian, and what ``match`` returns."""
    pose, hessian = start.copy(), np.full((3, 3), np.nan)
    result = matching.match(*maps.layers(0), points.hits, pose, prior, information, SIGMA, hessian)
    return pose, hessian, result


def agree(
    maps: Maps, points: Points, pose: FloatArray, hessian: FloatArray, result: tuple[float, int, int, float]
) -> None:
    expected = reference.evaluate(maps, points.hits, pose, SIGMA)
    assert result[1:3] == (expected.near, expected.free)
    np.testing.assert_allclose(result[0], expected.fit, rtol=1e-6)
    np.testing.assert_allclose(result[3], expected.log_likelihood, rtol=1e-6, atol=1e-9)
    scale = max(1.0, float(np.abs(expected.hessian).max()))
    np.testing.assert_allclose(hessian / scale, expected.hessian / scale, atol=1e-6)


def test_the_evaluation_of_a_pose_agrees_with_the_reference() -> None:
    """A stiff prior keeps the pose: good ones, bad ones, and ones outside the map."""
    maps = room()[2]
    rng = np.random.default_rng(1)
    (points,) = look(ROOM, AT[None])
    poses = np.vstack((
        AT + rng.normal(0.0, [0.02, 0.02, 0.01], (5, 3)),
        AT + rng.normal(0.0, [0.3, 0.3, 0.2], (10, 3)),
        rng.uniform([-8, -8, -np.pi], [8, 8, np.pi], (10, 3)),
        [[7.99, 0.0, 0.2], [-8.01, -7.9, 0.3], [500.0, 3.0, 1.0]],
    ))  # fmt: skip
    seen = []
    for wanted in poses:
        pose, hessian, result = matched(maps, points, wanted, wanted, STIFF)
        np.testing.assert_allclose(pose, wanted, atol=1e-9)
        agree(maps, points, pose, hessian, result)
        seen.append(result)
    fits, nears, frees, _ = np.array(seen).T
    assert fits[:5].min() > 0.6 * len(points.hits)
    assert frees[5:].max() > 20
    assert nears[-1] == frees[-1] == 0


def test_posts_agree_with_the_reference() -> None:
    """Surfels without a common normal pull in both directions."""
    rng = np.random.default_rng(5)
    posts = rng.uniform(-3, 3, (12, 2))
    hits = np.hstack((posts, np.zeros((12, 2)))).astype(np.float32)
    points = Points(hits, np.empty((0, 2), np.float32), np.zeros(2))
    maps = drawn([points], np.zeros((1, 3)))
    assert reference.evaluate(maps, hits, np.zeros(3), SIGMA).pairings[0].directions.shape == (2, 2)
    start = np.array([0.03, -0.05, 0.01])
    pose, hessian, result = matched(maps, points, start, start, STIFF)
    agree(maps, points, pose, hessian, result)
    pose, hessian, result = matched(maps, points, start, start, LOOSE)
    np.testing.assert_allclose(pose, 0.0, atol=1e-4)
    agree(maps, points, pose, hessian, result)


@pytest.mark.parametrize("weight", [1.0, 1e3, 1e5])
def test_the_result_is_at_a_minimum_of_the_cost(weight: float) -> None:
    maps = room()[2]
    information = weight * np.array([[3.0, 1.0, 0.2], [1.0, 2.0, -0.1], [0.2, -0.1, 5.0]])
    places = AT + np.array([[0.0, 0.0, 0.0], [0.5, -0.2, 2.0], [-1.0, 0.5, -2.5]])
    for at, points in zip(places, look(ROOM, places), strict=True):
        prior = at + np.array([0.04, -0.06, 0.03])
        pose, hessian, result = matched(maps, points, prior, prior, information)
        agree(maps, points, pose, hessian, result)
        pairings = reference.evaluate(maps, points.hits, pose, SIGMA).pairings

        def cost(millis: FloatArray, pose: FloatArray = pose, prior: FloatArray = prior, kept: Any = pairings) -> float:
            return reference.cost(kept, pose + 1e-3 * millis, prior, information)

        assert np.abs(minimize(cost, np.zeros(3), method="BFGS", options={"gtol": 1e-4}).x).max() < 0.5
        assert np.linalg.norm((pose - prior)[:2]) > 1e-3  # it did move


def test_known_offsets_are_recovered() -> None:
    maps = room()[2]
    rng = np.random.default_rng(3)
    places = np.array([AT, [1.0, 1.0, -2.0], [3.5, 0.5, 3.1], [-3.0, -0.5, 0.0]])
    for place, points in zip(places, look(ROOM, places), strict=True):
        for offset in rng.uniform([-0.12, -0.12, -0.06], [0.12, 0.12, 0.06], (8, 3)):
            pose, _, (fit, near, free, _) = matched(maps, points, place + offset, place + offset, LOOSE)
            assert np.hypot(*(pose - place)[:2]) < 0.01
            assert abs(pose[2] - place[2]) < math.radians(0.3)
            assert fit > 0.9 * (near + free)


def test_along_a_corridor_only_the_prior_knows() -> None:
    for heading in (0.0, 0.6):
        poses = np.array([[0.1 * i, 0.0, 0.0] for i in range(8)])
        turned = se2.compose(np.array([0.0, 0.0, heading]), poses)
        maps = drawn(look(CORRIDOR, poses, sensing_range=7.0), turned)
        (points,) = look(CORRIDOR, np.array([[0.33, 0.05, 0.02]]), sensing_range=7.0)
        true = se2.compose(np.array([0.0, 0.0, heading]), np.array([0.33, 0.05, 0.02]))
        prior = true + 0.2 * np.array([math.cos(heading), math.sin(heading), 0.0])
        pose, hessian, _ = matched(maps, points, prior, prior, np.diag([400.0, 400.0, 400.0]))
        off = se2.between(true, pose)
        assert abs(off[0]) > 0.17  # as far as the prior says,
        assert abs(off[1]) < 0.01  # but between the walls
        assert abs(off[2]) < math.radians(0.3)
        # What the scan knows of the position once the heading is given up.
        position = hessian[:2, :2] - np.outer(hessian[:2, 2], hessian[2, :2]) / hessian[2, 2]
        (weak, strong), vectors = np.linalg.eigh(position)
        assert weak < 0.05 * strong
        assert abs(vectors[:, 0] @ (math.cos(heading), math.sin(heading))) > 0.99


@pytest.mark.parametrize("hits", [0, 1])
def test_with_nothing_to_match_the_prior_stays(hits: int) -> None:
    nothing = Points(np.ones((hits, 4), np.float32), np.empty((0, 2), np.float32), np.zeros(2))
    prior = np.array([0.3, -0.2, 0.1])
    pose, hessian, result = matched(Maps.empty(1, 8.0, RESOLUTION), nothing, prior + 0.01, prior, np.eye(3) * 100.0)
    np.testing.assert_allclose(pose, prior, atol=1e-9)
    np.testing.assert_array_equal(hessian, 0.0)
    assert result == (0.0, 0, 0, 0.0)


def search(
    maps: Maps, hits: reference.Floats, centre: FloatArray, reach: tuple[int, int], information: FloatArray, peaks: int
) -> tuple[FloatArray, FloatArray]:
    """Lattice of 0.15 m and 0.05 rad, ``reach`` steps to each side."""
    places, scores = np.full((peaks, 3), np.nan), np.full(peaks, np.nan)
    found = matching.search(
        *maps.layers(0), hits, centre, (reach[0] - 0.5) * 0.15, 0.15, (reach[1] - 0.5) * 0.05, 0.05, information, 1,
        places, scores,
    )  # fmt: skip
    return places[:found], scores[:found]


@pytest.mark.parametrize("near_border", [False, True])
def test_search_agrees_with_brute_force(near_border: bool) -> None:
    maps = room()[2]
    centre = np.array([7.7, -7.6, 2.0]) if near_border else AT + np.array([0.31, -0.27, 0.12])
    (points,) = look(ROOM, AT[None])
    hits = points.hits[::9].copy()
    information = np.array([[9.0, 2.0, 0.0], [2.0, 6.0, 1.0], [0.0, 1.0, 30.0]])
    places, scores = search(maps, hits, centre, (3, 3), information, 6)
    lattice = [
        centre + np.array([0.15 * i, 0.15 * j, 0.05 * k])
        for i in range(-3, 4)
        for j in range(-3, 4)
        for k in range(-3, 4)
    ]
    expected = [reference.search_score(maps, hits, pose, centre, information) for pose in lattice]
    assert scores[0] == pytest.approx(max(expected), abs=1e-9)
    assert (np.diff(scores) <= 0).all()
    for place, score in zip(places, scores, strict=True):
        assert score == pytest.approx(reference.search_score(maps, hits, place, centre, information), abs=1e-9)
        assert min(np.abs(np.array(lattice) - place).max(axis=1)) < 1e-9
    # Nothing better was left out but what a better peak stands for.
    for pose, score in zip(lattice, expected, strict=True):
        if score > scores[-1] + 1e-9:
            steps = np.abs(places - pose) / (0.15, 0.15, 0.05)
            assert (scores[(steps < 4.1).all(axis=1)] >= score - 1e-9).any()


def test_peaks_of_a_search_are_apart() -> None:
    """None of them stands for the same place as another."""
    maps = room()[2]
    steps = np.array([0.15, 0.15, 0.05])
    for at in np.random.default_rng(0).uniform([-3, -2, -3], [1.5, 1.5, 3], (8, 3)):
        (points,) = look(ROOM, at[None])
        places, _ = search(maps, points.hits[::2].copy(), at + np.array([0.1, -0.2, 0.1]), (8, 8), np.eye(3), 32)
        assert len(places) > 10
        offsets = np.abs(places[:, None] - places) / steps + 9.0 * np.eye(len(places))[..., None]
        assert offsets.max(axis=-1).min() > 2.0


def test_a_search_without_hits_finds_nothing() -> None:
    places, _ = search(room()[2], np.empty((0, 4), np.float32), AT, (2, 2), np.eye(3), 3)
    assert len(places) == 0
