"""A local map as alignment takes it: surface points that know which way they face, and what they are good for."""

from dataclasses import dataclass, field
from typing import Protocol

import numba
import numpy as np
import numpy.typing as npt

from frontend.local_map import Bends
from frontend.records import FloatArray
from mrtm.joint.alignment.agreement import Lookup, SurfaceMap
from mrtm.joint.alignment.buckets import Buckets, nearest

FACING = 0.7
"""Least cosine between the normals of two points of one surface. Walls are thin: the nearest point of another map is
often on the back of the wall, in the next room, and would pull the rooms into each other."""


class AlignedMap(SurfaceMap, Protocol):
    """What is needed of a local map that is to be aligned."""

    @property
    def bends(self) -> Bends:
        """How sure its parts are."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Surface:
    """A local map made ready for many alignments.

    Attributes:
        buckets: those points of its cloud whose normal is known, local frame.
        lookup: the grid, for comparing.
        bends: how sure the map's parts are.
    """

    buckets: Buckets
    lookup: Lookup
    bends: Bends = field(default_factory=Bends)

    @classmethod
    def of(cls, local_map: AlignedMap) -> "Surface":
        """Prepare a local map."""
        known = np.einsum("ni,ni->n", local_map.normals, local_map.normals) > 0.25
        points = np.ascontiguousarray(local_map.cloud[known], np.float64)
        normals = np.ascontiguousarray(local_map.normals[known], np.float64)
        return cls(Buckets.of(points, normals), Lookup.of(local_map), local_map.bends)

    @property
    def points(self) -> FloatArray:
        """(n, 2) metres, local frame."""
        return self.buckets.points

    @property
    def normals(self) -> FloatArray:
        """(n, 2) of length one."""
        return self.buckets.normals


def rotation(theta: float) -> FloatArray:
    """(2, 2) turning by ``theta``."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def partners(
    a: Surface, b: Surface, a_T_b: FloatArray, reach: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Pairs of points of one surface: for each point of ``b`` the nearest of ``a`` that faces alike, within ``reach``.

    Args:
        a, b: two local maps.
        a_T_b: (3,) where ``b`` lies.
        reach: metres.

    Returns:
        (k,) indices into ``a`` and (k,) into ``b``, the latter ascending.
    """
    found = np.empty(len(b.points), np.int64)
    turned = rotation(a_T_b[2])
    _partners(a.points, a.normals, a.buckets.low, a.buckets.starts,
              b.points @ turned.T + a_T_b[:2], b.normals @ turned.T, reach, found)  # fmt: skip
    mine = np.flatnonzero(found >= 0)
    return found[mine], mine


@numba.njit(cache=True)
def _partners(a_points, a_normals, low, starts, points, normals, reach, found):  # type: ignore[no-untyped-def]
    for j in range(len(points)):
        found[j] = nearest(a_points, a_normals, low, starts,
                           points[j, 0], points[j, 1], normals[j, 0], normals[j, 1], reach, FACING)  # fmt: skip
