"""Which variables of a large graph are linearised anew."""

import gtsam
import numpy as np
import pytest

from mrtm.joint.relinearization import FloatArray, portion

NO_KERNELS = np.empty((0, 2), np.int64)


def poses(count: int = 40) -> FloatArray:
    """Along a line, a metre apart, each looking elsewhere."""
    return np.column_stack([np.arange(count), np.zeros(count), np.linspace(-3.0, 3.0, count)])


def never() -> FloatArray:
    raise AssertionError("poses are not wanted")


def test_only_turns_count() -> None:
    change = np.zeros((40, 3))
    change[:, :2] = 5.0
    assert not len(portion(never, change, NO_KERNELS, 10))
    change[[3, 7, 9], 2] = [0.02, -0.006, 0.004]
    assert portion(never, change, NO_KERNELS, 10).tolist() == [3, 7]


def test_too_many_are_those_around_the_worst() -> None:
    change = np.zeros((40, 3))
    change[5:35, 2] = 0.01
    change[20, 2] = -0.02
    change[21, 2] = 0.0  # has not turned, so its turn does not come
    assert sorted(portion(poses, change, NO_KERNELS, 6).tolist()) == [17, 18, 19, 20, 22, 23]


@pytest.mark.parametrize(
    ("motion", "due"),
    [
        (gtsam.Pose2(0.006, 0.0, 0.0), [4, 30]),
        (gtsam.Pose2(0.0, -0.004, 0.0), []),
        (gtsam.Pose2(0.0, 0.0, 0.0015), [4, 30]),
        (gtsam.Pose2(0.0, 0.0, -0.0005), []),
    ],
)
def test_a_kernel_cares_for_what_moves_its_ends_against_each_other(motion: gtsam.Pose2, due: list[int]) -> None:
    """All of the graph is moved far, and one end of the kernel a little more, in its own frame."""
    where, moved = poses(), gtsam.Pose2(3.0, -2.0, 0.004)
    change = np.empty((40, 3))
    for row, pose in enumerate(where):
        start = gtsam.Pose2(*pose)
        end = moved.compose(start).compose(motion if row == 30 else gtsam.Pose2())
        step = start.between(end)
        change[row] = step.x(), step.y(), step.theta()
    kernels = np.array([[4, 30], [4, 12]])
    assert portion(lambda: where, change, kernels, 10).tolist() == due
