"""What stands around the map of a picture: title and counts above, scale bar and legend below."""

import math
from collections import Counter

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from factors import GraphEdge, VertexId
from frontend.records import FloatArray
from mrtm.output.raster import View
from mrtm.output.style import EDGE_STYLES, INK, MUTED, OTHER_EDGE
from mrtm.result import RunResult

DPI = 100
HEADER, FOOTER, SIDE = 110, 100, 40
"""Pixels above, below and beside the map."""


def write_header(figure: Figure, result: RunResult, component: list[VertexId], robots: list[str], edges: int) -> None:
    """Above the map: who mapped, and the counts."""
    width, height = figure.get_size_inches() * DPI
    scans = sum(len(result.trajectories[robot].times) for robot in robots)
    travelled = sum(_length(result.trajectories[robot].poses) for robot in robots)
    facts = [
        _count(scans, "scan"), f"{travelled:,.0f} m travelled", _count(len(component), "vertex", "vertices"),
        _count(edges, "edge"),
    ]  # fmt: skip
    if refused := sum(fate.fate == "refused" for fate in result.edges):
        facts.append(f"{refused} refused")
    if len(result.components) > 1:
        facts.append(f"one of {len(result.components)} components")
    title = figure.text(
        SIDE / width, 1 - 0.5 * HEADER / height, ", ".join(robots), fontsize=24, fontweight="bold", color=INK,
        va="center_baseline",
    )  # fmt: skip
    end = title.get_window_extent(figure.canvas.get_renderer()).x1  # type: ignore[attr-defined]
    figure.text(
        (end + 28) / width, 1 - 0.5 * HEADER / height, "  ·  ".join(facts), fontsize=16, color=MUTED,
        va="center_baseline",
    )  # fmt: skip


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def _length(poses: FloatArray) -> float:
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()) if len(poses) > 1 else 0.0


def draw_scale(figure: Figure, view: View) -> None:
    """The scale bar, and beside it where x and y of the joint frame point, in pixels of the footer."""
    width, height = figure.get_size_inches() * DPI
    axes = figure.add_axes((0, 0, 1, FOOTER / height))
    axes.set_axis_off()
    axes.set_xlim(0, width)
    axes.set_ylim(0, FOOTER)
    length = max(n * 10.0**k for k in range(-2, 4) for n in (1, 2, 5) if n * 10.0**k * view.scale <= 340)
    middle, end = 0.5 * FOOTER, SIDE + length * view.scale
    axes.plot([SIDE, SIDE, end, end], [middle + 4, middle - 6, middle - 6, middle + 4], color=INK, linewidth=2.4)
    text = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
    axes.text((SIDE + end) / 2, middle + 2, text, fontsize=14, color=INK, ha="center", va="bottom")
    corner = np.array([end + 75.0, middle])
    for angle, name in ((view.angle, "x"), (view.angle + math.pi / 2, "y")):
        tip = 26 * np.array([math.cos(angle), math.sin(angle)])
        arrow = {"arrowstyle": "-|>", "color": MUTED, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tuple(corner + tip), tuple(corner), arrowprops=arrow)
        x, y = corner + 1.4 * tip
        axes.text(x, y, name, fontsize=11, color=MUTED, ha="center", va="center")


def draw_legend(figure: Figure, edges: list[GraphEdge], robots: list[str], colours: dict[str, str]) -> None:
    """Below the map: what the lines and discs are."""
    handles = []
    for robot in robots:
        label = "path" if len(robots) == 1 else f"path {robot}"
        handles.append(Line2D([], [], color=colours[robot], linewidth=2.0, alpha=0.7, label=label))
    disc = colours[robots[0]] if len(robots) == 1 else INK
    handles.append(
        Line2D([], [], marker="o", markersize=14, linestyle="none", markeredgecolor="white", color=disc,
               label="vertex, with 3\u03c3")
    )  # fmt: skip
    counts = Counter(str(edge.kind) for edge in edges)
    for kind, style in (EDGE_STYLES | {kind: OTHER_EDGE for kind in counts if kind not in EDGE_STYLES}).items():
        if counts[kind]:
            label = f"{style.label} ({counts[kind]})"
            width = style.width + 0.4
            handles.append(Line2D([], [], color=style.colour, linewidth=width, linestyle=style.dashes, label=label))
    width, height = figure.get_size_inches() * DPI
    figure.legend(
        handles=handles, loc="center right", bbox_to_anchor=(1 - SIDE / width, 0.5 * FOOTER / height),
        ncols=math.ceil(len(handles) / (1 if len(handles) <= 5 else 2)), frameon=False, fontsize=14, labelcolor=INK,
        borderpad=0, borderaxespad=0, handlelength=2.4, columnspacing=1.8, labelspacing=0.35,
    )  # fmt: skip
