"""A local map as alignment takes it: surface points that know which way they face, and what they are good for."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from frontend.local_map import Bends
from frontend.records import FloatArray
from mrtm.joint.agreement import Lookup, SurfaceMap

FACING = 0.7
"""Least cosine between the normals of two points of one surface. Walls are thin: the nearest point of another map is
often on the back of the wall, in the next room, and would pull the rooms into each other."""

NEIGHBOURS = 4
"""Nearest points among which one that faces alike is looked for."""


class AlignedMap(SurfaceMap, Protocol):
    """What is needed of a local map that is to be aligned."""

    @property
    def bends(self) -> Bends:
        """How sure its parts are."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Surface:
    """A local map made ready for many alignments.

    Attributes:
        points: (n, 2) those of its cloud whose normal is known, metres, local frame.
        normals: (n, 2) of length one.
        tree: finds points.
        lookup: the grid, for comparing.
        bends: how sure the map's parts are.
    """

    points: FloatArray
    normals: FloatArray
    tree: cKDTree
    lookup: Lookup
    bends: Bends = field(default_factory=Bends)

    @classmethod
    def of(cls, local_map: AlignedMap) -> "Surface":
        """Prepare a local map."""
        known = np.einsum("ni,ni->n", local_map.normals, local_map.normals) > 0.25
        points = np.ascontiguousarray(local_map.cloud[known], np.float64)
        normals = np.ascontiguousarray(local_map.normals[known], np.float64)
        return cls(points, normals, cKDTree(points), Lookup.of(local_map), local_map.bends)


def rotation(theta: float) -> FloatArray:
    """(2, 2) turning by ``theta``."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def partners(
    a: Surface, b: Surface, a_T_b: FloatArray, reach: float, most: int | None = None
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Pairs of points of one surface: for each point of ``b`` the nearest of ``a`` that faces alike, within ``reach``.

    Args:
        a, b: two local maps.
        a_T_b: (3,) where ``b`` lies.
        reach: metres.
        most: of the points of ``b``, an even choice of about so many; all by default.

    Returns:
        (k,) indices into ``a`` and (k,) into ``b``, the latter ascending.
    """
    if len(a.points) == 0 or len(b.points) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    turned, step = rotation(a_T_b[2]), -(-len(b.points) // most) if most else 1
    points, normals = b.points[::step], b.normals[::step]
    _, near = a.tree.query(points @ turned.T + a_T_b[:2], NEIGHBOURS, distance_upper_bound=reach)
    candidates = np.where(near < len(a.points), near, 0)
    alike = np.einsum("nki,ni->nk", a.normals[candidates], normals @ turned.T) > FACING
    alike &= near < len(a.points)
    mine = np.flatnonzero(alike.any(axis=1))
    return candidates[mine, alike[mine].argmax(axis=1)].astype(np.int64), mine * step
