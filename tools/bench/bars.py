"""The pictures of a profile (stages, functions and kernels) and of a day (cost and memory by hour)."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mrtm.output.style import INK, MUTED
from tools.bench.day import Day
from tools.bench.stages import TOP, Profile

KERNEL, PYTHON, STAGE = "#dc3545", "#2f6fde", "#39424f"


def draw_profile(measured: Profile, cores: int, path: Path, note: str = "") -> None:
    """Draw the stages above, functions (blue) and kernels (red) below, and under them what bounds the run."""
    stages = dict(sorted(measured.stages.items(), key=lambda stage: -stage[1]))
    top = measured.functions[:TOP]
    figure = Figure(figsize=(9, 1.9 + 0.26 * (len(stages) + len(top)) + 1.6), layout="constrained")
    upper, lower, words = figure.subplots(3, 1, height_ratios=[len(stages) + 1.0, len(top) + 1.0, 6.0])
    title = f"{measured.log}: whole process, {measured.cost.wall:.2f} s wall, {measured.cost.cpu:.2f} s CPU"
    _bars(upper, list(stages), list(stages.values()), [STAGE] * len(stages), title)
    colours = [KERNEL if function.kernel else PYTHON for function in top]
    title = f"own time under the profiler, {measured.profiled:.2f} s in all: kernels red, Python blue"
    _bars(lower, [f.name for f in top], [f.seconds for f in top], colours, title)
    words.axis("off")
    text = "\n".join(line for sentence in measured.bound(cores) for line in textwrap.wrap(sentence, 95))
    words.text(0.0, 1.0, text, transform=words.transAxes, va="top", fontsize=7.5, color=INK)
    if note:
        figure.suptitle(note, color=KERNEL, fontsize=9)
    figure.savefig(path, dpi=150)


def draw_day(day: Day, path: Path, note: str = "") -> None:
    """Draw CPU and wall clock a scan, and memory, hour by hour."""
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    numbers = range(1, len(day.hours) + 1)
    left.plot(numbers, [1e3 * hour.cpu / hour.scans for hour in day.hours], "o-", color=KERNEL, label="CPU")
    left.plot(numbers, [1e3 * hour.wall / hour.scans for hour in day.hours], "o-", color=PYTHON, label="wall clock")
    left.set_ylabel("ms a scan")
    left.legend(frameon=False)
    right.plot(numbers, [hour.memory for hour in day.hours], "o-", color=STAGE)
    right.set_ylabel("memory, MB")
    for axes in (left, right):
        axes.set_xlabel("hour")
        axes.set_ylim(0, 1.1 * axes.get_ylim()[1])
        axes.grid(True, color="#e1e5ea", linewidth=0.6)
    figure.suptitle(f"{day.building}{f' ({note})' if note else ''}", fontsize=9, color=INK)
    figure.savefig(path, dpi=150)


def _bars(axes: Axes, names: Sequence[str], seconds: Sequence[float], colours: Sequence[str], title: str) -> None:
    places = range(len(names))
    axes.barh(places, seconds, color=colours, height=0.7)
    for place, value in zip(places, seconds, strict=True):
        axes.annotate(
            f"{value:.2f}",
            (value, place),
            xytext=(3, 0),
            textcoords="offset points",
            va="center",
            fontsize=7,
            color=MUTED,
        )
    axes.set_yticks(places, names, fontsize=7)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_title(title, loc="left", fontsize=9, color=INK)
    axes.set_xlabel("s", fontsize=8)
    axes.tick_params(axis="x", labelsize=7)
    axes.margins(x=0.08)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
