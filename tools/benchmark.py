"""Speed and accuracy, measured: ``python -m tools.benchmark`` (or ``make bench``).

Without an option: every log at hand, mrtm and the installed peers side by side, as a dated table and a plot in
``tools/results``. ``--stages LOG``: where the time of one run goes. ``--day``: ten simulated hours, cost hour by hour.
``--backend``: the joint graph alone, fed public pose graphs edge by edge, beside bare iSAM2.
"""

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from mrtm.config import Config
from tools.bench.anchors import read_anchors
from tools.bench.backend import BACKENDS, Fed, backend_report, feed, solve
from tools.bench.backend_picture import draw_backend
from tools.bench.bars import draw_day, draw_profile
from tools.bench.day import day_report, drive_day
from tools.bench.logs import BenchLog, find_logs, places
from tools.bench.machine import setting
from tools.bench.peers import PEERS
from tools.bench.plot import draw
from tools.bench.pose_graphs import PoseGraph, find_pose_graphs
from tools.bench.process import ProcessError
from tools.bench.stages import profile, stages_report
from tools.bench.suite import LogReport, run_log, warm_up
from tools.bench.systems import Mrtm, System
from tools.bench.table import differences, report
from tools.simulation import BUILDINGS

RESULTS = Path(__file__).parent / "results"
app = typer.Typer(add_completion=False)


@app.command()
def main(
    stages: Annotated[str, typer.Option(metavar="LOG", help="Profile one run of a log: a name or a file.")] = "",
    day: Annotated[bool, typer.Option("--day", help="Drive a simulated day.")] = False,
    backend: Annotated[bool, typer.Option("--backend", help="Feed pose graphs to the joint graph.")] = False,
    logs: Annotated[list[str] | None, typer.Option("--log", help="Only this log; repeatable.")] = None,
    runs: Annotated[int, typer.Option(min=1, help="Runs of mrtm for each log.")] = 5,
    peer_runs: Annotated[int, typer.Option(min=0, help="Runs of each peer, 0 for none.")] = 1,
    limit: Annotated[float, typer.Option(min=1, help="Seconds after which a run is stopped.")] = 900.0,
    options: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="As of mrtm run.")] = None,
    hours: Annotated[float, typer.Option(min=1, help="Of the simulated day.")] = 10.0,
    rate: Annotated[float, typer.Option(min=0.1, help="Scans a second of the simulated day.")] = 1.0,
    building: Annotated[str, typer.Option(help=f"Of the simulated day: {', '.join(BUILDINGS)}.")] = "office",
    poses: Annotated[int | None, typer.Option(min=2, help="Of the pose graphs; all if not given.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the report.")] = RESULTS,
    note: Annotated[str, typer.Option(help="Put on top of the report, such as: preliminary.")] = "",
) -> None:
    """Measure mrtm, and the peers that are installed, on the logs at hand."""
    out.mkdir(parents=True, exist_ok=True)
    found = find_logs(places())
    chosen = tuple(options or ())
    try:
        if stages:
            path = found[stages].path if stages in found else Path(stages)
            written = _stages(path, chosen, limit, out, note)
        elif day:
            written = _day(found["demo"], building, hours, rate, chosen, out, note)
        elif backend:
            written = _backend(poses, out, note)
        else:
            unknown = [name for name in logs or () if name not in found]
            if unknown:
                raise ProcessError(f"no log {unknown[0]!r} here; there is {', '.join(found)}: set MRTM_DATA")
            written = _compare([found[name] for name in logs or found], runs, peer_runs, limit, chosen, out, note)
    except ProcessError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from error
    typer.echo(written.read_text())
    typer.echo(f"written: {written}")


def _compare(
    logs: list[BenchLog], runs: int, peer_runs: int, limit: float, options: tuple[str, ...], out: Path, note: str
) -> Path:
    here, mrtm = setting(), Mrtm(options)
    systems: list[System] = [mrtm, *(PEERS if peer_runs else ())]
    small = find_logs([])["demo"]
    for system in systems:
        if system.installed() and (failure := warm_up(system, small, limit)):
            if system is mrtm:
                raise ProcessError(f"mrtm on the demo log: {failure}")
            typer.echo(f"{system.name} on the demo log: {failure}", err=True)
    default = Config().model_dump(mode="json")
    anchors = read_anchors()
    table, picture = _names(out, here.day.isoformat(), "benchmark")
    reports: list[LogReport] = []
    for log in logs:  # written anew after each log: a benchmark takes long, and what it has should not be lost
        reports.append(run_log(log, systems, runs, peer_runs, limit, lambda line: typer.echo(line, err=True)))
        config = next((one.config for done in reports for one in done.outcomes if one.config), default)
        differing = list(differences(config, default))
        draw(reports, anchors, picture, note)
        table.write_text(report(here, reports, systems, anchors, differing, note, picture.name))
    return table


def _stages(log: Path, options: tuple[str, ...], limit: float, out: Path, note: str) -> Path:
    here = setting()
    with tempfile.TemporaryDirectory(prefix="bench-") as work:
        measured = profile(log, _given(options), Path(work), limit=limit)
    text, picture = _names(out, here.day.isoformat(), f"stages-{log.name.partition('.')[0]}")
    draw_profile(measured, here.cores, picture, note)
    text.write_text(stages_report(measured, here, options, note, picture.name))
    return text


def _day(
    small: BenchLog, building: str, hours: float, rate: float, options: tuple[str, ...], out: Path, note: str
) -> Path:
    if building not in BUILDINGS:
        raise ProcessError(f"--building {building}: there is {', '.join(BUILDINGS)}")
    from mrtm.cli import app as mrtm

    here = setting()
    given = _given(options)
    with tempfile.TemporaryDirectory(prefix="bench-") as work:
        mrtm(["run", str(small.path), "--out", f"{work}/small", "--quiet", *given], standalone_mode=False)
        measured = drive_day(building, hours, rate, Path(work), given)
    text, picture = _names(out, here.day.isoformat(), "day")
    draw_day(measured, picture, note)
    text.write_text(day_report(measured, here, options, note, picture.name))
    return text


def _backend(poses: int | None, out: Path, note: str) -> Path:
    graphs = find_pose_graphs(places(), poses)
    if not graphs:
        raise ProcessError("no pose graphs here: set MRTM_DATA to a directory that has them in posegraphs/")
    here = setting()
    table, picture = _names(out, here.day.isoformat(), "backend")
    measured: list[tuple[PoseGraph, list[Fed]]] = []
    for graph in graphs:
        fed = [feed(graph, name, lambda line: typer.echo(line, err=True)) for name in BACKENDS]
        measured.append((graph, [*fed, solve(graph)]))
        draw_backend(measured, picture, note)
        table.write_text(backend_report(measured, here, note, picture.name))
    return table


def _given(options: tuple[str, ...]) -> list[str]:
    return [part for option in options for part in ("--set", option)]


def _names(out: Path, day: str, what: str) -> tuple[Path, Path]:
    return out / f"{day}-{what}.md", out / f"{day}-{what}.png"


if __name__ == "__main__":
    app()
