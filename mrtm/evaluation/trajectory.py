"""Trajectories as the evaluation needs them: read from a file, asked for the pose at a time."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from frontend import se2
from frontend.records import FloatArray
from mrtm.evaluation.errors import EvaluationError
from mrtm.team.checks import FARTHEST, LATEST

MAX_GAP = 0.3
"""Seconds: a pose is interpolated only between scans this close to the time asked for (Kuemmerle et al. 2009)."""

COINCIDENT = 1e-3
"""Seconds: a scan this close to the time asked for will do alone, however far away its neighbour is."""


@dataclass(frozen=True, slots=True)
class TimedPoses:
    """Poses at times: ``times`` (n,) seconds, ``poses`` (n, 3) world_T_robot."""

    times: FloatArray
    poses: FloatArray


def read_tum(path: Path) -> TimedPoses:
    """Read planar poses from a TUM file, lines ``t x y z qx qy qz qw``, ``#`` starting a comment.

    Raises:
        EvaluationError: the file or a line of it cannot be read, or it holds relations.
    """
    rows = read_rows(path, "t x y z qx qy qz qw")
    if not rows[:, 4:7].any() and np.ptp(np.abs(rows[:, 7])) > 0.01:  # a relation's angle stands where qw would
        raise EvaluationError(f"{path}: no trajectory: turns about nothing, as in a file of relations; give it as such")
    largest = np.abs(rows[:, 4:]).max(axis=1)
    if not np.all(largest > 0):
        raise EvaluationError(f"{path}: pose {int(np.argmin(largest)) + 1} has a quaternion of length zero")
    qx, qy, qz, qw = (rows[:, 4:] / largest[:, None]).T  # of any length
    yaw = np.arctan2(2 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2)
    return TimedPoses(rows[:, 0], np.column_stack([rows[:, 1:3], yaw]))


def read_rows(path: Path, columns: str) -> FloatArray:
    """Read a text table of the named columns, (n, len(columns)); blank lines and ``#`` comments are skipped.

    Raises:
        EvaluationError: the file cannot be read, holds nothing, or a line is not that many numbers within bounds.
    """
    names = columns.split()
    width = len(names)
    rows: list[list[float]] = []
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise EvaluationError(f"{path}: cannot be read ({reason})") from error
    for number, line in enumerate(text.splitlines(), 1):
        fields = line.partition("#")[0].split()
        if not fields:
            continue
        try:
            row = [float(field) for field in fields]
        except ValueError:
            row = []
        if len(row) != width or not all(map(math.isfinite, row)):
            found = line.strip()[:80]
            raise EvaluationError(f"{path}:{number}: expected the {width} numbers `{columns}`, found {found!r}")
        for name, value in zip(names, row, strict=True):
            limit = LATEST if name.startswith("t") else FARTHEST
            if abs(value) > limit:
                raise EvaluationError(f"{path}:{number}: {name} is {value:g}; must be within plus and minus {limit:g}")
        rows.append(row)
    if not rows:
        raise EvaluationError(f"{path}: no line `{columns}` in it")
    return np.array(rows)


def no_common_time(path: Path, times: FloatArray, runs: Iterable[TimedPoses]) -> EvaluationError:
    """The error of a file none of whose ``times`` is one of the run's scans."""
    known = np.concatenate([run.times for run in runs])
    theirs, ours = (f"{t.min():.1f} to {t.max():.1f} s" for t in (times, known))
    return EvaluationError(f"{path}: not of this run: no scan at its times, {theirs}; those of the run are {ours}")


def interpolate(
    trajectory: TimedPoses, times: FloatArray, max_gap: float = MAX_GAP
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """The poses at ``times`` (m,), moving with constant velocity in SE(2) between the two nearest scans in time.

    The trajectory need not be sorted: a log's clock may step back; of equal times the first counts.

    Returns:
        The poses (m, 3), NaN where there is none, and whether there is one (m,): both scans around the time are within
        ``max_gap`` seconds of it, or one coincides with it. Nothing is extrapolated.
    """
    known, first = np.unique(trajectory.times, return_index=True)  # the index of the first of equal times
    poses = trajectory.poses[first]
    if len(known) == 0:
        return np.full((len(times), 3), np.nan), np.zeros(len(times), dtype=np.bool_)
    after = np.searchsorted(known, times).clip(0, len(known) - 1)
    before = np.maximum(after - 1, 0)
    to_before, to_after = times - known[before], known[after] - times
    nearest = np.where(np.abs(to_before) <= np.abs(to_after), before, after)
    coincident = np.abs(times - known[nearest]) <= COINCIDENT
    between = (np.minimum(to_before, to_after) >= 0) & (np.maximum(to_before, to_after) <= max_gap)
    found = between | coincident
    span = np.where(after > before, known[after] - known[before], 1.0)
    fraction = (to_before / span).clip(0.0, 1.0)[:, None]
    moved = se2.compose(poses[before], _exp(fraction * se2.log(se2.between(poses[before], poses[after]))))
    return np.where(found[:, None], np.where(between[:, None], moved, poses[nearest]), np.nan), found


def _exp(tangent: FloatArray) -> FloatArray:
    """The poses (n, 3) reached by moving with constant velocities (n, 3) for one unit of time."""
    half = tangent[:, 2] / 2
    chord = np.sinc(half / np.pi)  # sin(half) / half
    x, y = chord * np.cos(half), chord * np.sin(half)
    return np.column_stack(
        [x * tangent[:, 0] - y * tangent[:, 1], y * tangent[:, 0] + x * tangent[:, 1], se2.wrap(tangent[:, 2])]
    )
