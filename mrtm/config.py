"""The configuration: every parameter with unit, meaning and the paper's value, and where a value comes from.

A value comes from the last of these that gives it: default, preset, YAML file, ``--set section.key=value``.
"""

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from frontend.parameters import FilterParameters, Parameter, ParameterError, Section, check, parameter_of
from mrtm.errors import ConfigError
from mrtm.plain_yaml import parse_yaml, read_yaml, shorten


@dataclass(frozen=True)
class TopologyParameters(Section):
    """Vertices and edges of one robot (M4 to M8)."""

    projection: Annotated[
        Literal["joint", "dijkstra"],
        Parameter("", "where M6 takes the pose in a known vertex from: joint estimate or shortest path", "dijkstra"),
    ] = "joint"
    omega: Annotated[
        float | Literal["optimal"],
        Parameter("", "weight of the new estimate in M5; optimal: the least covariance", paper="0.5", ge=0, le=1),
    ] = "optimal"
    reach: Annotated[
        float, Parameter("", "standard deviations a pose may lie outside a square in M6", paper="0", ge=0)
    ] = 2.0
    candidates: Annotated[int, Parameter("", "vertices tried at a re-entry, best first", paper="1", ge=1)] = 3
    attraction: Annotated[
        float, Parameter("", "part of its square in which a known vertex draws the robot in", ge=0, le=1)
    ] = 0.5
    longest_visit: Annotated[int, Parameter("", "scans after which a map is closed and opened again", ge=100)] = 1500
    look_distance: Annotated[float, Parameter("m", "way between two looks around for such a vertex", gt=0)] = 2.0
    entry_score: Annotated[float, Parameter("", "least score of the first scan in an old map", gt=0, le=1)] = 0.4
    trial_scans: Annotated[int, Parameter("", "scans on trial in an old map, at least", ge=1)] = 8
    trial_distance: Annotated[
        float, Parameter("m", "way on trial in an old map, at least; three times that at most", gt=0)
    ] = 2.0
    trial_fit: Annotated[float, Parameter("", "of the known space the old map must explain", gt=0, le=1)] = 0.7
    trial_known: Annotated[float, Parameter("", "fraction of a scan that must lie in the old map", gt=0, le=1)] = 0.55
    trial_spread: Annotated[float, Parameter("m", "standard deviation of the pose that is still unambiguous", gt=0)] = (
        0.15
    )
    gate: Annotated[
        float,
        Parameter(
            "",
            "chi2 of a re-entry against the joint map that refuses it (99 %); more where the place stands out",
            gt=0,
        ),
    ] = 11.34
    trial_lead: Annotated[float, Parameter("", "by which one place must beat all others", ge=0, le=1)] = 0.05


@dataclass(frozen=True)
class TeamParameters(Section):
    """Meetings of robots (M9 to M11)."""

    exchange_interval: Annotated[float, Parameter("s", "between two exchanges while robots see each other", gt=0)] = 5.0


@dataclass(frozen=True)
class JointParameters(Section):
    """The joint map (M13)."""

    alignments: Annotated[
        int, Parameter("", "pairs of local maps aligned after an event, at most; 0 for none", paper="0", ge=0)
    ] = 12


class Config(BaseModel):
    """Every parameter of a run.

    Raises:
        ValidationError: of pydantic, for a value of the wrong type or out of bounds.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: Annotated[int, Parameter("", "of all random numbers: same seed, same result", ge=0, lt=2**63)] = 0
    frontend: FilterParameters = Field(default_factory=FilterParameters)
    topology: TopologyParameters = Field(default_factory=TopologyParameters)
    team: TeamParameters = Field(default_factory=TeamParameters)
    joint: JointParameters = Field(default_factory=JointParameters)

    @model_validator(mode="after")
    def _check(self) -> "Config":
        check(self)
        return self


PRESETS: dict[str, dict[str, Any]] = {
    # The paper's experiments (its section V): the map is 20 m wide although its text has 4 d_s = 40 m. The travel
    # square keeps the text's proportion to the map.
    "paper": {
        "frontend": {"particles": 40, "sensing_range": 10.0, "map_width": 20.0, "travel_square": 10.0},
        "topology": {"projection": "dijkstra", "omega": 0.5},
        "joint": {"alignments": 0},
    },
}


@dataclass(frozen=True, slots=True)
class _Given:
    """A value somebody gave, and who."""

    value: Any
    source: str


def load_config(file: Path | None = None, preset: str | None = None, options: Sequence[str] = ()) -> Config:
    """Make the configuration of a run.

    Args:
        file: YAML, sections as mappings; a part of the keys is enough.
        preset: name of a preset.
        options: ``section.key=value``, the value in YAML.

    Raises:
        ConfigError: an unknown preset or key, a value of the wrong type or out of bounds, a file that is not YAML.
    """
    given: dict[str, _Given] = {}
    if preset is not None:
        if preset not in PRESETS:
            raise ConfigError(f"--preset {preset}: no such preset; there is: {', '.join(PRESETS)}")
        given |= _flatten(PRESETS[preset], f"preset {preset}")
    if file is not None:
        given |= _flatten(_read(file), str(file))
    for option in options:
        source = f"--set {shorten(option)}"
        key, equals, text = option.partition("=")
        if not equals:
            raise ConfigError(f"{source}: give it as section.key=value, for example frontend.particles=60")
        given |= _flatten(_nested({key.strip(): parse_yaml(text, source)}), source)
    try:
        return Config.model_validate(_nested({key: item.value for key, item in given.items()}))
    except ValidationError as error:
        raise ConfigError(_explain(error, given)) from None


def to_yaml(config: Config) -> str:
    """The configuration as YAML, each line with unit, meaning and the paper's value; ``load_config`` reads it back."""
    return "".join(_lines(config, ""))


