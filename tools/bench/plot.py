"""The benchmark's picture: accuracy against time, one panel a log."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mrtm.output.style import INK, MUTED
from tools.bench.anchors import Anchor
from tools.bench.suite import LogReport, Outcome

COLOURS = {"mrtm": "#dc3545"}
PEER_COLOURS = ("#2f6fde", "#1f9d55", "#e8710a", "#8a4fd3", "#0c9fb5")
WORST = 20.0  # an error above this many times the best one is drawn at the edge of its panel


def draw(reports: Sequence[LogReport], anchors: Mapping[str, Sequence[Anchor]], path: Path, note: str = "") -> None:
    """Draw what was run here filled, what others report hollow; an error without a time is a line."""
    figure = Figure(figsize=(5.2 * len(reports), 4.6), layout="constrained")
    panels = figure.subplots(1, len(reports), squeeze=False)[0]
    for axes, report in zip(panels, reports, strict=True):
        _panel(axes, report, anchors.get(report.log.name, ()))
    if note:
        figure.suptitle(note, color=COLOURS["mrtm"], fontsize=9)
    figure.savefig(path, dpi=150)


def _panel(axes: Axes, report: LogReport, anchors: Sequence[Anchor]) -> None:
    peers = [outcome.system for outcome in report.outcomes if outcome.system != "mrtm"]
    colours = COLOURS | dict(zip(peers, PEER_COLOURS, strict=False))
    errors = [anchor.metres[0] for anchor in anchors]
    errors += [score.headline[0] for outcome in report.outcomes for score in outcome.scores]
    if not errors:
        return
    ceiling = WORST * min(errors)
    for anchor in anchors:
        _anchor(axes, anchor, ceiling)
    for outcome in report.outcomes:
        if outcome.costs:
            _outcome(axes, outcome, colours[outcome.system], ceiling)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("whole process, s")
    axes.set_ylabel(f"{report.log.metric}, m")
    axes.set_title(f"{report.log.name}: {report.scans} scans, {report.duration:.0f} s", color=INK, fontsize=10)
    axes.grid(True, which="both", color="#e1e5ea", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.margins(0.25)
    ticks = [tick for tick in (0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 5) if min(errors) / 2 < tick]
    axes.set_yticks([tick for tick in ticks if tick < 1.5 * min(ceiling, max(errors))], minor=False)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.tick_params(which="minor", labelleft=False)


def _outcome(axes: Axes, outcome: Outcome, colour: str, ceiling: float) -> None:
    wall = outcome.cost("wall")
    error = sorted(score.headline[0] for score in outcome.scores)[len(outcome.scores) // 2]
    y = min(error, ceiling)
    axes.errorbar(
        wall.median,
        y,
        xerr=[[wall.median - wall.low], [wall.high - wall.median]],
        fmt="^" if error > ceiling else "o",
        color=colour,
        markersize=9 if outcome.system == "mrtm" else 7,
        capsize=3,
        zorder=3,
    )
    text = outcome.system if error <= ceiling else f"{outcome.system}: {error:.2g} m"
    axes.annotate(
        text,
        (wall.median, y),
        xytext=(7, 5),
        textcoords="offset points",
        fontsize=8,
        color=colour,
        weight="bold" if outcome.system == "mrtm" else "normal",
        zorder=4,
    )


def _anchor(axes: Axes, anchor: Anchor, ceiling: float) -> None:
    error = min(anchor.metres[0], ceiling)
    text = anchor.system if anchor.metres[0] <= ceiling else f"{anchor.system}: {anchor.metres[0]:.2g} m"
    if anchor.wall is None:
        axes.axhline(error, color=MUTED, linewidth=0.7, linestyle=(0, (4, 3)), zorder=1)
        axes.annotate(
            text,
            (1.0, error),
            xycoords=("axes fraction", "data"),
            xytext=(-3, 2),
            textcoords="offset points",
            ha="right",
            fontsize=7,
            color=MUTED,
        )
        return
    marker = "s" if anchor.measured else "D"
    axes.plot(anchor.wall, error, marker, markerfacecolor="white", color=MUTED, markersize=6, zorder=2)
    axes.annotate(text, (anchor.wall, error), xytext=(6, -9), textcoords="offset points", fontsize=7, color=MUTED)
