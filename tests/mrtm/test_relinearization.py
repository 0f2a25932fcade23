"""Which variables of a large graph are linearised anew."""

import numpy as np

from mrtm.joint.relinearization import TURN, FloatArray, portion


def poses(count: int = 40) -> FloatArray:
    """Along a line, a metre apart, each looking elsewhere."""
    return np.column_stack([np.arange(count), np.zeros(count), np.linspace(-3.0, 3.0, count)])


def never() -> FloatArray:
    raise AssertionError("poses are not wanted")


def test_only_what_has_turned_far_enough_is_due() -> None:
    turn = np.zeros(40)
    assert not len(portion(never, turn, 10))
    turn[[3, 7, 9]] = [2.0 * TURN, 1.1 * TURN, 0.9 * TURN]
    assert portion(never, turn, 10).tolist() == [3, 7]


def test_too_many_are_those_around_the_worst() -> None:
    turn = np.zeros(40)
    turn[5:35] = 2.0 * TURN
    turn[20] = 4.0 * TURN
    turn[21] = 0.0  # has not turned, so its turn does not come
    assert sorted(portion(poses, turn, 6).tolist()) == [17, 18, 19, 20, 22, 23]
