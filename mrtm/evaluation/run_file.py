"""What the evaluation reads of a run's ``run.json``, checked."""

from pathlib import Path
from typing import Annotated, Literal, NotRequired

import numpy as np
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from mrtm.evaluation.errors import EvaluationError
from mrtm.plain_yaml import shorten

_Number = Annotated[float, Field(gt=-1e12, lt=1e12)]  # false for NaN
_Three = tuple[_Number, _Number, _Number]


def _positive_definite(covariance: tuple[_Three, _Three, _Three]) -> tuple[_Three, _Three, _Three]:
    values = np.array(covariance)
    scale = np.abs(values).max()
    if np.abs(values - values.T).max() > 1e-6 * scale or np.linalg.eigvalsh(values)[0] <= 1e-12 * scale:
        raise ValueError("not a covariance")
    return covariance


def _file_name(robot: str) -> str:
    if not robot.isprintable() or "/" in robot or not robot:
        raise ValueError("not a name for a file, as a robot's must be")
    return robot


_Robot = Annotated[str, AfterValidator(_file_name)]
_Name = tuple[_Robot, int]
_Covariance = Annotated[tuple[_Three, _Three, _Three], AfterValidator(_positive_definite)]


class RobotEntry(TypedDict):
    component: int


class ScanEntry(TypedDict):
    time: _Number
    pose: _Three


class VertexEntry(TypedDict):
    id: _Name
    pose: _Three
    covariance: _Covariance | None
    first_scan: ScanEntry | None


class EdgeEntry(TypedDict):
    tail: _Name
    head: _Name
    kind: str
    fate: str
    measurement: NotRequired[_Three]  # a range and bearing has neither
    covariance: NotRequired[_Covariance]


def _both_or_neither(edge: EdgeEntry) -> EdgeEntry:
    if ("measurement" in edge) != ("covariance" in edge):
        raise ValueError("a measurement and a covariance belong together")
    return edge


class MeetingEntry(TypedDict):
    time: _Number
    robots: tuple[_Robot, _Robot]
    bytes: dict[str, Annotated[int, Field(ge=0, lt=2**53)]]
    verdict: Literal["accepted", "waiting", "refused"]
    reason: str


class TeamEntry(TypedDict):
    first_meeting: _Number | None
    common_frame: _Number | None
    meetings: list[MeetingEntry]


class RunFile(TypedDict):
    """The part of ``run.json`` that the evaluation needs; see the export for what the keys mean."""

    robots: Annotated[dict[_Robot, RobotEntry], Field(min_length=1)]
    components: list[Annotated[list[_Name], Field(min_length=1)]]
    vertices: list[VertexEntry]
    edges: list[Annotated[EdgeEntry, AfterValidator(_both_or_neither)]]
    team: NotRequired[TeamEntry]


def read_run(out: Path) -> RunFile:
    """Read ``out/run.json``.

    Raises:
        EvaluationError: it cannot be read, or is not what a run writes.
    """
    path = out / "run.json"
    try:
        return TypeAdapter(RunFile).validate_json(path.read_bytes())
    except OSError as error:
        raise EvaluationError(f"{path}: cannot be read ({error.strerror}); give the directory a run wrote") from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "its text"
        complaint = shorten(f"{place}: {first['msg']}")
        raise EvaluationError(f"{path}: not what a run writes ({complaint}); run again") from error
