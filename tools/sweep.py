"""Does one configuration do for everything? ``python -m tools.sweep`` maps logs and buildings with many seeds each.

``--vary frontend.sensing_range=15,25,40`` does so once for the default and once for every value.
"""

import itertools
import multiprocessing
import os
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import track

from mrtm.cores import use_cores

if TYPE_CHECKING:
    from tools.bench.logs import BenchLog

PLANS = "corridor,hall,cluttered,factory,loop/ring,office/ring"
BROKEN = 1.0
"""Metres: a log of which a relation, or a pose against the reference, is off by more has a broken map."""
LOST = 0.3
"""Metres of ATE RMSE beyond which a simulated building has one; a false loop breaks it, too."""

app = typer.Typer(add_completion=False)


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run: the place's headline error in metres, and whether the map is broken."""

    place: str
    change: str
    seed: int
    error: float
    broken: bool


def on_log(log: "BenchLog", change: str, seed: int) -> Outcome:
    """Map a real log."""
    from frontend.readers import open_log
    from mrtm.config import load_config
    from mrtm.evaluation import TimedPoses
    from mrtm.session import map_scans
    from tools.bench.logs import score

    config = load_config(options=[f"seed={seed}", *([change] if change else [])])
    (trajectory,) = map_scans(open_log(log.path).scans(), config).trajectories.values()
    found = score(log, TimedPoses(trajectory.times, trajectory.poses))
    return Outcome(log.name, change, seed, found.headline[0], found.translation.max > BROKEN)


def in_building(plan: str, change: str, seed: int) -> Outcome:
    """Map a simulated building, two laps."""
    from tools.honesty.runs import simulated

    run = simulated(plan, seed, 2, [change] if change else [])
    false = any(sample.is_false for sample in run.samples if sample.kind == "loop")
    return Outcome(plan, change, seed, run.ate, run.ate > LOST or false)


def table(outcomes: list[Outcome]) -> str:
    """Markdown: a row for each place and change."""
    rows: defaultdict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        rows[outcome.place, outcome.change].append(outcome)
    lines = [
        "| place | change | runs | median, m | best | worst | worst / best | broken (seeds) |",
        "|---|---|--:|--:|--:|--:|--:|---|",
    ]
    for (place, change), found in sorted(rows.items()):
        errors = sorted(outcome.error for outcome in found)
        broken = ", ".join(str(outcome.seed) for outcome in found if outcome.broken)
        lines.append(
            f"| {place} | {change or 'default'} | {len(errors)} | {errors[len(errors) // 2]:.4f} | {errors[0]:.4f} "
            f"| {errors[-1]:.4f} | {errors[-1] / errors[0]:.2f} | {broken or 'none'} |"
        )
    return "\n".join(lines) + "\n"


@app.command()
def main(
    plans: Annotated[str, typer.Option(help="Simulated buildings, NAME or NAME/ROUTE, with commas.")] = PLANS,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each.")] = 10,
    first_seed: Annotated[int, typer.Option(min=0, help="The first seed.")] = 0,
    vary: Annotated[list[str] | None, typer.Option(metavar="KEY=A,B,...", help="Values to try. Repeatable.")] = None,
    logs: Annotated[bool, typer.Option(help="The real logs that are at hand.")] = True,
    jobs: Annotated[int, typer.Option(min=1, help="Processes, one thread each.")] = os.cpu_count() or 1,
    out: Annotated[Path, typer.Option(help="Folder for sweep.md.")] = Path("tools/results"),
) -> None:
    """Map everything with every seed and every change; print and write the spread, and which maps broke."""
    from tools.bench.logs import find_logs, places
    from tools.bench.machine import setting

    changes = [""]
    for variation in vary or ():
        key, _, values = variation.partition("=")
        changes += [f"{key}={value}" for value in values.split(",")]
    found = find_logs(places()) if logs else {}
    found.pop("demo", None)
    work = [(on_log, (log, c, s)) for s in _range(first_seed, seeds) for log in found.values() for c in changes]
    names = [name for name in plans.split(",") if name]
    buildings = [(in_building, (n, c, s)) for s, n, c in itertools.product(_range(first_seed, seeds), names, changes)]
    # Spawned, not forked: numba's threads and the environment start anew.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), use_cores, (1,)) as pool:
        futures = [pool.submit(f, *arguments) for f, arguments in work]
        futures += [pool.submit(f, *arguments) for f, arguments in buildings]
        outcomes = [future.result() for future in track(futures, "runs", console=Console(stderr=True))]
    here = setting()
    text = table(outcomes)
    out.mkdir(parents=True, exist_ok=True)
    head = f"# One configuration\n\n{seeds} seeds from {first_seed}. Relations' mean (Intel, ACES), else ATE RMSE.\n"
    made = f"A map is broken beyond {BROKEN} m (logs), {LOST} m RMSE or by a false loop (buildings).\n\n"
    (out / "sweep.md").write_text(
        f"{head}{made}commit {here.commit}, {here.day.isoformat()}\n\n{text}", encoding="utf-8"
    )
    typer.echo(text)


def _range(first: int, count: int) -> range:
    return range(first, first + count)


if __name__ == "__main__":
    app()
