"""The picture of the back end's benchmark: the time of every step."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mrtm.output.style import INK
from tools.bench.backend import Fed
from tools.bench.pose_graphs import PoseGraph

COLOURS = ("#8a94a3", "#2f6fde", "#dc3545", "#1f9d55")
WINDOWS = 150
"""Across the picture: a line shows the worst step of each, since the spikes are what is felt."""


def draw_backend(graphs: Sequence[tuple[PoseGraph, Sequence[Fed]]], path: Path, note: str = "") -> None:
    """Draw for every graph the median and the worst step along the way, and how many steps take longer than what."""
    figure = Figure(figsize=(11, 0.4 + 3.4 * len(graphs)), layout="constrained")
    for (graph, fed), (along, ranked) in zip(graphs, figure.subplots(len(graphs), 2, squeeze=False), strict=True):
        for one, colour in zip((f for f in fed if len(f.seconds) > 1), COLOURS, strict=False):
            parts = np.array_split(1e3 * one.seconds, min(WINDOWS, len(one.seconds)))
            ends = np.cumsum([len(part) for part in parts])
            along.plot(ends, [part.max() for part in parts], color=colour, linewidth=1.1, label=f"{one.name}, worst")
            along.plot(ends, [np.median(part) for part in parts], color=colour, linewidth=0.8, linestyle=":")
            slowest = 1e3 * np.sort(one.seconds)[::-1]
            ranked.plot(100 * np.arange(1, len(slowest) + 1) / len(slowest), slowest, color=colour, linewidth=1.4)
        along.set_title(f"{graph.name}: worst step of a stretch, median dotted", loc="left", fontsize=9, color=INK)
        along.set_xlabel("edges", fontsize=8)
        along.legend(frameon=False, fontsize=7)
        ranked.set_title("steps that take longer", loc="left", fontsize=9, color=INK)
        ranked.set_xlabel("% of steps", fontsize=8)
        ranked.set_xscale("log")
        for axes in (along, ranked):
            axes.set_yscale("log")
            axes.set_ylabel("ms", fontsize=8)
            axes.tick_params(labelsize=7)
            axes.grid(True, color="#e1e5ea", linewidth=0.6)
    if note:
        figure.suptitle(note, fontsize=9, color=INK)
    figure.savefig(path, dpi=150)
