"""One file a vertex: its local map, compressed."""

from pathlib import Path

import numpy as np

from factors import VertexId
from frontend.local_map import Grid, LocalMap
from mrtm.output.files import replacing

UNIT = 0.05
"""Log-odds of one step of the stored int8; what does not fit is clipped to +-6.35 (p = 0.998)."""


def local_map_name(vertex: VertexId) -> str:
    """The name of a vertex's file."""
    return f"{vertex.robot}-{vertex.number}.npz"


def write_local_map(path: Path, local_map: LocalMap) -> None:
    """Write a local map: ``log_odds`` (int8 in steps of ``unit``), ``resolution``, ``origin``, ``scans``, ``times``,
    ``poses``, ``cloud``, ``normals``, as in :class:`frontend.local_map.LocalMap`."""
    grid = local_map.grid
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            log_odds=np.rint(grid.log_odds / UNIT).clip(-127, 127).astype(np.int8),
            unit=np.float64(UNIT),
            resolution=np.float64(grid.resolution),
            origin=grid.origin,
            scans=local_map.scans,
            times=local_map.times,
            poses=local_map.poses,
            cloud=local_map.cloud.astype(np.float32),  # a micrometre will do
            normals=local_map.normals.astype(np.float32),
        )


def read_local_map(path: Path) -> LocalMap:
    """Read back what :func:`write_local_map` wrote."""
    with np.load(path, allow_pickle=False) as data:
        grid = Grid(
            data["log_odds"].astype(np.float32) * np.float32(data["unit"]), float(data["resolution"]), data["origin"]
        )
        cloud, normals = data["cloud"].astype(np.float64), data["normals"].astype(np.float64)
        return LocalMap(grid, data["scans"], data["times"], data["poses"], cloud, normals)
