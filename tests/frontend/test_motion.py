"""The odometry motion model: values by hand, and the shape of its growth."""

import numpy as np
import pytest

from frontend import motion
from frontend.parameters import MotionParameters

NOISE = MotionParameters(
    xy_floor=0.01, xy_per_metre=0.1, xy_per_radian=0.02, theta_floor=0.002, theta_per_radian=0.05, theta_per_metre=0.03
)


def test_variances_by_hand() -> None:
    xy, theta = 0.01 + 0.1 * 5.0 + 0.02 * 2.0, 0.002 + 0.05 * 2.0 + 0.03 * 5.0
    np.testing.assert_allclose(motion.variance(np.array([3.0, -4.0, -2.0]), NOISE), [xy**2, xy**2, theta**2])
    np.testing.assert_allclose(motion.variance(np.zeros(3), NOISE), [1e-4, 1e-4, 4e-6])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_longer_motion_is_less_certain_and_its_sign_does_not_matter(axis: int) -> None:
    unit = np.eye(3)[axis]
    variances = np.array([motion.variance(length * unit, NOISE) for length in (0.0, 0.1, 0.5, 2.0)])
    assert (np.diff(variances, axis=0) > 0).all()
    np.testing.assert_array_equal(motion.variance(-unit, NOISE), motion.variance(unit, NOISE))
