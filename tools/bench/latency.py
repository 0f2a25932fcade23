"""From a meeting to the joint estimate, by the size of the map: ``python -m tools.bench.latency``.

Simulated robots share a building of many rooms. They are played side by side in one process, which times each of them
by itself; what comes of sightings is worked out once by robots that hold the same records, and counts for the first.
"""

import itertools
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from mrtm.config import load_config
from mrtm.cores import limited_to
from mrtm.output.report import latency_table
from mrtm.result import Latency
from mrtm.team.front_ends import map_members
from mrtm.team.playback import play
from mrtm.team.session_file import TeamSession, open_session
from tools.simulation import SightingModel, blocks, simulate_team, write_session

SIGHTINGS = 0.5  # a second, of two robots that see each other
SIZES = (0, 100, 200, 300, 10**9)  # vertices of the joint map


def main(
    session: Annotated[Path | None, typer.Argument(help="A team session, in place of a simulated one.")] = None,
    robots: Annotated[int, typer.Option(min=2, help="Of the simulated team.")] = 12,
    minutes: Annotated[float, typer.Option(min=1, help="That it drives.")] = 10.0,
    cores: Annotated[int, typer.Option(min=1, help="For the front ends.")] = os.cpu_count() or 1,
) -> None:
    """Latencies of all robots by stage, for maps of several sizes, in a run that ends with some 300 vertices."""
    with tempfile.TemporaryDirectory() as folder:
        latencies = measured(open_session(session or simulated(robots, minutes, Path(folder))), cores)
    console = Console()
    for low, high in itertools.pairwise(SIZES):
        within = [latency for latency in latencies if latency.robot is not None and low <= latency.vertices < high]
        if within:
            most = max(latency.vertices for latency in within)
            console.print(f"[bold]{low} to {most} vertices[/]", latency_table(within), sep="\n")
    at_the_end = latencies[-1]
    stages = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in at_the_end.seconds.items())
    console.print(f"who hears all at the end, {at_the_end.vertices} vertices: {stages}")


def simulated(robots: int, minutes: float, folder: Path) -> Path:
    """The session file of a simulated team."""
    plan = blocks(0, robots=robots)
    team = simulate_team(plan, list(plan.routes), seconds=60.0 * minutes)
    write_session(team, SightingModel(rate=SIGHTINGS), 0, folder)
    return folder / "team.yaml"


def measured(session: TeamSession, cores: int) -> Sequence[Latency]:
    """Map a session, and play it with one core: each robot has its own."""
    with limited_to(cores):
        runs = map_members(session, load_config(), cores, lambda fraction, doing: None)
    with limited_to(1):
        return play(runs, session.sightings, load_config()).latencies


if __name__ == "__main__":
    typer.run(main)
