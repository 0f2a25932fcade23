"""Which variables of a large graph are linearised anew, and when: a portion at a time.

What a large graph makes others wait for is to linearise it anew: at a loop that turns half of it, all that half. Two
things tame that. A factor between two poses is linear in their positions, so that a part which moves far and turns
little need not be linearised anew: what is left is of the second order in the turn. Only a kernel cares for positions,
since its weight is that of the residual where it was linearised. And the work comes in portions of neighbours, which
share most of what has to be eliminated again, around the variable that needs it most: in updates that only add
vertices, which have little else to do. See ``python -m tools.benchmark --backend``.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_TURN = 5e-3  # rad, a variable may turn so far from where it was linearised
_KERNEL_SHIFT = 5e-3  # m, the ends of a kernel may move so far against each other, from where it was linearised
_KERNEL_TURN = 1e-3  # rad, and turn so far


def portion(poses: Callable[[], FloatArray], change: FloatArray, kernels: IntArray, most: int) -> IntArray:
    """Rows of the variables to linearise anew: of more than ``most`` those around the one that needs it most.

    Args:
        poses: gives (n, 3) joint_T_variable where they were linearised, if that is wanted: it takes long.
        change: (n, 3) from there to the estimate, each in the frame of its variable.
        kernels: (m, 2) rows of the ends of every factor with a kernel.
        most: so many rows at most.
    """
    need = np.abs(change[:, 2]) / _TURN  # from 1 on
    if len(kernels):
        shift, turn = _strain(poses(), change, kernels)
        for end in kernels.T:
            np.maximum.at(need, end, np.maximum(shift / _KERNEL_SHIFT, turn / _KERNEL_TURN))
    due = np.flatnonzero(need >= 1.0)
    if len(due) <= most:
        return due
    positions = poses()[due, :2]
    distance = np.hypot(*(positions - positions[np.argmax(need[due])]).T)
    return due[np.argsort(distance, kind="stable")[:most]]


def _strain(poses: FloatArray, change: FloatArray, pairs: IntArray) -> tuple[FloatArray, FloatArray]:
    """(m,) metres and (m,) radians by which ``change`` moves the second of each pair, seen from the first."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    forward, left, turn = change.T
    moved = poses + np.column_stack([cos * forward - sin * left, sin * forward + cos * left, turn])
    shift = np.hypot(*(_seen(moved, pairs) - _seen(poses, pairs)).T)
    return shift, np.abs(turn[pairs[:, 1]] - turn[pairs[:, 0]])


def _seen(poses: FloatArray, pairs: IntArray) -> FloatArray:
    """(m, 2) the position of the second of each pair, in the frame of the first."""
    tail, head = poses[pairs[:, 0]], poses[pairs[:, 1]]
    cos, sin = np.cos(tail[:, 2]), np.sin(tail[:, 2])
    x, y = (head - tail)[:, :2].T
    return np.column_stack([cos * x + sin * y, cos * y - sin * x])