def _lines(section: object, indent: str) -> Iterator[str]:
    for name, annotation in get_type_hints(type(section), include_extras=True).items():
        value = getattr(section, name, None)
        if is_dataclass(value):
            yield f"{indent}{name}:\n"
            yield from _lines(value, indent + "  ")
        elif (parameter := parameter_of(annotation)) is not None:
            text = yaml.safe_dump(value, default_flow_style=True, width=10**6).removesuffix("...\n").strip()
            parts = (parameter.unit, parameter.meaning, parameter.paper and f"paper: {parameter.paper}")
            yield f"{indent + name + ': ' + text:<32}  # {'; '.join(part for part in parts if part)}\n"


def _keys(section: type, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, type) of every parameter below ``section``."""
    for name, annotation in get_type_hints(section, include_extras=True).items():
        if isinstance(annotation, type) and is_dataclass(annotation):
            yield from _keys(annotation, f"{prefix}{name}.")
        elif parameter_of(annotation) is not None:
            yield prefix + name, get_args(annotation)[0]


_TYPES = dict(_keys(Config))


def _flatten(values: Mapping[Any, Any], source: str, prefix: str = "") -> dict[str, _Given]:
    flat: dict[str, _Given] = {}
    for name, value in values.items():
        key = f"{prefix}{name}"
        inside = [known for known in _TYPES if known.startswith(f"{key}.")]
        if key not in _TYPES and not inside:
            key = shorten(key)
            closest = difflib.get_close_matches(key, _TYPES, n=1, cutoff=0.0)[0]
            raise ConfigError(f"{source}: unknown key {key}; did you mean {closest}?")
        if inside and not isinstance(value, Mapping):
            found = shorten(repr(value))
            raise ConfigError(f"{source}: {key} is a section and cannot be {found}; set {inside[0]} or another key")
        if inside:
            flat |= _flatten(value, source, f"{key}.")
        elif isinstance(value, bool) and _TYPES[key] is not bool:
            # pydantic would take true for 1.
            raise ConfigError(f"{source}: {key} is {str(value).lower()}: must not be true or false")
        else:
            flat[key] = _Given(value, source)
    return flat


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for key, value in flat.items():
        *sections, name = key.split(".")
        branch = tree
        for section in sections:
            branch = branch.setdefault(section, {})
        branch[name] = value
    return tree


def _read(file: Path) -> Mapping[Any, Any]:
    values = read_yaml(file)
    if values is None:
        return {}
    if not isinstance(values, Mapping):
        raise ConfigError(f"{file}: holds no sections; `mrtm config` prints what one looks like")
    return values


def _explain(error: ValidationError, given: Mapping[str, _Given]) -> str:
    """The first error in one line: who gave which value to which key, and what it must be."""
    errors = error.errors()
    first = errors[0]
    path = [str(part) for part in first["loc"]]
    cause = first.get("ctx", {}).get("error")
    value = first.get("input")
    if isinstance(cause, ParameterError):
        key, complaint, value = ".".join([*path, cause.name]), cause.complaint, cause.value
    else:
        # Of a value that may be of several types there is an error for each, its path ending with the type.
        key = ".".join(path if ".".join(path) in _TYPES else path[:-1])
        same = [e["msg"] for e in errors if ".".join(map(str, e["loc"])).startswith(key)]
        complaint = " or ".join(same).replace("Input should", "must", 1).replace("Input should ", "")
    # A bound may be on several together: one of the others was given, the last in the section more likely than not.
    section = key.rpartition(".")[0]
    others = [item.source for name, item in given.items() if name.startswith(f"{section}.")]
    item = given.get(key) or _Given(value, others[-1] if others else "configuration")
    return f"{item.source}: {key} is {shorten(repr(item.value))}: {complaint}"
