"""Drives a simulated robot through a building: ``python -m tools.simulate office --out DIR``."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from tools.simulation import (
    BUILDINGS,
    LMS200,
    LMS200_HALF_DEGREE,
    FloorPlan,
    LaserModel,
    OdometryNoise,
    SimulatedLog,
    SimulationError,
    read_plan,
    stream,
    write_carmen,
    write_plan,
    write_tum,
)
from tools.simulation.picture import draw

app = typer.Typer(add_completion=False)


@app.command()
def main(
    plan: Annotated[str, typer.Argument(help=f"A floor plan (JSON), or one of {', '.join(BUILDINGS)}.")],
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
) -> None:
    """Simulate a robot with wheel odometry and a laser: writes its CARMEN log and its true path.

    The same arguments write the same bytes. A long log goes to disk piece by piece.
    """
    try:
        building = BUILDINGS[plan](plan_seed) if plan in BUILDINGS else read_plan(Path(plan))
        laser = _scanner(half_degree, field_of_view, beams, max_range, rate, offset)
        noise = OdometryNoise(slips_per_minute=slips, reversals_per_minute=reversals)
        parts = stream(building, route or next(iter(building.routes), ""), laser, noise, seed, laps=laps, hours=hours)
        scans = _write(building, parts, out, picture)
    except (SimulationError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from error
    typer.echo(f"{out / building.name}.clf.gz: {scans} scans")


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
