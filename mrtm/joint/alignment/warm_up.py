"""Alignment made ready before the first is wanted: to read its kernels from numba's cache takes longer than one."""

import gtsam
import numpy as np

from factors import UncertainPose, VertexId
from frontend.local_map import Grid, LocalMap
from mrtm.joint.alignment.align import align
from mrtm.joint.alignment.candidates import pairs
from mrtm.joint.alignment.surface import Surface

SIDE, RESOLUTION = 100, 0.05  # of a made-up room: cells, metres


def warm_up() -> None:
    """Align a made-up room with itself, once where it is sure to lie and once where it is not."""
    room = Surface.of(_room())
    here = gtsam.Pose2()
    for sigma in (0.02, 1.0):
        align(room, room, UncertainPose(here, sigma**2 * np.diag([1.0, 1.0, 0.1])))
    one, other = VertexId("made-up", 0), VertexId("made-up", 1)
    pairs({one: room, other: room}, {one: here, other: here}, lambda near: [], looks=0)


def _room() -> LocalMap:
    log_odds = np.full((SIDE, SIDE), -1.5, np.float32)
    log_odds[0], log_odds[:, 0] = 4.0, 4.0
    along = RESOLUTION * (np.arange(SIDE) + 0.5)
    wall = np.column_stack([along, np.full(SIDE, 0.5 * RESOLUTION)])
    facing = np.tile([0.0, 1.0], (SIDE, 1))
    cloud, normals = np.concatenate([wall, wall[:, ::-1]]), np.concatenate([facing, facing[:, ::-1]])
    grid = Grid(log_odds, RESOLUTION, np.zeros(2))
    return LocalMap(grid, np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)), cloud, normals)
