"""The colours and lines of the pictures."""

from dataclasses import dataclass
from typing import Literal

INK, MUTED = "#15181d", "#5b6472"
BACKGROUND = "#e1e5ea"  # also the colour of unknown space
FREE, WALL = "#ffffff", "#111418"

_ROBOTS = {
    "blue": "#2f6fde",
    "red": "#dc3545",
    "green": "#1f9d55",
    "violet": "#8a4fd3",
    "orange": "#e8710a",
    "cyan": "#0c9fb5",
    "pink": "#d63a8e",
    "brown": "#8d6142",
}

Dashes = Literal["-"] | tuple[float, tuple[float, ...]]


@dataclass(frozen=True, slots=True)
class EdgeStyle:
    """How an edge of one kind is called and drawn: colour, width in points, dashes."""

    label: str
    colour: str
    width: float
    dashes: Dashes = "-"


EDGE_STYLES = {
    "inter_vertex": EdgeStyle("inter-vertex", "#39424f", 2.0),
    "covariance_intersection": EdgeStyle("covariance intersection", "#0a9488", 2.2),
    "loop": EdgeStyle("loop", "#e8590c", 2.2, (0.0, (5.0, 1.6))),
    "fusing": EdgeStyle("fusing", "#c2187e", 3.0),
    "sighting": EdgeStyle("sighting", "#9a6700", 1.8, (0.0, (1.0, 1.4))),
    "alignment": EdgeStyle("alignment", "#6c8f00", 1.8, (0.0, (3.0, 1.2, 1.0, 1.2))),
}
"""By kind of edge, in the order of the legend."""

OTHER_EDGE = EdgeStyle("other", MUTED, 1.6)


def robot_colours(robots: list[str]) -> dict[str, str]:
    """A colour for each robot: its own if it is called after one, else the next that is free."""
    colours = {robot: _ROBOTS[robot] for robot in robots if robot in _ROBOTS}
    free = [colour for name, colour in _ROBOTS.items() if name not in colours] or list(_ROBOTS.values())
    others = [robot for robot in robots if robot not in colours]
    return colours | {robot: free[i % len(free)] for i, robot in enumerate(others)}
