"""Drives simulated robots through a building.

python -m tools.simulate office --out DIR               # one robot: a log and its truth
python -m tools.simulate wings --robots 3 --out DIR     # a team: a session that mrtm run DIR/team.yaml reads
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from tools.simulation import (
    BUILDINGS,
    FLOORS,
    LMS200,
    LMS200_HALF_DEGREE,
    FloorPlan,
    LaserModel,
    OdometryNoise,
    SightingModel,
    SimulatedLog,
    SimulatedTeam,
    SimulationError,
    divided,
    read_plan,
    robot_names,
    simulate_team,
    stream,
    write_carmen,
    write_plan,
    write_session,
    write_tum,
)
from tools.simulation.laser import BODY
from tools.simulation.picture import draw, draw_team

BUILT_IN = BUILDINGS | FLOORS

app = typer.Typer(add_completion=False)


@app.command()
def main(
    plan: Annotated[
        str,
        typer.Argument(help=f"A floor plan (JSON), or one of {', '.join([*BUILDINGS, *FLOORS])}; the last for teams."),
    ],
    out: Annotated[Path, typer.Option(help="Folder to write NAME.clf.gz, truth.tum and plan.json to.")],
    route: Annotated[str, typer.Option(help="Route of the plan; the first one if left out.")] = "",
    seed: Annotated[int, typer.Option(min=0, help="Of the drive, the odometry and the laser.")] = 1,
    plan_seed: Annotated[int, typer.Option(min=0, help="Which building of the kind, for built-in plans.")] = 0,
    half_degree: Annotated[bool, typer.Option("--half-degree", help="LMS-200 with 361 beams, not 180.")] = False,
    field_of_view: Annotated[float, typer.Option(help="Another scanner: degrees, up to 360; 0 is the LMS-200.")] = 0,
    beams: Annotated[int, typer.Option(min=2, help="Another scanner: beams a scan.")] = 360,
    max_range: Annotated[float, typer.Option(min=0.1, help="Another scanner: metres.")] = 30.0,
    rate: Annotated[float, typer.Option(min=0.01, help="Scans a second.")] = 5.0,
    offset: Annotated[float, typer.Option(help="Metres from the robot's centre ahead to the laser.")] = 0.0,
    slips: Annotated[float, typer.Option(min=0, help="Wheel slips a minute.")] = 0.0,
    reversals: Annotated[float, typer.Option(min=0, help="Stretches recorded with the wrong sign, a minute.")] = 0.0,
    laps: Annotated[int, typer.Option(min=1, help="Times the route is driven.")] = 1,
    hours: Annotated[float, typer.Option(min=0, help="Fill about this time with laps.")] = 0.0,
    picture: Annotated[bool, typer.Option("--picture", help="Also draw NAME.png: plan, path and a scan.")] = False,
    robots: Annotated[
        int,
        typer.Option(
            min=0,
            help="A team of so many: each drives the plan's route of its name (red, blue, green, ...); if there is "
            "none, or with --route, one route is dealt out among them. Writes team.yaml, logs, sightings and truth/.",
            rich_help_panel="Team",
        ),
    ] = 0,
    start_every: Annotated[
        float, typer.Option(min=0, help="Seconds from a robot's start to the next one's.", rich_help_panel="Team")
    ] = 0.0,
    minutes: Annotated[
        float, typer.Option(min=0.01, help="No robot drives for longer.", rich_help_panel="Team")
    ] = math.inf,
    sighting_range: Annotated[
        float, typer.Option(min=BODY * 4, help="Metres that robots see each other.", rich_help_panel="Team")
    ] = 8.0,
    sighting_rate: Annotated[
        float, typer.Option(min=0.001, help="Sightings a second, of each pair.", rich_help_panel="Team")
    ] = 1.0,
    no_heading: Annotated[
        bool, typer.Option("--no-heading", help="Sightings do not tell the heading.", rich_help_panel="Team")
    ] = False,
    false_rate: Annotated[
        float, typer.Option(min=0, max=0.99, help="Share of all sightings that are false.", rich_help_panel="Team")
    ] = 0.0,
) -> None:
    """Simulate robots with wheel odometry and a laser: writes CARMEN logs and true paths.

    The same arguments write the same bytes. A long log goes to disk piece by piece.
    """
    try:
        building = BUILT_IN[plan](plan_seed) if plan in BUILT_IN else read_plan(Path(plan))
        laser = _scanner(half_degree, field_of_view, beams, max_range, rate, offset)
        noise = OdometryNoise(slips_per_minute=slips, reversals_per_minute=reversals)
        if robots:
            if laps > 1 or hours:
                raise SimulationError("--laps and --hours are for one robot; limit a team with --minutes")
            team = _team(building, robots, route, laser, noise, seed, start_every, 60 * minutes)
            sensor = SightingModel(sighting_range, sighting_rate, false_share=false_rate)
            _write_team(team, replace(sensor, sigma_heading=None) if no_heading else sensor, seed, out, picture)
            return
        parts = stream(building, route or next(iter(building.routes), ""), laser, noise, seed, laps=laps, hours=hours)
        scans = _write(building, parts, out, picture)
    except (SimulationError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from error
    typer.echo(f"{out / building.name}.clf.gz: {scans} scans")


def _team(
    plan: FloorPlan,
    robots: int,
    route: str,
    laser: LaserModel,
    noise: OdometryNoise,
    seed: int,
    start_every: float,
    seconds: float,
) -> SimulatedTeam:
    names = robot_names(robots)
    if route or not plan.routes.keys() >= set(names):
        plan = divided(plan, route or next(iter(plan.routes), ""), names)
    return simulate_team(plan, names, laser, noise, seed, start_every=start_every, seconds=seconds)


def _write_team(team: SimulatedTeam, model: SightingModel, seed: int, out: Path, picture: bool) -> None:
    sightings = write_session(team, model, seed, out)
    if picture:
        draw_team(team, sightings, out / f"{team.plan.name}.png")
    scans = sum(len(robot.journey.scan_times) for robot in team.robots)
    typer.echo(f"{out / 'team.yaml'}: {len(team.robots)} robots, {scans} scans, {len(sightings)} sightings")
    away, time, one, other = team.nearest()
    if away < 2 * BODY:
        typer.echo(f"robots do not dodge: at {time:.1f} s {one} and {other} are {away:.2f} m apart, inside each other")


def _scanner(
    half_degree: bool, field_of_view: float, beams: int, max_range: float, rate: float, offset: float
) -> LaserModel:
    if not 0 <= field_of_view <= 360:
        raise SimulationError(f"--field-of-view {field_of_view:g}: must be between 0 and 360 degrees")
    lms = LMS200_HALF_DEGREE if half_degree else LMS200
    laser = LaserModel.spanning(math.radians(field_of_view), beams, max_range) if field_of_view else lms
    return replace(laser, rate=rate, mount=(offset, 0.0, 0.0))


def _write(plan: FloorPlan, parts: Iterable[SimulatedLog], out: Path, picture: bool) -> int:
    """Writes everything while the pieces come; returns the number of scans."""
    kept: list[SimulatedLog] = []  # the first piece, and the others without their ranges

    def passing() -> Iterator[SimulatedLog]:
        for part in parts:
            kept.append(replace(part, ranges=part.ranges[:0]) if kept else part)
            yield part

    out.mkdir(parents=True, exist_ok=True)
    write_carmen(passing(), out / f"{plan.name}.clf.gz")
    whole = SimulatedLog(
        np.concatenate([part.times for part in kept]),
        np.concatenate([part.odometry for part in kept]),
        np.concatenate([part.poses for part in kept]),
        kept[0].ranges,
        kept[0].laser,
    )
    write_tum(whole.times, whole.poses, out / "truth.tum")
    write_plan(plan, out / "plan.json")
    if picture:
        draw(plan, whole, out / f"{plan.name}.png", scan=len(whole.ranges) // 2)
    return len(whole.times)


if __name__ == "__main__":
    app()
