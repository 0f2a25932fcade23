"""Every parameter of the front end, with unit, meaning and the paper's value."""

import math
import operator
from dataclasses import dataclass, field
from typing import Annotated, get_type_hints

# Of the grids of all particles together, a byte each.
MOST_CELLS = 4e9


@dataclass(frozen=True, slots=True)
class Parameter:
    """What a number means, as metadata of its annotation.

    Attributes:
        unit: SI symbol; empty for a pure number.
        meaning: one line.
        paper: the value in "Multi-Robot SLAM with Topological/Metric Maps", in words; empty if it gives none.
        ge, gt, le, lt: bounds.
    """

    unit: str
    meaning: str
    paper: str = ""
    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None

    def complaint(self, value: float) -> str:
        """What is wrong with a value, in words; empty if nothing is."""
        if isinstance(value, float) and not math.isfinite(value):  # an int may be too large to ask
            return "must be finite"
        for bound, holds, words in (
            (self.ge, operator.ge, "at least"),
            (self.gt, operator.gt, "above"),
            (self.le, operator.le, "at most"),
            (self.lt, operator.lt, "below"),
        ):
            if bound is not None and not holds(value, bound):
                return f"must be {words} {bound:g}{self.unit and ' ' + self.unit}"
        return ""


class ParameterError(ValueError):
    """A parameter out of its bounds: ``name``, ``value``, ``complaint``."""

    def __init__(self, name: str, value: object, complaint: str) -> None:
        super().__init__(f"{name} is {value}: {complaint}")
        self.name, self.value, self.complaint = name, value, complaint


def parameter_of(annotation: object) -> Parameter | None:
    """The ``Parameter`` in an ``Annotated[...]``, if there is one."""
    return next((item for item in getattr(annotation, "__metadata__", ()) if isinstance(item, Parameter)), None)


def check(section: object) -> None:
    """Hold every numeric attribute of ``section`` against the bounds of its annotation.

    Raises:
        ParameterError: the first one out of bounds.
    """
    for name, annotation in get_type_hints(type(section), include_extras=True).items():
        parameter, value = parameter_of(annotation), getattr(section, name)
        if parameter is not None and isinstance(value, int | float) and (complaint := parameter.complaint(value)):
            raise ParameterError(name, value, complaint)


@dataclass(frozen=True)
class Section:
    """Base of a group of parameters: cannot be made with a value out of bounds (``ParameterError``)."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class MotionParameters(Section):
    """Standard deviations of one odometry increment: a floor, and growth with the distance and the turn."""

    xy_floor: Annotated[float, Parameter("m", "position noise of any increment", ge=1e-5, le=10)] = 0.003
    xy_per_metre: Annotated[float, Parameter("m/m", "position noise for each metre driven", ge=0, le=10)] = 0.1
    xy_per_radian: Annotated[float, Parameter("m/rad", "position noise for each radian turned", ge=0, le=10)] = 0.1
    theta_floor: Annotated[float, Parameter("rad", "heading noise of any increment", ge=1e-5, le=10)] = 0.003
    theta_per_radian: Annotated[float, Parameter("rad/rad", "heading noise for each radian turned", ge=0, le=10)] = 0.1
    theta_per_metre: Annotated[float, Parameter("rad/m", "heading noise for each metre driven", ge=0, le=10)] = 0.05


@dataclass(frozen=True)
class FilterParameters(Section):
    """The particle filter and its local maps (M3, M4)."""

    particles: Annotated[int, Parameter("", "particles of the filter", paper="40", ge=1, le=10000)] = 40
    resolution: Annotated[float, Parameter("m", "width of a grid cell", ge=0.005, le=1)] = 0.05
    sensing_range: Annotated[float, Parameter("m", "readings beyond this are not mapped (d_s)", paper="10 m", gt=0)] = (
        25.0
    )
    map_width: Annotated[
        float, Parameter("m", "width of a local map", paper="4 d_s = 40 m in the text, 20 m in the experiments", gt=0)
    ] = 70.0
    travel_square: Annotated[
        float, Parameter("m", "a robot that leaves this square around the origin leaves the map", paper="2 d_s", gt=0)
    ] = 20.0
    max_beams: Annotated[int, Parameter("", "of a scan with more beams an even subset is used", ge=10)] = 181
    key_distance: Annotated[float, Parameter("m", "the filter takes a step after this way", gt=0)] = 0.2
    key_angle: Annotated[float, Parameter("rad", "or after this turn", gt=0)] = 0.2
    sigma: Annotated[float, Parameter("m", "standard deviation of an endpoint across its wall", ge=1e-3, le=1)] = 0.02
    independence: Annotated[
        float, Parameter("", "part of a scan's endpoints that weigh a particle as if independent", gt=0, le=1)
    ] = 0.05
    drift_xy: Annotated[float, Parameter("m/sqrt(m)", "position error that all particles share", ge=0, le=10)] = 0.015
    drift_theta: Annotated[float, Parameter("rad/sqrt(m)", "heading error that all particles share", ge=0, le=10)] = (
        0.004
    )
    motion: MotionParameters = field(default_factory=MotionParameters)

    def __post_init__(self) -> None:
        super().__post_init__()
        across = self.map_width / self.resolution
        cells = self.particles * across * across
        if cells > MOST_CELLS:
            complaint = f"with {self.particles} particles and {self.resolution:g} m a cell it takes {cells:.1e} cells, "
            raise ParameterError("map_width", self.map_width, complaint + f"more than {MOST_CELLS:.0e}")
