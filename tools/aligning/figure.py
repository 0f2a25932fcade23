"""The figure: whether the covariances mean what they say, and what errors remain."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import chi2

from mrtm.output.style import INK
from tools.aligning.pairs import Case

COLOURS = ("#2f6fde", "#e8710a", "#1f9d55", "#8a4fd3", "#dc3545", "#0c9fb5", "#8d6142")


def draw(cases: Sequence[Case], title: str, path: Path) -> None:
    """Draw accepted alignments of true pairs, a colour a plan, to a PNG."""
    figure, (honesty, errors, components) = plt.subplots(1, 3, figsize=(16, 5), layout="constrained")
    x = np.geomspace(0.01, 100, 300)
    honesty.plot(x, chi2.cdf(3 * x, 3), color=INK, linewidth=2, label="honest")
    good = [case for case in cases if case.kind == "true" and case.accepted]
    for plan, colour in zip(dict.fromkeys(case.plan for case in good), COLOURS, strict=False):
        mine = [case for case in good if case.plan == plan]
        share = np.arange(1, len(mine) + 1) / len(mine)
        honesty.step(np.sort([case.nees for case in mine]), share, color=colour, label=f"{plan} ({len(mine)})")
        error = np.array([case.error for case in mine])
        errors.step(np.sort(np.hypot(error[:, 0], error[:, 1])), share, color=colour)
        for case in mine:
            assert case.alignment is not None
            values, vectors = np.linalg.eigh(case.alignment.estimate.covariance[:2, :2])
            off = np.abs(vectors.T @ case.error[:2])
            components.plot(np.sqrt(values[0]), off[0], ".", color=colour, markersize=4)
            components.plot(np.sqrt(values[1]), off[1], "x", color=colour, markersize=4)
    honesty.set(xscale="log", xlim=(0.01, 100), ylim=(0, 1), xlabel="NEES / 3", ylabel="fraction below")
    honesty.legend(loc="lower right", fontsize=8)
    errors.set(xscale="log", ylim=(0, 1), xlabel="error, m", ylabel="fraction below")
    line = np.array([1e-3, 10.0])
    components.plot(line, line, color=INK, linewidth=1)
    components.plot(line, 2 * line, color=INK, linewidth=0.5, linestyle=":")
    components.set(
        xscale="log",
        yscale="log",
        xlim=(1e-3, 10),
        ylim=(1e-4, 10),
        xlabel="standard deviation claimed, m (dot: strong, cross: weak direction)",
    )
    components.set(ylabel="error in that direction, m")
    figure.suptitle(title, color=INK)
    figure.savefig(path, dpi=110)
    plt.close(figure)
