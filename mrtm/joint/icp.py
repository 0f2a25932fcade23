"""Iterative closest points between the surfaces of two local maps, by Open3D."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from frontend.records import FloatArray
from mrtm.errors import MrtmError
from mrtm.joint.surface import Surface, partners, rotation

ROUNDS = ((0.5, 0.05, 500), (0.3, 0.05, 500), (0.15, 0.03, 4000))
"""Reach of a correspondence and scale of the robust kernel, metres, and about how many points are moved. The last
reach and scale are what noise and the cells explain."""

ITERATIONS = 15  # a round
LEAST = 30  # pairs of points below which there is nothing to align


@contextmanager
def _one_cpu() -> Iterator[None]:
    """What counts the processors within, as Open3D's TBB does when it first works, finds one (on Linux).

    Threads add up in any order, and along a corridor, where nothing but the last digits says where to stop, that moved
    the result by up to a metre from run to run. For so few points one thread is also the fastest.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


@cache
def _open3d() -> Any:
    """Open3D, loaded late: it takes half a second. Its wheel needs libusb (for cameras), which another wheel brings."""
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
        with _one_cpu():
            import open3d

            one = _cloud(open3d, np.zeros((1, 2)), np.array([[1.0, 0.0]]))
            open3d.pipelines.registration.registration_icp(one, one, 1.0)  # only now its threads are counted
    except (ImportError, OSError) as error:
        raise MrtmError(f"Open3D cannot be loaded ({error}); on a bare Linux: apt install libgl1 libx11-6") from error
    return open3d


def icp(a: Surface, b: Surface, guess: FloatArray) -> FloatArray | None:
    """Move ``b`` onto ``a``, point to line (Chen and Medioni 1991), from a guess within half a metre and 0.2 rad.

    Before each round, points that have no partner facing alike are left out: Open3D does not ask which way points
    face. The normals are ours, in the plane: Open3D's own of a flat cloud point out of it, and align nothing.

    Args:
        guess: (3,) a_T_b.

    Returns:
        (3,) a_T_b, or None where the surfaces have too little in common.

    Raises:
        MrtmError: Open3D cannot be loaded.
    """
    open3d = _open3d()
    registration = open3d.pipelines.registration
    pose = guess
    for reach, scale, most in ROUNDS:
        in_a, in_b = partners(a, b, pose, reach, most)
        if len(in_b) < LEAST:
            return None
        in_a = np.unique(in_a)
        transform = np.eye(4)
        transform[:2, :2], transform[:2, 3] = rotation(pose[2]), pose[:2]
        result = registration.registration_icp(
            _cloud(open3d, b.points[in_b], b.normals[in_b]),
            _cloud(open3d, a.points[in_a], a.normals[in_a]),
            reach,
            transform,
            registration.TransformationEstimationPointToPlane(registration.GMLoss(scale)),
            registration.ICPConvergenceCriteria(1e-7, 1e-7, ITERATIONS),
        )
        t = result.transformation
        # Where Open3D's threads are several they sum up in any order: the last digits must not come through.
        pose = np.round([t[0, 3], t[1, 3], np.arctan2(t[1, 0], t[0, 0])], 6)
        # Where nothing fixes a direction its equations are near singular and a step can go anywhere.
        if not np.isfinite(pose).all() or np.hypot(*(pose[:2] - guess[:2])) > 2.0 * ROUNDS[0][0]:
            return None
    return pose


def _cloud(open3d: Any, points: FloatArray, normals: FloatArray) -> Any:
    flat = np.zeros(len(points))
    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(np.column_stack([points, flat]))
    cloud.normals = open3d.utility.Vector3dVector(np.column_stack([normals, flat]))
    return cloud
