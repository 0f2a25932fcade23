"""Are the covariances honest? ``python -m tools.nees --seeds 8`` measures them against simulated truth."""

import itertools
import multiprocessing
import os
import sys
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import track

from mrtm.cores import use_cores

if TYPE_CHECKING:
    from tools.honesty.runs import Honesty

DEFAULT_PLANS = "corridor,hall,cluttered,loop/ring"

app = typer.Typer(add_completion=False)


@app.command()
def main(
    plans: Annotated[
        str, typer.Option(help="Simulated buildings, NAME or NAME/ROUTE, with commas; empty for none.")
    ] = DEFAULT_PLANS,
    seeds: Annotated[int, typer.Option(min=1, help="Buildings and drives of each plan.")] = 8,
    first_seed: Annotated[int, typer.Option(min=0, help="The first seed.")] = 0,
    laps: Annotated[
        int, typer.Option(min=1, help="Times each closed route is driven, for loops and re-entries; others once.")
    ] = 2,
    log: Annotated[list[Path] | None, typer.Option(help="A real log to map: innovations only. Repeatable.")] = None,
    run: Annotated[list[Path] | None, typer.Option(help="What `mrtm run` left: innovations only. Repeatable.")] = None,
    options: Annotated[list[str] | None, typer.Option("--set", help="section.key=value of the configuration.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes, one thread each.")] = os.cpu_count() or 1,
    out: Annotated[Path, typer.Option(help="Folder for nees.md and nees.png.")] = Path("tools/results"),
) -> None:
    """Run simulated buildings through the pipeline and hold every covariance against the truth.

    Writes the tables as nees.md and the figure as nees.png. Real logs have no truth: what they tell is whether
    re-entries and repeated measurements of an edge agree within the covariances claimed.
    """
    from frontend.errors import FrontendError
    from mrtm.errors import MrtmError
    from tools.bench.machine import setting
    from tools.honesty.runs import finished, logged, simulated
    from tools.honesty.tables import tables
    from tools.simulation import BUILDINGS, SimulationError

    names = [name for name in plans.split(",") if name]
    for name in names:
        building, _, route = name.partition("/")
        if building not in BUILDINGS:
            raise typer.BadParameter(f"--plans {name}: no such building; there is: {', '.join(BUILDINGS)}")
        routes = BUILDINGS[building](first_seed).routes
        if route and route not in routes:
            raise typer.BadParameter(f"--plans {name}: no such route; there is: {', '.join(routes)}")
    given = tuple(options or ())
    work: list[tuple[Callable[..., Honesty], tuple[object, ...]]] = [(logged, (path, given)) for path in log or ()]
    work += [
        (simulated, (name, seed, laps, given))
        for seed, name in itertools.product(range(first_seed, first_seed + seeds), names)
    ]
    try:
        runs = [finished(directory) for directory in run or ()] + _all(work, jobs)
    except (FrontendError, MrtmError, SimulationError, OSError, ValueError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from error
    console = Console(width=None if sys.stdout.isatty() else 160)
    found = tables(runs)
    for table in found:
        console.print(table.rich())
    out.mkdir(parents=True, exist_ok=True)
    what = f"{seeds} seeds from {first_seed}, {laps} laps" + "".join(f", {option}" for option in given)
    here = setting()
    made = f"commit {here.commit}, {here.day.isoformat()}\n"
    text = "\n".join(table.markdown() for table in found)
    (out / "nees.md").write_text(f"# Honesty of covariances\n\n{what}\n\n{made}\n{text}", encoding="utf-8")
    samples = [sample for one in runs for sample in one.samples]
    if samples:
        from tools.honesty.figure import draw

        draw(samples, f"Honesty of covariances: {what}", out / "nees.png")
    console.print(f"written to {out}")


def _all(work: "list[tuple[Callable[..., Honesty], tuple[object, ...]]]", jobs: int) -> "list[Honesty]":
    """The results in the order of the work."""
    if not work:
        return []
    # Spawned, not forked: numba's threads and the environment start anew.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), use_cores, (1,)) as pool:
        futures: list[Future[Honesty]] = [pool.submit(function, *arguments) for function, arguments in work]
        for done in track(as_completed(futures), total=len(futures), description="runs", console=Console(stderr=True)):
            done.result()
        return [future.result() for future in futures]


if __name__ == "__main__":
    app()
