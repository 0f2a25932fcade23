"""Logs and trajectories on disk. The same log gives the same bytes."""

from collections.abc import Iterable
from itertools import chain
from pathlib import Path

import numpy as np

from frontend import writers
from frontend.records import FloatArray
from frontend.writers.text import new_text
from tools.simulation.log import SimulatedLog

HOST = "simulator"


def write_carmen(log: SimulatedLog | Iterable[SimulatedLog], path: Path) -> None:
    """Writes a CARMEN log, see ``frontend.writers.write_carmen``.

    Args:
        log: a log, or its pieces in order.
        path: compressed when it ends in .gz, .bz2 or .xz.
    """
    parts = iter([log] if isinstance(log, SimulatedLog) else log)
    first = next(parts)
    laser = first.laser
    scans = (scan for part in chain([first], parts) for scan in part.scans())
    writers.write_carmen(scans, path, no_return=laser.no_return, sigma=laser.sigma, host=HOST)


def write_tum(times: FloatArray, poses: FloatArray, path: Path) -> None:
    """Writes poses (N, 3) as ``t x y z qx qy qz qw``, one a line; compressed by suffix."""
    half = poses[:, 2] / 2
    # Adding zero after rounding turns -0.0 into 0.0: the sign of nothing differs between machines.
    columns = np.round(np.column_stack((poses[:, :2], np.sin(half), np.cos(half))), 6) + 0.0
    with new_text(path) as file:
        for time, (x, y, qz, qw) in zip(times, columns, strict=True):
            file.write(f"{time:.6f} {x:.6f} {y:.6f} 0 0 0 {qz:.6f} {qw:.6f}\n")
