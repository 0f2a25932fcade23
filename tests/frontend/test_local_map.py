"""How sure the parts of a local map are: what is drawn from several places, whose errors partly go together."""

import numpy as np
import pytest

from frontend import se2
from frontend.local_map import Bends
from frontend.records import FloatArray

RUNS = 20_000


def errors_at(bends: Bends, *points: tuple[float, float]) -> FloatArray:
    return bends.errors(bends.shares(np.array(points)))


def test_the_error_of_one_place_is_that_of_everything() -> None:
    covariance = np.diag([4e-4, 1e-4, 1e-6])
    bends = Bends(np.array([[2.0, 1.0]]), covariance[None])
    np.testing.assert_allclose(errors_at(bends, (2.0, 1.0), (9.0, -5.0)), [covariance] * 2, rtol=1e-9)


def test_nearer_places_have_a_larger_share() -> None:
    bends = Bends(np.array([[0.0, 0.0], [10.0, 0.0]]), np.stack([np.eye(3)] * 2))
    shares = bends.shares(np.array([[0.0, 0.0], [5.0, 3.0], [9.0, 0.0]]))
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    assert shares[0, 0] > 0.9
    np.testing.assert_allclose(shares[1], 0.5)
    assert shares[2, 1] > 0.9


def test_poses_are_carried_to_the_origin() -> None:
    """A pose that is off in its own frame moves what lies there as its map, moved about the origin, would."""
    rng = np.random.default_rng(0)
    pose, covariance = np.array([4.0, -2.0, 2.0]), np.diag([1e-4, 4e-4, 1e-5])
    (found,) = Bends().extended(pose[None], covariance[None]).covariances
    own = rng.multivariate_normal(np.zeros(3), covariance, RUNS)
    moved = se2.compose(se2.compose(pose, own), se2.inverse(pose))  # small: the pose itself is its tangent vector
    np.testing.assert_allclose(np.cov(se2.log(moved).T), found, rtol=0.06, atol=1e-5)


@pytest.mark.parametrize("ends", [(0.0, 20.0), (-10.0, 10.0), (-4.0, 16.0)])
def test_errors_that_gather_on_the_way_go_together_as_far_as_the_way_does(ends: tuple[float, float]) -> None:
    """Monte Carlo: a robot drives away from the origin to both sides, and errs on each step by as much again."""
    rng = np.random.default_rng(1)
    x = np.arange(ends[0], ends[1] + 1.0)
    steps = rng.normal(0.0, 0.01, (RUNS, len(x)))
    out, back = np.where(x > 0.0, steps, 0.0), np.where(x < 0.0, steps, 0.0)
    walks = out.cumsum(axis=1) + back[:, ::-1].cumsum(axis=1)[:, ::-1]
    covariances = np.zeros((len(x), 3, 3))
    covariances[:, 0, 0] = 0.01**2 * np.abs(x)
    bends = Bends(np.column_stack([x, np.zeros(len(x))]), covariances)
    shares = np.stack([np.full(len(x), 1.0 / len(x)), bends.shares(np.array([[6.0, 0.0]]))[0]])
    expected = (walks @ shares.T).var(axis=0)
    np.testing.assert_allclose(bends.errors(shares)[:, 0, 0], expected, rtol=0.05)


def test_what_lies_between_places_follows_both() -> None:
    bends = Bends(np.array([[0.0, 0.0], [4.0, 0.0], [10.0, 0.0], [0.0, 5.0]]), np.stack([np.eye(3)] * 4))
    found = bends.following(np.array([[0.0, 0.0], [4.0, 0.0], [7.0, 0.0], [12.0, 0.0], [2.0, 0.0]]))
    np.testing.assert_allclose(found[0], 0.0, atol=1e-6)  # the origin stays
    expected = [[1.0, 0.0], [0.5, 0.5], [0.0, 1.0], [0.5, 0.0]]
    np.testing.assert_allclose(found[1:, 1:3], expected, atol=0.01)
    np.testing.assert_allclose(found[:, 3], 0.0, atol=0.05)  # its way has little in common with theirs
    at_places = bends.following(bends.places)
    np.testing.assert_allclose(at_places[1:], np.eye(4)[1:], atol=1e-5)


def test_errors_are_covariances_whatever_the_places() -> None:
    rng = np.random.default_rng(2)
    places = np.concatenate([rng.normal(0.0, 5.0, (60, 2)), np.zeros((2, 2))])  # two at the origin itself
    roots = rng.normal(0.0, 0.01, (62, 3, 3))
    bends = Bends(places, roots @ np.swapaxes(roots, -1, -2))
    found = errors_at(bends, *map(tuple, rng.normal(0.0, 10.0, (20, 2))))
    np.testing.assert_allclose(found, np.swapaxes(found, -1, -2), atol=1e-15)
    assert np.linalg.eigvalsh(found).min() > 0.0
