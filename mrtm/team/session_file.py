"""A team session: which robots take part, with which part of which log, and who saw whom. YAML, paths relative to it.

robots:
  red:  {log: intel.clf.bz2, from: 0,   to: 900}             # seconds after the log's first record
  blue: {log: intel.clf.bz2, from: 900, to: 1800, start: 5}  # start: team time of ``from``, 0 by default
sightings: intel-3robots.sightings.csv   # optional
relations: intel.relations               # optional, evaluation only, in the logs' own time
truth: {red: red.tum}                    # optional, evaluation only
"""

import difflib
import math
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from frontend.errors import FrontendError
from frontend.readers import open_log
from mrtm.errors import ConfigError
from mrtm.plain_yaml import read_yaml, shorten
from mrtm.team.checks import NAME, fit_name, is_name
from mrtm.team.errors import SessionError
from mrtm.team.sightings_file import TimedSighting, read_sightings

__all__ = ["Member", "SessionError", "TeamSession", "TimedSighting", "open_session", "read_session"]

LONGEST_PATH = 400


@dataclass(frozen=True, slots=True)
class Member:
    """A robot of a team and the part of a log it is played from.

    Attributes:
        name: of the robot, fit for a file name.
        log: its log.
        begin, end: seconds after the log's first record; ``end`` is inf if the window has none.
        start: seconds, the team time of ``begin``.
    """

    name: str
    log: Path
    begin: float
    end: float
    start: float


@dataclass(frozen=True, slots=True)
class TeamSession:
    """A team and what is known of it before it is played.

    Attributes:
        name: of the session: its file's, without endings.
        members: at least one, in the order of the file; no two names are the same file name anywhere.
        sightings: by team time.
        relations: file of true relative poses, in the logs' own time.
        truth: TUM files by robot.
        files: all that it is made of, itself first.
    """

    name: str
    members: tuple[Member, ...]
    sightings: tuple[TimedSighting, ...]
    relations: Path | None
    truth: dict[str, Path]
    files: tuple[Path, ...]


def open_session(path: Path) -> TeamSession:
    """The session of a YAML file, known by its suffix or by a line ``robots:``; of any other file a session of one.

    The one robot is called as its log is, without endings. The logs of a team are opened, not read: a window without a
    scan shows when it is taken (``mrtm.team.window``).

    Raises:
        SessionError: see ``read_session``; or a log of the team is missing or of no known format.
    """
    if not _is_session(path):
        name = _stem(path)
        return TeamSession(name, (Member(name, path, 0.0, math.inf, 0.0),), (), None, {}, (path,))
    session = read_session(path)
    for member in session.members:
        try:
            open_log(member.log)
        except (FrontendError, OSError) as error:
            hint = "" if member.log.is_file() else f"; paths are relative to {path}"
            raise SessionError(f"{path}: robots.{member.name}.log: {error}{hint}") from error
    return session


def read_session(path: Path) -> TeamSession:
    """Read a session file and its sightings; logs, relations and truth are not looked at.

    Raises:
        SessionError: it cannot be read, or is not a session; or its sightings are not.
    """
    try:
        content = read_yaml(path)
    except ConfigError as error:
        raise SessionError(str(error)) from error
    if not isinstance(content, Mapping):
        raise SessionError(f"{path}: holds no session; give at least robots: {{red: {{log: red.clf}}}}")
    try:
        given = _Session.model_validate(content)
    except ValidationError as error:
        raise SessionError(f"{path}: {_complaint(error)}") from None
    place = path.parent
    logs = [member.log for member in given.robots.values()]
    others = [given.sightings, given.relations, *(given.truth or {}).values()]
    return TeamSession(
        name=_stem(path),
        members=tuple(
            Member(name, place / member.log, member.begin, math.inf if member.end is None else member.end, member.start)
            for name, member in given.robots.items()
        ),
        sightings=() if given.sightings is None else read_sightings(place / given.sightings, given.robots),
        relations=None if given.relations is None else place / given.relations,
        truth={name: place / file for name, file in (given.truth or {}).items()},
        files=(path, *(place / file for file in (*logs, *others) if file is not None)),
    )


