"""A sheet of pictures side by side, each with a title and a scale bar."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from PIL import Image

from mrtm.output.files import replacing
from mrtm.output.margins import DPI
from mrtm.output.raster import View, rgb
from mrtm.output.style import INK, MUTED

GAP, TITLE, HEADING = 40, 60, 90
"""Pixels between pictures, for the titles above them, for the heading of the sheet."""

PAPER = "#ffffff"

Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Panel:
    """One picture: ``pixels`` (view.height, view.width, 3), and what ``draw`` puts on it, in metres of the view."""

    title: str
    view: View
    pixels: Pixels
    draw: Callable[[Axes], None] = lambda axes: None


def draw_sheet(heading: str, rows: Sequence[Sequence[Panel]], path: Path) -> None:
    """Write rows of panels into a PNG, a pixel of a panel a pixel of the picture."""
    widths = [sum(panel.view.width + GAP for panel in row) + GAP for row in rows]
    heights = [max(panel.view.height for panel in row) + TITLE for row in rows]
    width, height = max(widths), HEADING + sum(heights) + GAP
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    figure.patch.set_visible(False)
    canvas = FigureCanvasAgg(figure)
    renderer = canvas.get_renderer()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    pixels[...] = (*rgb(PAPER), 255)
    figure.text(
        GAP / width,
        1 - 0.55 * HEADING / height,
        heading,
        fontsize=24,
        fontweight="bold",
        color=INK,
        va="center_baseline",
    )
    top = HEADING
    for row, row_height in zip(rows, heights, strict=True):
        left = GAP
        for panel in row:
            view = panel.view
            figure.text(
                left / width,
                1 - (top + 0.6 * TITLE) / height,
                panel.title,
                fontsize=17,
                color=INK,
                va="center_baseline",
            )
            bottom = height - top - TITLE - view.height
            axes = figure.add_axes((left / width, bottom / height, view.width / width, view.height / height))
            axes.set_axis_off()
            axes.set_xlim(view.low[0], view.high[0])
            axes.set_ylim(view.low[1], view.high[1])
            panel.draw(axes)
            _draw_scale(axes, view)
            # Under what is drawn: see mrtm.output.figures.
            pixels[top + TITLE : top + TITLE + view.height, left : left + view.width, :3] = panel.pixels
            left += view.width + GAP
        top += row_height
    figure.draw(renderer)
    with replacing(path) as temporary:
        Image.fromarray(pixels[..., :3]).save(temporary, format="PNG", compress_level=4)


def _draw_scale(axes: Axes, view: View) -> None:
    """A bar of a round length, in the lower left corner."""
    longest = 0.25 * view.width / view.scale
    length = max(n * 10.0**k for k in range(-3, 4) for n in (1, 2, 5) if n * 10.0**k <= longest)
    x, y = view.low + 14 / view.scale
    tick = 8 / view.scale
    halo = [withStroke(linewidth=5.0, foreground=PAPER)]
    bar = [x, x, x + length, x + length], [y + tick, y, y, y + tick]
    axes.plot(*bar, color=MUTED, linewidth=2.0, zorder=6, path_effects=halo)
    text = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
    axes.text(
        x + length / 2, y + 0.5 * tick, text, fontsize=12, color=MUTED, ha="center", va="bottom", zorder=6,
        path_effects=halo,
    )  # fmt: skip
