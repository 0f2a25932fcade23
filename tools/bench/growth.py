"""What a robot of a team pays for the joint map, by what it knows: ``python -m tools.bench.growth SESSION``.

One robot after the other is played alone: it meets the others, who hear and tell, and thinks about what it hears; they
do not, so that nothing is worked out for it. All of its meetings count from end to end, what the others do included.
"""

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from mrtm.config import Config, load_config
from mrtm.cores import limited_to
from mrtm.team.front_ends import map_members
from mrtm.team.member import MemberRun
from mrtm.team.playback import Playback
from mrtm.team.session_file import open_session
from mrtm.team.sightings_file import TimedSighting

FACTOR = 2.0  # between the rows, of the records
FIRST = 1000  # records


class Lone(Playback):
    """A team of which one robot alone thinks.

    Attributes:
        paid: records that the robot held after each of its meetings, and CPU seconds of these so far.
    """

    def __init__(
        self, robot: str, runs: Sequence[MemberRun], sightings: Sequence[TimedSighting], config: Config
    ) -> None:
        super().__init__(runs, sightings, config)
        self.paid: list[tuple[int, float]] = []
        self._robot, self._seconds = robot, 0.0
        for name in self.team.keys() - {robot}:
            self.team[name].is_due = lambda: False  # type: ignore[method-assign]

    def meet(self, time_: float, robots: tuple[str, str]) -> None:
        """As in any team; what it takes is counted."""
        due = self._robot in robots
        started = time.process_time()
        super().meet(time_, robots)
        if due:
            self._seconds += time.process_time() - started
            self.paid.append((len(self.team[self._robot].store), self._seconds))


def main(
    session: Annotated[Path, typer.Argument(help="A team session.")],
    robot: Annotated[list[str] | None, typer.Option(help="Played alone; may be repeated. The first four.")] = None,
    cores: Annotated[int, typer.Option(min=1, help="For the front ends.")] = os.cpu_count() or 1,
) -> None:
    """CPU seconds of all meetings of a robot until it knew so many records, and for each of these."""
    team, config, console = open_session(session), load_config(), Console()
    with limited_to(cores):
        runs = map_members(team, config, cores, lambda fraction, doing: None)
    powers: list[str] = []
    if hasattr(os, "sched_setaffinity"):  # each robot has one core; GTSAM takes all that it is given
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    table = Table("robot", "records", "CPU, s", "a record, ms", title="meetings and updates, until so much was known")
    with limited_to(1):
        for name in robot or [run.robot for run in runs[:4]]:
            found = rows(name, runs, team.sightings, config)
            for records, seconds in found:
                table.add_row(name, str(records), f"{seconds:.2f}", f"{1e3 * seconds / records:.3f}")
            table.add_section()
            powers.append(f"{name} {power(found):.2f}")
    console.print(table, f"power of the records by which it grows: {', '.join(powers)}")


def rows(
    robot: str, runs: Sequence[MemberRun], sightings: Sequence[TimedSighting], config: Config
) -> list[tuple[int, float]]:
    """Records and CPU seconds of one robot, each row FACTOR times the records of the one before, and the last."""
    team = Lone(robot, runs, sightings, config)
    team.play(lambda fraction: None)
    found: list[tuple[int, float]] = []
    for records, seconds in team.paid:
        if records >= (FACTOR * found[-1][0] if found else FIRST):
            found.append((records, seconds))
    return found + [last for last in team.paid[-1:] if last not in found]


def power(found: Sequence[tuple[int, float]]) -> float:
    """Of rows the slope of log seconds over log records; 1 where each record costs the same. NaN of less than two."""
    if len(found) < 2:
        return float("nan")
    records, seconds = np.log(found).T
    return float(np.polyfit(records, seconds, 1)[0])


if __name__ == "__main__":
    typer.run(main)