def _no_truth_value(value: Any) -> Any:
    if isinstance(value, bool):  # pydantic would take true for 1
        raise ValueError("must not be true or false")
    return value


def _file_name(name: Any) -> str:
    if not isinstance(name, str):  # YAML reads 1 as a number and no as false
        raise ValueError("a robot's name must be text; put it in quotes")
    if not is_name(name):
        raise ValueError(f"a robot's name must do as a file's: {NAME}")
    return name


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("must be printable")
    return text


_Seconds = Annotated[float, BeforeValidator(_no_truth_value), Field(ge=0.0, lt=1e10)]  # false for NaN
_Name = Annotated[Any, AfterValidator(_file_name)]
_File = Annotated[str, Field(min_length=1, max_length=LONGEST_PATH), AfterValidator(_printable)]


class _Member(BaseModel):
    model_config = ConfigDict(extra="forbid")

    log: _File
    begin: _Seconds = Field(default=0.0, alias="from")
    end: _Seconds | None = Field(default=None, alias="to")
    start: _Seconds = 0.0

    @model_validator(mode="after")
    def _check(self) -> "_Member":
        if self.end is not None and self.begin >= self.end:
            raise ValueError(f"from {self.begin:g} must be before to {self.end:g}")
        return self


class _Session(BaseModel):
    model_config = ConfigDict(extra="forbid")

    robots: dict[_Name, _Member] = Field(min_length=1)
    sightings: _File | None = None
    relations: _File | None = None
    truth: dict[_Name, _File] | None = None

    @model_validator(mode="after")
    def _check(self) -> "_Session":
        seen: dict[str, str] = {}
        for name in self.robots:
            # macOS and Windows take Red and red for one file.
            before = seen.setdefault(unicodedata.normalize("NFKC", name).casefold(), name)
            if before != name:
                raise ValueError(f"robots.{name} and robots.{before} are one file name on some systems; rename one")
        for name in self.truth or {}:
            if name not in self.robots:
                closest = difflib.get_close_matches(name, self.robots, n=1, cutoff=0.0)[0]
                raise ValueError(f"truth.{name}: no such robot in the session; did you mean {closest}?")
        return self


def _complaint(error: ValidationError) -> str:
    """The first error in one line: the place, the value, and what it must be."""
    first = error.errors()[0]
    place = [shorten(str(part)) for part in first["loc"] if part != "[key]"]
    where = ".".join(place)
    kind, value = first["type"], shorten(repr(first["input"]))
    if kind == "extra_forbidden":
        fields = (_Session if len(place) == 1 else _Member).model_fields
        known = [field.alias or name for name, field in fields.items()]
        return f"unknown key {where}; did you mean {difflib.get_close_matches(place[-1], known, n=1, cutoff=0.0)[0]}?"
    if kind == "missing":
        return f"{where} is missing; give robots: {{red: {{log: red.clf}}}}"
    if kind in ("model_type", "dict_type"):
        return f"{where} is {value}: must be keys with values, as in red: {{log: red.clf}}"
    if kind == "value_error":
        complaint = str(first["ctx"]["error"])
        return f"{where}: {complaint}" if where else complaint
    return f"{where} is {value}: {first['msg'].replace('Input should', 'must', 1)}"


def _is_session(path: Path) -> bool:
    if path.suffix.lower() in (".yaml", ".yml"):
        return True
    try:
        with path.open("rb") as stream:
            return any(line.startswith(b"robots:") for line in stream.read(4096).splitlines())
    except OSError:
        return False  # whoever opens the log says why


def _stem(path: Path) -> str:
    return fit_name(path.name.split(".")[0]) or "robot"
