"""How much sooner the front ends of a team are done on more cores: ``python -m tools.bench.front_ends SESSION``."""

import os
import statistics
import time
from pathlib import Path
from typing import Annotated

import typer

from mrtm.config import load_config
from mrtm.team.front_ends import map_members
from mrtm.team.session_file import open_session


def main(
    session: Annotated[Path, typer.Argument(help="A team session.")],
    cores: Annotated[int, typer.Option(min=2, help="Against one.")] = os.cpu_count() or 2,
    repeat: Annotated[int, typer.Option(min=1, help="Times each, in turn; the medians are compared.")] = 3,
) -> None:
    """Map all robots of a session on one core and on several, and print the seconds and the ratio."""
    team, config = open_session(session), load_config()
    seconds: dict[int, list[float]] = {1: [], cores: []}
    map_members(team, config, cores, lambda *_: None)  # compiles, and reads the logs from the disk
    for _ in range(repeat):
        for count, times in seconds.items():
            started = time.perf_counter()
            map_members(team, config, count, lambda *_: None)
            times.append(time.perf_counter() - started)
    for count, times in seconds.items():
        each = " ".join(f"{t:.2f}" for t in times)
        typer.echo(f"cores {count}: {each} s, median {statistics.median(times):.2f}")
    typer.echo(f"speed-up {statistics.median(seconds[1]) / statistics.median(seconds[cores]):.2f}")


if __name__ == "__main__":
    typer.run(main)
