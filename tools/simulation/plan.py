"""Floor plans: walls, clutter and routes, and their JSON.

    {"name": "flat",
     "walls":   [[x1, y1, x2, y2], ...],
     "boxes":   [[x, y, width, depth, angle], ...],
     "circles": [[x, y, radius], ...],
     "routes":  {"tour": [[x, y], [x, y, seconds], ...]}}

Boxes and circles are given by their centre. A waypoint with a third number is a stop of that many seconds.
"""

import json
import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from frontend.records import FloatArray

CIRCLE_SIDES = 16


class SimulationError(ValueError):
    """A plan, route or option that cannot be simulated; the message is one line for the user."""


@dataclass(frozen=True)
class FloorPlan:
    """A building seen from above, in its own frame.

    Attributes:
        name: used in messages and file names.
        walls: x1, y1, x2, y2 of each wall segment, metres.
        boxes: x, y of the centre, width, depth, angle (radians) of each box of furniture.
        circles: x, y of the centre, radius of each column, bin, table.
        routes: waypoints x, y by the route's name; ``x, y, seconds`` where the robot stops.
    """

    name: str
    walls: list[tuple[float, ...]]
    boxes: list[tuple[float, ...]] = field(default_factory=list)
    circles: list[tuple[float, ...]] = field(default_factory=list)
    routes: dict[str, list[tuple[float, ...]]] = field(default_factory=dict)

    @cached_property
    def segments(self) -> FloatArray:
        """(S, 4) x1, y1, x2, y2 of everything a laser beam can hit, metres."""
        outlines = [box_outline(*box) for box in self.boxes] + [_circle_outline(*circle) for circle in self.circles]
        sides = [np.hstack((corners, np.roll(corners, -1, axis=0))) for corners in outlines]
        return np.ascontiguousarray(np.vstack([np.array(self.walls, dtype=np.float64).reshape(-1, 4), *sides]))

    def route(self, name: str) -> FloatArray:
        """(W, 3) x, y and seconds of stop at each waypoint; raises SimulationError if it is unknown or bad."""
        if name not in self.routes:
            known = ", ".join(self.routes) or "none"
            raise SimulationError(f"plan {self.name!r} has no route {name!r}; its routes: {known}")
        points = np.array([(*point, 0.0)[:3] for point in self.routes[name]], dtype=np.float64).reshape(-1, 3)
        if (points[:, 2] < 0).any():
            x, y, seconds = points[int(np.argmin(points[:, 2]))]
            raise SimulationError(f"plan {self.name!r}, route {name!r}: stop of {seconds:g} s at ({x:g}, {y:g})")
        return points


def box_outline(x: float, y: float, width: float, depth: float, angle: float = 0.0) -> FloatArray:
    """(4, 2) corners of a box, counter-clockwise."""
    c, s = math.cos(angle), math.sin(angle)
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, depth / 2)
    return np.asarray(corners @ np.array([[c, s], [-s, c]]) + (x, y), dtype=np.float64)


def _circle_outline(x: float, y: float, radius: float) -> FloatArray:
    turn = 2 * np.pi * np.arange(CIRCLE_SIDES) / CIRCLE_SIDES
    return np.column_stack((x + radius * np.cos(turn), y + radius * np.sin(turn)))


def write_plan(plan: FloorPlan, path: Path) -> None:
    """Writes the plan as JSON, one shape a line, numbers to the millimetre."""

    def rows(items: list[tuple[float, ...]], indent: str) -> str:
        lines = (json.dumps([round(value, 3) + 0.0 for value in item]) for item in items)
        return "[" + ",".join(f"\n{indent}{line}" for line in lines) + "]"

    routes = ",".join(f"\n  {json.dumps(name)}: {rows(points, '   ')}" for name, points in plan.routes.items())
    parts = [f'"name": {json.dumps(plan.name)}']
    parts += [f'"{key}": {rows(getattr(plan, key), "  ")}' for key in ("walls", "boxes", "circles")]
    parts.append(f'"routes": {{{routes}}}')
    path.write_text("{" + ",\n ".join(parts) + "}\n", encoding="utf-8")


def read_plan(path: Path) -> FloorPlan:
    """Reads a plan from JSON; raises SimulationError naming the file, the entry and what it should be."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SimulationError(f"{path}: cannot read the floor plan: {error.strerror}") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SimulationError(f"{path}: not a JSON file: {error}") from error
    if not isinstance(document, dict):
        raise SimulationError(f"{path}: a floor plan is a JSON object with name, walls and routes")
    unknown = set(document) - {"name", "walls", "boxes", "circles", "routes"}
    if unknown:
        raise SimulationError(f"{path}: unknown entry {min(unknown)!r}; known: name, walls, boxes, circles, routes")
    routes = document.get("routes", {})
    if not isinstance(routes, dict):
        raise SimulationError(f"{path}: routes must be an object of named lists of waypoints")
    walls = _rows(document.get("walls"), (4,), f"{path}: walls")
    if not walls:
        raise SimulationError(f"{path}: walls is empty; a plan needs at least one [x1, y1, x2, y2]")
    return FloorPlan(
        name=str(document.get("name", path.stem)),
        walls=walls,
        boxes=_rows(document.get("boxes", []), (4, 5), f"{path}: boxes"),
        circles=_rows(document.get("circles", []), (3,), f"{path}: circles"),
        routes={name: _rows(points, (2, 3), f"{path}: routes: {name}") for name, points in routes.items()},
    )


def _rows(value: object, lengths: tuple[int, ...], where: str) -> list[tuple[float, ...]]:
    if not isinstance(value, list):
        raise SimulationError(f"{where}: must be a list of lists of numbers, not {value!r}")
    allowed = " or ".join(map(str, lengths))
    for index, row in enumerate(value):
        if not isinstance(row, list) or len(row) not in lengths or not all(map(_is_number, row)):
            raise SimulationError(f"{where}[{index}]: must be {allowed} finite numbers, not {row!r}")
    return [tuple(map(float, row)) for row in value]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
