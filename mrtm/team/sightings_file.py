"""Who saw whom, and when: a CSV file with the columns, in any order,

    time,observer,observed,range,bearing,heading,sigma_range,sigma_bearing,sigma_heading

in seconds of team time, metres and radians. ``heading`` and ``sigma_heading`` may be blank.
"""

import csv
import difflib
import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from factors.errors import FactorError
from factors.sighting import Sighting
from mrtm.plain_yaml import shorten
from mrtm.team.checks import SUREST, VAGUEST
from mrtm.team.errors import SessionError

LARGEST = 1 << 26
"""Bytes; about a million sightings."""


@dataclass(frozen=True, slots=True)
class TimedSighting:
    """A sighting of one member of a team by another: ``time`` in seconds of team time, both by name."""

    time: float
    observer: str
    observed: str
    measurement: Sighting


_Seconds = Annotated[float, Field(ge=0.0, lt=1e10)]  # false for NaN
_Metres = Annotated[float, Field(gt=0.0, lt=1e4)]
_Angle = Annotated[float, Field(ge=-2.0 * math.pi, le=2.0 * math.pi)]  # degrees would mostly be beyond
_Sigma = Annotated[float, Field(ge=SUREST, le=VAGUEST)]
_BlankIsNone = BeforeValidator(lambda text: text.strip() or None)


def sighting_times(sightings: Iterable[TimedSighting], robot: str) -> list[float]:
    """Team times at which somebody saw the robot or was seen by it, ascending, each once."""
    return sorted({s.time for s in sightings if robot in (s.observer, s.observed)})


class _Row(BaseModel):
    """A line, its numbers still text."""

    model_config = ConfigDict(frozen=True, str_strip_whitespace=True)

    time: _Seconds
    observer: str
    observed: str
    range: _Metres
    bearing: _Angle
    heading: Annotated[_Angle | None, _BlankIsNone]
    sigma_range: _Sigma
    sigma_bearing: _Sigma
    sigma_heading: Annotated[_Sigma | None, _BlankIsNone]


COLUMNS = tuple(_Row.model_fields)


def read_sightings(path: Path, robots: Collection[str]) -> tuple[TimedSighting, ...]:
    """Read a team's sightings, by time; those of one time in the order of the file.

    Args:
        path: the CSV file.
        robots: the names of the team.

    Raises:
        SessionError: it cannot be read, has not these columns, or a line is not a sighting of one robot of the team by
            another, or is there twice.
    """
    lines: dict[TimedSighting, int] = {}
    for number, cells in _rows(path):
        sighting = _sighting(f"{path}:{number}", cells, robots)
        if (before := lines.setdefault(sighting, number)) != number:
            raise SessionError(f"{path}:{number}: the same as line {before}, and must count once; remove it")
    return tuple(sorted(lines, key=lambda sighting: sighting.time))


def _rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """(line number, cells by column) of every line that is not blank."""
    try:
        with path.open("rb") as stream:
            content = stream.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise SessionError(f"{path}: larger than {LARGEST >> 20} MiB; leave sightings out or split the session")
        reader = csv.reader(content.decode("utf-8-sig").split("\n"), strict=True)
    except OSError as error:
        raise SessionError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SessionError(f"{path}: not a text file in UTF-8") from error
    header: list[str] | None = None
    try:
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue
            if header is None:
                header = _header(f"{path}:{reader.line_num}", row)
                continue
            if len(row) != len(header):
                found = f"{len(row)} fields for {len(header)} columns"
                raise SessionError(f"{path}:{reader.line_num}: {found}; give {','.join(header)}")
            yield reader.line_num, dict(zip(header, row, strict=True))
    except csv.Error as error:
        raise SessionError(f"{path}:{reader.line_num}: not CSV: {error}") from error
    if header is None:
        raise SessionError(f"{path}: is empty; its first line must be {','.join(COLUMNS)}")


def _header(place: str, row: list[str]) -> list[str]:
    names = [cell.strip() for cell in row]
    for name in names:
        if name not in COLUMNS:
            name = shorten(name)
            closest = difflib.get_close_matches(name, COLUMNS, n=1, cutoff=0.0)[0]
            raise SessionError(f"{place}: unknown column {name!r}; did you mean {closest}?")
        if names.count(name) > 1:
            raise SessionError(f"{place}: column {name} is there twice; remove one")
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise SessionError(f"{place}: no column {missing[0]}; the columns must be {','.join(COLUMNS)}")
    return names


def _sighting(place: str, cells: dict[str, str], robots: Collection[str]) -> TimedSighting:
    try:
        row = _Row.model_validate(cells)
        numbers = row.range, row.bearing, row.heading, row.sigma_range, row.sigma_bearing, row.sigma_heading
        sighting = TimedSighting(row.time, row.observer, row.observed, Sighting(*numbers))
    except ValidationError as error:
        first = error.errors()[0]
        complaint = first["msg"].replace("Input should", "must", 1)
        raise SessionError(f"{place}: {first['loc'][0]} is {shorten(repr(first['input']))}: {complaint}") from None
    except FactorError as error:
        raise SessionError(f"{place}: {error}") from error
    for name in (row.observer, row.observed):
        if name not in robots:
            name = shorten(name)
            closest = difflib.get_close_matches(name, robots, n=1, cutoff=0.0)[0]
            raise SessionError(f"{place}: no robot {name!r} in the session; did you mean {closest}?")
    if row.observer == row.observed:
        raise SessionError(f"{place}: {row.observer} sees itself; observer and observed must be two robots")
    return sighting
