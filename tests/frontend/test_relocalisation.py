"""Re-entry: where in a known map the robot may be, within a wide covariance."""

import math

import numpy as np
import pytest

from frontend import se2
from frontend.points import Points
from frontend.records import FloatArray
from frontend.relocalisation import APART_THETA, APART_XY, hypotheses
from tests.frontend.simulated import PARAMETERS, ROOM, drawn, look, room
from tools.simulation import FloorPlan

PLACES = np.array([[-0.7, 0.4, 1.1], [0.5, 1.0, -2.9], [-2.0, 0.3, 0.2]])
WIDE = np.diag([0.6**2, 0.6**2, 0.2**2])


def are_apart(poses: FloatArray) -> None:
    for i in range(len(poses)):
        offsets = np.abs(se2.between(poses[i], poses[i + 1 :]))
        assert ((np.hypot(offsets[:, 0], offsets[:, 1]) >= APART_XY) | (offsets[:, 2] >= APART_THETA)).all()


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (1.1, -0.7, 0.4), (-1.0, 1.2, -0.35)])
def test_the_true_pose_is_found_in_a_wide_guess(place: FloatArray, offset: tuple[float, float, float]) -> None:
    maps = room()[2]
    (points,) = look(ROOM, place[None])
    guess = se2.compose(place, np.array(offset))
    poses, scores = hypotheses(maps, points, guess, WIDE, PARAMETERS)
    off = se2.between(place, poses[0])
    assert np.hypot(off[0], off[1]) < 0.03
    assert abs(off[2]) < math.radians(0.5)
    assert len(poses) == len(scores) >= 1
    assert (np.diff(scores) <= 0).all()
    assert scores[0] > 0.8
    assert (scores[1:] < 0.6).all()
    assert (np.abs(poses[:, 2]) <= np.pi).all()
    are_apart(poses)


def test_a_long_covariance_is_searched_along_its_length() -> None:
    """Given in the robot's frame: two metres ahead or behind, and the robot faces along y."""
    place = np.array([0.3, 0.4, np.pi / 2])
    (points,) = look(ROOM, place[None])
    guess = se2.compose(place, np.array([-1.8, 0.0, 0.0]))
    ahead, aside = np.diag([0.8**2, 0.01**2, 0.02**2]), np.diag([0.01**2, 0.8**2, 0.02**2])
    poses, scores = hypotheses(room()[2], points, guess, ahead, PARAMETERS)
    assert np.hypot(*(poses[0] - place)[:2]) < 0.03
    # Sideways that far is not to be believed: what the guess says costs.
    assert hypotheses(room()[2], points, guess, aside, PARAMETERS)[1][0] < scores[0]


def test_look_alikes_are_all_found_and_the_nearer_one_first() -> None:
    """Two rooms alike, side by side, are both kept; the guess decides."""
    walls: list[tuple[float, ...]] = []
    boxes: list[tuple[float, ...]] = []
    for x in (-2.0, 2.0):
        walls += [(x - 1.9, -1.5, x + 1.9, -1.5), (x + 1.9, -1.5, x + 1.9, 1.5), (x + 1.9, 1.5, x - 1.9, 1.5)]
        walls += [(x - 1.9, 1.5, x - 1.9, -1.5)]
        boxes += [(x + 1.0, 0.7, 0.5, 0.4, 0.2), (x - 1.2, -0.6, 0.3, 0.6, 0.0)]
    twins = FloorPlan("twins", walls, boxes)
    views = ((0.0, 0.0), (0.4, 2.0), (-0.3, 4.0))
    poses = np.array([[x + dx, 0.1 * dx, heading] for x in (-2, 2) for dx, heading in views])
    maps = drawn(look(twins, poses), poses)
    (points,) = look(twins, np.array([[-1.9, 0.1, 0.3]]))
    wide = np.diag([1.5**2, 0.4**2, 0.1**2])
    for side in (-1, 1):
        found, scores = hypotheses(maps, points, np.array([0.1 + side * 0.9, 0.1, 0.3]), wide, PARAMETERS)
        expected = np.array([-1.9, 2.1])[::-side]
        np.testing.assert_allclose(found[:2, 0], expected, atol=0.03)
        assert scores[0] - scores[1] < 0.1
        are_apart(found)


def test_without_endpoints_there_are_no_hypotheses() -> None:
    nothing = Points(np.empty((0, 4), np.float32), np.empty((0, 2), np.float32), np.zeros(2))
    poses, scores = hypotheses(room()[2], nothing, np.zeros(3), WIDE, PARAMETERS)
    assert poses.shape == (0, 3)
    assert scores.shape == (0,)


@pytest.mark.parametrize("guess", [(7.9, -7.9, 1.0), (60.0, 3.0, 0.0)])
def test_a_guess_at_the_border_or_outside(guess: tuple[float, float, float]) -> None:
    (points,) = look(ROOM, PLACES[:1])
    poses, scores = hypotheses(room()[2], points, np.array(guess), WIDE, PARAMETERS)
    assert len(poses) == len(scores)
    assert np.isfinite(poses).all()
    assert (scores < 0.6).all()
