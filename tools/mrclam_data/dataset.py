"""Files of an UTIAS MRCLAM data set (Leung et al. 2011, "The UTIAS multi-robot cooperative localization and mapping
dataset", IJRR 30(8)): wheel commands, range and bearing by camera to barcodes, motion-capture truth."""

import lzma
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from frontend.records import FloatArray
from mrtm.evaluation import TimedPoses


class DatasetError(ValueError):
    """A data set that is not there or not readable: which file and why."""


@dataclass(frozen=True, slots=True)
class RobotLog:
    """What one robot recorded, SI units, times in seconds.

    Attributes:
        odometry: (n, 3) time, forward and angular velocity, each holding until the next.
        sightings: (m, 4) time, robot seen (its subject number), range, bearing; landmarks are left out.
        truth: world_T_robot by motion capture.
    """

    odometry: FloatArray
    sightings: FloatArray
    truth: TimedPoses


def read_dataset(folder: Path) -> dict[int, RobotLog]:
    """Every robot of a data set by subject number; files may be plain ``.dat`` or ``.dat.xz``.

    Raises:
        DatasetError: a file is missing or a line of it is not what its kind holds.
    """
    subject_of = {int(barcode): int(subject) for subject, barcode in _table(folder, "Barcodes", 2)}
    robots = sorted(int(path.name[5:].partition("_")[0]) for path in folder.glob("Robot*_Odometry.dat*"))
    if not robots:
        raise DatasetError(f"{folder}: no Robot*_Odometry.dat here; unpack an MRCLAM data set, or name its folder")
    logs = {}
    for robot in robots:
        measured = _table(folder, f"Robot{robot}_Measurement", 4)
        subjects = np.array([subject_of.get(int(barcode), 0) for barcode in measured[:, 1]])
        seen = np.isin(subjects, robots) & (subjects != robot)
        sightings = np.column_stack([measured[:, 0], subjects, measured[:, 2:]])[seen]
        truth = _table(folder, f"Robot{robot}_Groundtruth", 4)
        logs[robot] = RobotLog(
            odometry=_table(folder, f"Robot{robot}_Odometry", 3),
            sightings=sightings,
            truth=TimedPoses(truth[:, 0], truth[:, 1:]),
        )
    return logs


def _table(folder: Path, name: str, columns: int) -> FloatArray:
    """(n, columns), finite, times ascending."""
    path = next((p for p in (folder / f"{name}.dat", folder / f"{name}.dat.xz") if p.exists()), None)
    if path is None:
        raise DatasetError(f"{folder / name}.dat: not there, nor with .xz")
    try:
        with lzma.open(path, "rt") if path.suffix == ".xz" else path.open() as file:
            rows = np.loadtxt(file, ndmin=2)
    except (OSError, ValueError, EOFError, lzma.LZMAError) as error:
        raise DatasetError(f"{path}: {error}") from error
    if rows.shape[1:] != (columns,) or not np.isfinite(rows).all():
        raise DatasetError(f"{path}: expected {columns} finite numbers a line")
    return rows[np.argsort(rows[:, 0], kind="stable")] if columns > 2 else rows
