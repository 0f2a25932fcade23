"""The figure: NEES by kind and plan, and which direction of the error is not what its sigma says."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from scipy.stats import chi2

from mrtm.output.style import INK, MUTED
from tools.honesty.runs import Sample
from tools.honesty.statistics import components, verdict
from tools.honesty.tables import ALL, KINDS, groups

MUST, GOAL = (0.5, 2.0), (0.8, 1.25)
COLOURS = ("#2f6fde", "#e8710a", "#1f9d55", "#8a4fd3", "#dc3545", "#0c9fb5", "#8d6142")


def draw(samples: Sequence[Sample], title: str, path: Path) -> None:
    """Draw the samples of a set of simulated runs to a PNG."""
    found = groups(samples, lambda s: s.plan)
    kinds = [kind for kind in KINDS if (kind, ALL) in found]
    plans = list(dict.fromkeys(name for _, name in found if name != ALL))
    colours = dict(zip([*plans, ALL], [*COLOURS[: len(plans)], INK], strict=False))
    figure, (means, shapes, parts) = plt.subplots(1, 3, figsize=(16, 5.5), layout="constrained")
    _means(means, found, kinds, colours)
    _distributions(shapes, found, kinds)
    _components(parts, found, kinds)
    figure.suptitle(title, color=INK)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _means(axes: Axes, found: dict[tuple[str, str], list[Sample]], kinds: list[str], colours: dict[str, str]) -> None:
    axes.axvspan(*MUST, color="#e9f2ec")
    axes.axvspan(*GOAL, color="#cfe6d6")
    axes.axvline(1.0, color=MUTED, linewidth=0.8)
    for row, kind in enumerate(kinds):
        for i, (name, colour) in enumerate(colours.items()):
            v = verdict(found.get((kind, name), []))
            if v is not None:
                y = row + 0.7 * (i / max(1, len(colours) - 1) - 0.5)
                axes.plot(v.bootstrap, (y, y), color=colour, linewidth=2)
                axes.plot(v.mean, y, "o", color=colour, markersize=5, label=name if row == 0 else None)
                axes.plot(v.median / 0.789, y, "|", color=colour, markersize=9)
    axes.set(xscale="log", xlabel="NEES / 3: mean (dot), 95 % by bootstrap over runs (line), median / 0.79 (tick)")
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, 0.1), max(high, 10.0))
    axes.set_yticks(range(len(kinds)), [kind.replace("_", "\n") for kind in kinds])
    axes.invert_yaxis()
    axes.legend(loc="best", fontsize=8)


def _distributions(axes: Axes, found: dict[tuple[str, str], list[Sample]], kinds: list[str]) -> None:
    x = np.geomspace(0.01, 100, 300)
    axes.plot(x, chi2.cdf(3 * x, 3), color=INK, linewidth=2, label="honest")
    for kind, colour in zip(kinds, COLOURS, strict=False):
        values = np.sort([sample.nees for sample in found[kind, ALL]])
        label = f"{kind.replace('_', ' ')} ({len(values)})"
        axes.step(values, np.arange(1, len(values) + 1) / len(values), color=colour, label=label)
    axes.set(xscale="log", xlim=(0.01, 100), ylim=(0, 1), xlabel="NEES / 3", ylabel="fraction below")
    axes.legend(loc="lower right", fontsize=8)


def _components(axes: Axes, found: dict[tuple[str, str], list[Sample]], kinds: list[str]) -> None:
    names: list[str] = []
    for kind, colour in zip(kinds, COLOURS, strict=False):
        parts = components(found[kind, ALL], axis_aligned=False)
        names = [part.name for part in parts]
        axes.plot(range(len(parts)), [part.ratio for part in parts], "o", color=colour, label=kind.replace("_", " "))
        corridors = [s for s in found[kind, ALL] if s.plan.startswith("corridor")]
        if corridors:
            extra = [c for c in components(corridors, True) if c.name in ("along", "across")]
            axes.plot(range(len(parts), len(parts) + 2), [c.ratio for c in extra], "s", color=colour)
    axes.axhspan(np.sqrt(MUST[0]), np.sqrt(MUST[1]), color="#e9f2ec")
    axes.axhline(1.0, color=MUTED, linewidth=0.8)
    ticks = [*names, "along\ncorridor", "across\ncorridor"]
    axes.set_xticks(range(len(ticks)), ticks)
    axes.set(yscale="log", ylabel="rms of error / sigma (above 1: over-confident)")
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.1), max(high, 10.0))
    axes.legend(loc="best", fontsize=8)
