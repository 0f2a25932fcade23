"""Which variables of a large graph are linearised anew, and when: a portion at a time.

What a large graph makes others wait for is to linearise it anew: at a loop that turns half of it, all that half. Two
things tame that. A factor between two poses is linear in their positions, so that a part which moves far and turns
little need not be linearised anew: what is left is of the second order in the turn. And the work comes in portions of
neighbours, which share most of what has to be eliminated again, around the variable that needs it most: in updates that
only add vertices, which have little else to do. See ``python -m tools.benchmark --backend``.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

TURN = 2e-3
"""Radians by which a variable may turn from where it was linearised."""


def portion(poses: Callable[[], FloatArray], turn: FloatArray, most: int) -> IntArray:
    """Rows of the variables to linearise anew: of more than ``most`` those around the one that has turned most.

    Args:
        poses: gives (n, 3) joint_T_variable where they were linearised, if that is wanted: it takes long.
        turn: (n,) radians from there to the estimate, either way.
        most: so many rows at most.
    """
    due = np.flatnonzero(turn >= TURN)
    if len(due) <= most:
        return due
    positions = poses()[due, :2]
    distance = np.hypot(*(positions - positions[np.argmax(turn[due])]).T)
    return due[np.argsort(distance, kind="stable")[:most]]
