"""What a team costs as it grows: the first N robots of a session mapped and played, and the ratio to real time."""

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from mrtm.config import load_config
from mrtm.team.front_ends import map_members
from mrtm.team.playback import Playback
from mrtm.team.session_file import TeamSession, open_session

T = TypeVar("T")


def first(session: TeamSession, count: int) -> TeamSession:
    """The session of its first robots only."""
    names = {member.name for member in session.members[:count]}
    sightings = tuple(s for s in session.sightings if {s.observer, s.observed} <= names)
    return replace(session, members=session.members[:count], sightings=sightings)


def timed(work: Callable[[], T]) -> tuple[T, float, float]:
    """What ``work`` returns, and its seconds of wall clock and of CPU, those of processes it started included."""
    before, started = os.times(), time.perf_counter()
    done = work()
    wall, after = time.perf_counter() - started, os.times()
    return done, wall, sum(after[:4]) - sum(before[:4])


def main(
    session: Annotated[Path, typer.Argument(help="A team session, such as one of tools/simulate.py.")],
    robots: Annotated[list[int] | None, typer.Option(min=2, help="So many of its robots; repeatable.")] = None,
    cores: Annotated[int, typer.Option(min=1, help="For the front ends.")] = os.cpu_count() or 1,
) -> None:
    """Seconds of front ends and of play for teams of several sizes."""
    whole, config = open_session(session), load_config()
    typer.echo("robots sightings | front ends wall cpu | play wall cpu cpu/robot | records/robot | ratio joint equal")
    for count in robots or [5, 10, 20, 50]:
        part = first(whole, count)
        runs, wall, cpu = timed(lambda part=part: map_members(part, config, cores, lambda *_: None))  # type: ignore[misc]
        playback = Playback(runs, part.sightings, config)
        _, play_wall, play_cpu = timed(lambda playback=playback: playback.play(lambda _: None))  # type: ignore[misc]
        records = sum(len(teammate.store) for teammate in playback.team.values()) / count
        lasted = max(run.told[-1][0] for run in runs) - min(run.told[0][0] for run in runs)
        largest = max(len(component.robots) for component in playback.listener.joint.components())
        typer.echo(
            f"{count:6} {len(part.sightings):9} | {wall:15.1f} {cpu:5.1f} | {play_wall:8.1f} {play_cpu:5.1f} "
            f"{play_cpu / count:9.2f} | {records:13.0f} | {lasted / (wall + play_wall):5.2f} {largest:5} "
            f"{'yes' if playback.agree() else 'NO'}"
        )


if __name__ == "__main__":
    typer.run(main)
