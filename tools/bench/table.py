"""The benchmark's report as Markdown."""

import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from tools.bench.anchors import Anchor
from tools.bench.machine import Setting
from tools.bench.suite import LogReport, Outcome, Spread
from tools.bench.systems import System

HEADER = ("system", "metres", "degrees", "wall, s", "CPU, s", "scans/s", "times real time", "peak, MB")


def report(
    setting: Setting,
    reports: Sequence[LogReport],
    systems: Sequence[System],
    anchors: Mapping[str, Sequence[Anchor]],
    parameters: Sequence[str],
    note: str = "",
    picture: str = "",
) -> str:
    """The whole table.

    Args:
        parameters: of mrtm that are not the default, ``key = value`` each.
        note: what a reader must know first.
        picture: file name of the plot beside it.
    """
    lines = [f"# Benchmark of {setting.day.isoformat()}", ""]
    if note:
        lines += [f"**{note}**", ""]
    lines += setting.lines()
    lines += [f"- parameters of mrtm: {', '.join(parameters) if parameters else 'all default'}"]
    lines += [
        f"- {system.name}: {system.about}" + ("" if system.installed() else f"; not installed: `{system.install}`")
        for system in systems
        if system.install
    ]
    lines += [
        "",
        "Each run is a whole process, from its start to its end. The logs of the peers were converted beforehand, mrtm",
        "reads the compressed text. Poses between a peer's key scans are carried by odometry; all are scored by",
        "`mrtm.evaluation`. Costs are the median over the runs, with least and greatest; scans/s and times real time",
        "are those of the median.",
    ]
    if picture:
        lines += ["", f"![accuracy against time]({picture})"]
    cited: dict[str, int] = {}
    for one in reports:
        lines += ["", *_section(one, systems, anchors.get(one.log.name, ()), cited)]
    if cited:
        lines += ["", "Sources: " + "; ".join(f"[{number}] {source}" for source, number in cited.items()) + "."]
    return "\n".join(lines) + "\n"


def differences(config: Mapping[str, Any], default: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """``key = value`` of every parameter that differs from the default."""
    for key, value in config.items():
        usual = default.get(key)
        if isinstance(value, Mapping) and isinstance(usual, Mapping):
            yield from differences(value, usual, f"{prefix}{key}.")
        elif value != usual:
            yield f"{prefix}{key} = {value} (default {usual})"


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A table whose first column is text and the others numbers."""
    bars = ["---"] + ["---:"] * (len(header) - 1)
    return ["| " + " | ".join(row) + " |" for row in (header, bars, *rows)]


def _section(
    one: LogReport, systems: Sequence[System], anchors: Sequence[Anchor], cited: dict[str, int]
) -> Iterator[str]:
    """The part on one log; the sources it cites are numbered in ``cited``."""
    left_out = one.odometry.left_out
    yield f"## {one.log.name}: {one.scans} scans, {one.duration:.0f} s"
    yield ""
    yield f"Accuracy: {one.log.metric}, ± standard deviation, over {one.odometry.measured}" + (
        f" ({left_out} without a scan near)." if left_out else "."
    )
    yield ""
    rows = [_row(one, system, outcome) for system, outcome in zip(systems, one.outcomes, strict=True)]
    odometry = f"{one.odometry.headline[0]:.3f} ± {one.odometry.translation.std:.3f}"
    rows.append(_filled("odometry alone", odometry, f"{one.odometry.headline[1]:.2f}"))
    for anchor in anchors:
        number = cited.setdefault(anchor.source, len(cited) + 1)
        rows.append(_anchor_row(one, anchor, number))
    yield from markdown(HEADER, rows)
    for outcome in one.outcomes:
        if outcome.stages:
            yield ""
            yield from _stages(outcome)


def _row(one: LogReport, system: System, outcome: Outcome) -> list[str]:
    name = system.name if system.install else f"**{system.name}**"
    if not outcome.costs:
        return _filled(name, outcome.failure)
    metres = Spread.of([score.headline[0] for score in outcome.scores])
    degrees = Spread.of([score.headline[1] for score in outcome.scores])
    deviation = statistics.median(score.translation.std for score in outcome.scores)
    wall, cpu = outcome.cost("wall"), outcome.cost("cpu")
    return [
        name + (f" ({outcome.failure})" if outcome.failure else ""),
        f"{metres.median:.4f} ± {deviation:.4f}" + (_range(metres, 4) if metres.low != metres.high else ""),
        f"{degrees.median:.3f}" + (_range(degrees, 3) if degrees.low != degrees.high else ""),
        f"{wall.median:.2f}{_range(wall, 2)}",
        f"{cpu.median:.2f}{_range(cpu, 2)}",
        f"{one.scans / wall.median:.0f}",
        f"{one.duration / wall.median:.0f}",
        f"{outcome.cost('memory').high:.0f}",
    ]


def _anchor_row(one: LogReport, anchor: Anchor, number: int) -> list[str]:
    mean, deviation = anchor.metres
    wall = anchor.wall
    return [
        f"{anchor.system} [{number}]",
        f"{mean:.4f} ± {deviation:.4f}",
        "" if anchor.degrees is None else f"{anchor.degrees:g}",
        "" if wall is None else f"{wall:g}",
        "",
        "" if wall is None else f"{one.scans / wall:.0f}",
        "" if wall is None else f"{one.duration / wall:.0f}",
        "" if anchor.memory is None else f"{anchor.memory:g}",
    ]


def _stages(outcome: Outcome) -> Iterator[str]:
    wall = outcome.cost("wall").median
    rows = []
    for stage in outcome.stages[0]:
        seconds = Spread.of([stages[stage] for stages in outcome.stages])
        rows.append([stage, f"{seconds.median:.2f}{_range(seconds, 2)}", f"{100 * seconds.median / wall:.0f}"])
    yield from markdown((f"stage of {outcome.system}", "s", "% of wall"), rows)


def _range(spread: Spread, digits: int) -> str:
    return f" ({spread.low:.{digits}f}–{spread.high:.{digits}f})" if spread.low != spread.high else ""  # noqa: RUF001


def _filled(*cells: str) -> list[str]:
    return [*cells, *[""] * (len(HEADER) - len(cells))]
