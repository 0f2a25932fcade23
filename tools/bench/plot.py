"""The benchmark's picture: accuracy against time, one panel a log."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mrtm.output.style import INK, MUTED
from tools.bench.anchors import Anchor
from tools.bench.suite import LogReport, Spread

OURS = "#dc3545"
PEER_COLOURS = ("#2f6fde", "#1f9d55", "#e8710a", "#8a4fd3", "#0c9fb5")
WORST = 20.0  # an error above this many times the best one is drawn at the upper edge, with its number
GAP = 0.048  # least distance of two labels, as a fraction of the panel's height


@dataclass(frozen=True, slots=True)
class Point:
    """A system's place: seconds (None if unknown), metres, and how it looks."""

    name: str
    wall: Spread | None
    error: float
    marker: str
    colour: str
    ran: bool


def draw(reports: Sequence[LogReport], anchors: Mapping[str, Sequence[Anchor]], path: Path, note: str = "") -> None:
    """Draw what was run here filled and what others report hollow; without a time it is a dashed line."""
    figure = Figure(figsize=(6.2 * len(reports), 4.6), layout="constrained")
    panels = figure.subplots(1, len(reports), squeeze=False)[0]
    for axes, report in zip(panels, reports, strict=True):
        _panel(axes, report, list(_points(report, anchors.get(report.log.name, ()))))
    if note:
        figure.suptitle(note, color=OURS, fontsize=9)
    figure.savefig(path, dpi=150)


def _points(report: LogReport, anchors: Sequence[Anchor]) -> Iterator[Point]:
    colours = iter(PEER_COLOURS)
    for outcome in report.outcomes:
        colour = OURS if outcome.system == "mrtm" else next(colours)
        if outcome.costs:
            error = Spread.of([score.headline[0] for score in outcome.scores]).median
            yield Point(outcome.system, outcome.cost("wall"), error, "o", colour, True)
    for anchor in anchors:
        wall = None if anchor.wall is None else Spread.of([anchor.wall])
        yield Point(anchor.system, wall, anchor.metres[0], "s" if anchor.measured else "D", MUTED, False)


def _panel(axes: Axes, report: LogReport, points: list[Point]) -> None:
    axes.set_title(f"{report.log.name}: {report.scans} scans, {report.duration:.0f} s", color=INK, fontsize=10)
    if not points:
        return
    best = min(point.error for point in points)
    ceiling = min(WORST * best, max(point.error for point in points))
    low, high = best / 1.6, ceiling * 1.6
    times = [point.wall for point in points if point.wall is not None]
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(min(wall.low for wall in times) / 2, max(wall.high for wall in times) * 2)
    axes.set_ylim(low, high)
    heights = [math.log(min(point.error, ceiling) / low) / math.log(high / low) for point in points]
    for point, height in zip(points, _apart(heights), strict=True):
        _point(axes, point, ceiling, height)
    ticks = (0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 5)
    axes.set_yticks([tick for tick in ticks if low < tick < high], minor=False)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.tick_params(axis="both", which="minor", labelleft=False, labelbottom=False)
    axes.set_xlabel("whole process, s")
    axes.set_ylabel(f"{report.log.metric}, m")
    axes.grid(True, color="#e1e5ea", linewidth=0.6)
    axes.set_axisbelow(True)


def _apart(heights: Sequence[float]) -> list[float]:
    """The same heights, moved as little as it takes to keep labels off each other and inside the panel."""
    order = sorted(range(len(heights)), key=lambda i: heights[i])
    moved = list(heights)
    for below, above in pairwise(order):
        moved[above] = max(moved[above], moved[below] + GAP)
    ceiling = 1.0
    for i in reversed(order):
        moved[i] = min(moved[i], ceiling)
        ceiling = moved[i] - GAP
    return moved


def _point(axes: Axes, point: Point, ceiling: float, height: float) -> None:
    y = min(point.error, ceiling)
    beyond = point.error > ceiling
    right = axes.get_xlim()[1]
    if point.wall is None:
        axes.axhline(y, color=point.colour, linewidth=0.7, linestyle=(0, (4, 3)), zorder=1)
    else:
        spread = [[point.wall.median - point.wall.low], [point.wall.high - point.wall.median]]
        axes.errorbar(
            point.wall.median,
            y,
            xerr=spread if point.ran else None,
            fmt="^" if beyond else point.marker,
            color=point.colour,
            markerfacecolor=point.colour if point.ran else "white",
            markersize=8 if point.ran else 6,
            capsize=3,
            zorder=3 if point.ran else 2,
        )
    axes.annotate(
        f"{point.name}: {point.error:.2g} m" if beyond else point.name,
        (right if point.wall is None else point.wall.median, y),
        xytext=(1.02, height),
        textcoords="axes fraction",
        fontsize=8,
        va="center",
        color=point.colour,
        weight="bold" if point.colour == OURS else "normal",
        arrowprops={"arrowstyle": "-", "color": point.colour, "linewidth": 0.4, "alpha": 0.6, "relpos": (0.0, 0.5)},
    )
