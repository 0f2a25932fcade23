"""The fields of records: their bounds, and the one error of what lies outside them."""

import reprlib
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from factors import FactorError, VertexId, check_pose
from mrtm.errors import MrtmError

LONGEST_NAME = 64
"""Bytes in UTF-8, as file systems count."""
NAME = f"a name of at most {LONGEST_NAME} letters (bytes in UTF-8), digits or - _ ."
LARGEST_NUMBER = 2**31 - 1
FARTHEST = 1e6
"""Metres; no coordinate of a building lies beyond."""
SUREST, VAGUEST = 1e-6, 1e4
"""Standard deviations, metres or radians: their squares are fit for variances."""
LATEST = 1e12
"""Seconds, either way."""
LARGEST_GRID = 4000
"""Cells along one side."""
MOST_PLACES = 64
"""Of a local map whose sureness is told."""

MOST_POINTS = 2**20
"""Occupied cells of a grid, points of a cloud."""
FINEST, COARSEST = 0.001, 10.0
"""Metres a cell."""


class RecordError(MrtmError):
    """A record that does not check: which, which field, the value, and what it must be."""


def check(good: bool, what: str, field: str, value: Any, must: str) -> None:
    """Raise RecordError unless ``good``; ``what`` names the record. So do all checks below."""
    if not good:
        text = value if isinstance(value, str) and value.isprintable() and len(value) < 100 else reprlib.repr(value)
        raise RecordError(f"{what}: {field} is {text}; must be {must}")


def is_name(name: Any) -> bool:
    """Whether it does as a robot's name: as a file's on every system."""
    return isinstance(name, str) and name != "" and fit_name(name) == name


def fit_name(name: str) -> str:
    """The name as a file's: what is fit for none is replaced by _, and what is too long is cut off."""
    name = "".join("_" if letter in '/\\:*?"<>|' or not letter.isprintable() else letter for letter in name)
    return name.strip(" .").encode()[:LONGEST_NAME].decode(errors="ignore").rstrip(" .")


def check_name(name: Any, what: str, field: str) -> None:
    """Refuse what is no robot's name."""
    check(is_name(name), what, field, name, NAME)


def check_frame(what: str, shape: tuple[int, ...], resolution: float, origin: npt.ArrayLike) -> None:
    """Refuse a grid whose shape, resolution (metres) or origin (metres) is out of bounds."""
    sides = f"two sides of 1 to {LARGEST_GRID} cells"
    check(len(shape) == 2 and all(1 <= side <= LARGEST_GRID for side in shape), what, "shape", shape, sides)
    check(FINEST <= resolution <= COARSEST, what, "resolution", resolution, f"{FINEST:g} to {COARSEST:g} m")
    check_array(np.asarray(origin), (2,), np.float64, what, "origin")


def check_whole(value: Any, what: str, field: str) -> None:
    """Refuse what is not a whole number from 0 to LARGEST_NUMBER."""
    good = type(value) is int and 0 <= value <= LARGEST_NUMBER
    check(good, what, field, value, f"a whole number from 0 to {LARGEST_NUMBER}")


def check_real(value: Any, limit: float, what: str, field: str) -> None:
    """Refuse what is not a number within plus and minus ``limit``."""
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= limit  # false for NaN
    check(good, what, field, value, f"a number within plus and minus {limit:g}")


def check_vertex(vertex: VertexId, what: str, field: str) -> None:
    """Refuse a vertex whose robot or index does not check."""
    check_name(vertex.robot, what, field)
    check_whole(vertex.number, what, field)


def check_position(pose: gtsam.Pose2, what: str, field: str) -> None:
    """Refuse a pose that is not finite or lies too far out."""
    try:
        check_pose(pose, what)
    except FactorError as error:
        raise RecordError(str(error)) from error
    check(max(abs(pose.x()), abs(pose.y())) <= FARTHEST, what, field, (pose.x(), pose.y()), f"within {FARTHEST:g} m")


def check_array(array: npt.NDArray[Any], shape: tuple[int, ...], dtype: Any, what: str, field: str) -> None:
    """Refuse an array of another shape or type, or with a number that is not within plus and minus FARTHEST."""
    good = array.shape == shape and array.dtype == dtype
    check(good, what, field, f"{array.dtype} {array.shape}", f"{np.dtype(dtype)} {shape}")
    if array.size:
        least, most = float(array.min()), float(array.max())  # NaN if any is
        good = least >= -FARTHEST and most <= FARTHEST
        check(good, what, field, (least, most), f"numbers within plus and minus {FARTHEST:g}")
