"""Does the joint map believe false edges? ``python -m tools.robustness --seeds 5`` mixes them in and counts."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

if TYPE_CHECKING:
    from tools.robust.table import Row

app = typer.Typer(add_completion=False)


@app.command()
def main(
    seeds: Annotated[int, typer.Option(min=1, help="Buildings of each sort.")] = 5,
    first_seed: Annotated[int, typer.Option(min=0, help="The first seed.")] = 0,
    data: Annotated[
        Path | None, typer.Option(envvar="MRTM_DATA", help="Folder with posegraphs/csail_2robots, to run that too.")
    ] = None,
) -> None:
    """Loops, sightings and alignments of three robots, in the order in which they come, with false ones among them.

    False edges are random (0 to 70 % of a kind, and of all), or three that agree with each other, or take one of
    identical rooms for another. The last line, if the data are there, is a public set with 250 false closures.
    """
    from tools.robust.csail import FOLDER
    from tools.robust.table import clusters, public, random_edges, rooms, table

    if data is not None and not (data / FOLDER).is_dir():
        raise typer.BadParameter(f"--data {data}: there is no {FOLDER} in it")
    buildings = range(first_seed, first_seed + seeds)
    console = Console(width=None if sys.stdout.isatty() else 140)

    def all_rows() -> "Iterator[Row]":
        yield from random_edges(buildings)
        yield from clusters(buildings)
        yield from rooms(buildings)
        if data is not None:
            yield public(data)

    rows = []
    for row in all_rows():
        rows.append(row)
        console.print(f"{row.false} {row.share}: {row.wrong} wrong, {row.found} of {row.true} found", style="dim")
    console.print(table(rows))


if __name__ == "__main__":
    app()
