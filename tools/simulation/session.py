"""A simulated team on disk, as ``mrtm run team.yaml`` reads it.

team.yaml            the session
<robot>.clf.gz       its log, by its own clock
sightings.csv        who saw whom, by team time
truth/<robot>.tum    where it was, by its own clock, in the plan's frame; the first line is its start
truth/plan.json      the building and the routes
truth/false.csv      those of the sightings that are false
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from tools.simulation.log import SimulatedLog
from tools.simulation.plan import write_plan
from tools.simulation.sightings import (
    SightingModel,
    SimulatedSighting,
    false_sightings,
    in_order,
    true_sightings,
    write_sightings,
)
from tools.simulation.team import SimulatedTeam
from tools.simulation.writers import write_carmen, write_tum


def write_session(team: SimulatedTeam, model: SightingModel, seed: int, out: Path) -> list[SimulatedSighting]:
    """Writes the session, its truth included; returns the sightings.

    Args:
        team: its logs are recorded one at a time, as they are written.
        model: how robots see each other.
        seed: of the sightings.
        out: folder, made if need be.

    Raises:
        SimulationError: the false sightings cannot be made.
        OSError: a file cannot be written.
    """
    true = true_sightings(team, model, seed)
    spans = {robot.name: (robot.start, robot.end) for robot in team.robots}
    last = team.laser.first + team.laser.step * (team.laser.beams - 1)
    rng = np.random.default_rng(np.random.SeedSequence((seed, 3)))
    false = false_sightings(spans, model, len(true), rng, bearings=(team.laser.first, last))
    truth = out / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    for robot in team.robots:
        times, poses = _write_log(team.log(robot), out / f"{robot.name}.clf.gz")
        write_tum(times, poses, truth / f"{robot.name}.tum")
    sightings = in_order([*true, *false])
    write_sightings(sightings, out / "sightings.csv")
    write_sightings(false, truth / "false.csv")
    write_plan(team.plan, truth / "plan.json")
    (out / "team.yaml").write_text(_yaml(team), encoding="ascii")
    return sightings


def _write_log(parts: Iterable[SimulatedLog], path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Writes a log while its pieces come; returns times and true poses of its scans."""
    times, poses = [], []

    def passing() -> Iterator[SimulatedLog]:
        for part in parts:
            times.append(part.times)
            poses.append(part.poses)
            yield part

    write_carmen(passing(), path)
    return np.concatenate(times), np.vstack(poses)


def _yaml(team: SimulatedTeam) -> str:
    robots = [f"  {robot.name}: {{log: {robot.name}.clf.gz, start: {robot.start}}}\n" for robot in team.robots]
    truth = ", ".join(f"{robot.name}: truth/{robot.name}.tum" for robot in team.robots)
    return (
        f"# {len(team.robots)} simulated robots in the building {team.plan.name!r}.\n"
        f"robots:\n{''.join(robots)}sightings: sightings.csv\ntruth: {{{truth}}}\n"
    )
