"""What a run and its evaluation have to say, for the terminal."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import RenderableType
from rich.markup import escape
from rich.table import Table

from mrtm.evaluation import AbsoluteErrors, Evaluation, Meetings, RelationErrors
from mrtm.result import Latency, RunResult, SightingFate, TeamStory

FATES = ("accepted", "replaced", "refused")
VERDICTS = ("accepted", "waiting", "refused")

MOST_PAIRS = 15
"""Of robots on the screen."""


def run_report(result: RunResult) -> list[RenderableType]:
    """Scans and speed, components, what became of the sightings, edges by type and fate, timings by stage, latencies,
    blemishes of the logs.

    ``timings["total"]``, if there, is the whole run; else the stages are added up.
    """
    parts: list[RenderableType] = [_speed(result)]
    for component in sorted(result.components, key=len, reverse=True):
        robots = ", ".join(dict.fromkeys(vertex.robot for vertex in component))
        parts.append(f"[bold]{len(component)}[/] vertices in one map: {escape(robots)}")
    if len(result.components) > 1:
        parts.append(f"[yellow]{len(result.components)} maps: these robots never came into one[/]")
    if result.team is not None:
        parts += _pairs(result.team)
    if result.edges:
        parts.append(_edges(result))
    if result.timings:
        parts.append(_timings(result))
    if updates := [latency for latency in result.latencies if latency.robot is not None]:
        parts.append(latency_table(updates))
    parts += [f"[yellow]{escape(blemish)}[/]" for blemish in result.blemishes]
    return parts


def evaluation_report(evaluation: Evaluation) -> list[RenderableType]:
    """A table for each thing measured."""
    parts: list[RenderableType] = []
    if evaluation.relations is not None:
        measured = {"all": evaluation.relations}
        if evaluation.relations_across is not None:
            measured["between robots"] = evaluation.relations_across
        parts += _errors("relations", measured)
    if evaluation.ate:
        parts += _errors("trajectory (ATE)", {", ".join(ate.robots): ate for ate in evaluation.ate})
    honest = {f"{kind} edges": honesty for kind, honesty in (evaluation.edges or {}).items()}
    if evaluation.vertices is not None:
        honest["joint vertex poses"] = evaluation.vertices
    if honest:
        table = Table("NEES (1 is honest, above over-confident)")
        for column in ("mean", "median", "max", "count"):
            table.add_column(column, justify="right")
        for name, honesty in honest.items():
            numbers = [f"{value:.2f}" for value in (honesty.nees.mean, honesty.nees.median, honesty.nees.max)]
            table.add_row(name.replace("_", " "), *numbers, str(honesty.count))
        parts.append(table)
    if evaluation.meetings is not None:
        parts += _meetings(evaluation.meetings)
    return parts


def _speed(result: RunResult) -> str:
    scans = sum(len(trajectory.times) for trajectory in result.trajectories.values())
    logged = sum(float(np.ptp(t.times)) for t in result.trajectories.values() if len(t.times))
    seconds = _total(result)
    text = f"[bold]{scans:,}[/] scans over {logged:,.0f} s"
    return f"{text} in [bold]{seconds:.1f} s[/], {logged / seconds:,.0f} times real time" if seconds > 0 else text


def _total(result: RunResult) -> float:
    return result.timings.get("total", sum(result.timings.values()))


def _edges(result: RunResult) -> Table:
    counts = Counter((str(fate.edge.kind), fate.fate) for fate in result.edges)
    table = Table("edges")
    for fate in FATES:
        table.add_column(fate, justify="right")
    for kind in dict.fromkeys(kind for kind, _ in counts):
        table.add_row(kind.replace("_", " "), *(str(counts[kind, fate] or "") for fate in FATES))
    return table


def _pairs(team: TeamStory) -> list[RenderableType]:
    """For every two robots what became of the sightings between them, and why; first those with least believed."""
    if not team.sightings:
        return ["[yellow]nobody saw another: there is no sighting in the session[/]"]
    pairs: dict[tuple[str, str], list[SightingFate]] = {}
    for sighting in team.sightings:
        one, other = sorted((sighting.observer, sighting.observed))
        pairs.setdefault((one, other), []).append(sighting)
    table = Table("sightings between")
    for verdict in VERDICTS:
        table.add_column(verdict, justify="right")
    table.add_column("mostly because")
    fates = {pair: Counter(s.fate for s in sightings) for pair, sightings in pairs.items()}
    order = sorted(pairs, key=lambda pair: (fates[pair]["accepted"] / fates[pair].total(), pair))
    for pair in order[:MOST_PAIRS]:
        names = " and ".join(pair)
        counts = (str(fates[pair][verdict] or "") for verdict in VERDICTS)
        table.add_row(escape(names), *counts, escape(_common_reason(pairs[pair]).replace(f" of {names}", "")))
    rest = len(order) - MOST_PAIRS
    return [table, f"and {rest} more pairs: team.sightings in run.json"] if rest > 0 else [table]


def _common_reason(sightings: Sequence[SightingFate]) -> str:
    """The most common of the reasons, numbers aside, for what is not accepted if there is such."""
    reasons = [s.reason for s in sightings if s.fate != "accepted"] or [s.reason for s in sightings]
    kinds = [re.sub(r"[0-9.]+", "", reason) for reason in reasons]
    return reasons[kinds.index(Counter(kinds).most_common(1)[0][0])]


def _timings(result: RunResult) -> Table:
    table = Table("stage")
    table.add_column("s", justify="right")
    table.add_column("%", justify="right")
    stages = {stage: seconds for stage, seconds in result.timings.items() if stage != "total"}
    total = sum(stages.values())  # of all processes together
    for stage, seconds in stages.items():
        table.add_row(escape(stage), f"{seconds:.2f}", f"{100 * seconds / total:.0f}" if total > 0 else "")
    return table


def latency_table(latencies: Sequence[Latency]) -> Table:
    """From an event to the joint estimate of a robot, by stage and together."""
    table = Table("from a meeting to the joint estimate, ms")
    for column in ("median", "p99", "worst", "times"):
        table.add_column(column, justify="right")
    stages = dict.fromkeys(stage for latency in latencies for stage in latency.seconds)
    spent = {stage: [latency.seconds.get(stage, 0.0) for latency in latencies] for stage in stages}
    spent["together"] = [sum(latency.seconds.values()) for latency in latencies]
    for stage, seconds in spent.items():
        numbers = 1e3 * np.array([*np.quantile(seconds, (0.5, 0.99)), max(seconds)])
        table.add_row(escape(stage), *(f"{number:.1f}" for number in numbers), str(len(seconds)))
    return table


def _errors(title: str, measured: Mapping[str, RelationErrors | AbsoluteErrors]) -> list[RenderableType]:
    """A table, two rows for each thing measured, and what could not be."""
    table = Table(title, "")
    for column in ("mean", "std", "median", "rmse", "max", "count"):
        table.add_column(column, justify="right")
    missing = []
    for name, errors in measured.items():
        for label, unit, digits, s in ((name, "m", 4, errors.translation), ("", "deg", 3, errors.rotation)):
            numbers = [f"{value:.{digits}f}" for value in (s.mean, s.std, s.median, s.rmse, s.max)]
            table.add_row(escape(label), unit, *numbers, str(errors.count) if label else "")
        if errors.no_scan:
            missing.append(f"{escape(name)}: {errors.no_scan} left out, no scan at that time")
        if isinstance(errors, RelationErrors) and errors.unconnected:
            missing.append(f"{escape(name)}: {errors.unconnected} left out, their robots never came into one map")
    return [table, *(f"[yellow]{line}[/]" for line in missing)]


def _meetings(meetings: Meetings) -> list[RenderableType]:
    if meetings.first_meeting is None:
        return ["[yellow]no two robots met[/]"]
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in meetings.verdicts.items())
    count = sum(meetings.verdicts.values())
    met = f"[bold]{count}[/] meetings ({verdicts}), the first at {meetings.first_meeting:.1f} s"
    table = Table("bytes a meeting")
    for column in ("mean", "median", "max", "all meetings"):
        table.add_column(column, justify="right")
    for name, traffic in (*meetings.traffic_by_kind.items(), ("together", meetings.traffic)):
        numbers = traffic.per_meeting.mean, traffic.per_meeting.median, traffic.per_meeting.max, traffic.total
        table.add_row(escape(name), *(f"{number:,.0f}" for number in numbers))
    if meetings.to_common_frame is None:
        return [met, "[yellow]no common frame[/]", table]
    return [met, f"common frame [bold]{meetings.to_common_frame:.1f} s[/] of team time after it", table]
