"""Five robots that only see each other: ``python -m tools.mrclam`` solves an UTIAS MRCLAM data set and scores it.

The joint graph's edges are wheel odometry and sightings between robots; landmarks are not used and nothing tells where
a robot started. ``--out`` is for a table (``mrclam.md``) and a picture (``mrclam.png``).
"""

from pathlib import Path
from typing import Annotated

import typer

from tools.bench.logs import places
from tools.mrclam_data.dataset import DatasetError, read_dataset
from tools.mrclam_data.report import draw, table
from tools.mrclam_data.run import play
from tools.mrclam_data.team import select

app = typer.Typer(add_completion=False)


@app.command()
def main(
    folder: Annotated[
        Path | None, typer.Argument(help="Of the data set; else mrclam/MRCLAM_Dataset7 in $MRTM_DATA.")
    ] = None,
    interval: Annotated[
        float, typer.Option(min=0, help="Least seconds between sightings of a robot by another.")
    ] = 3.0,
    sigma_range: Annotated[float, typer.Option(min=1e-3, help="Metres.")] = 0.12,
    sigma_bearing: Annotated[float, typer.Option(min=1e-4, help="Radians.")] = 0.02,
    window: Annotated[float, typer.Option(min=0, help="Seconds of sightings that may join two robots.")] = 30.0,
    out: Annotated[Path | None, typer.Option(help="Folder for the table and the picture.")] = None,
) -> None:
    """Solve a data set from odometry and sightings between robots, and compare it with odometry alone."""
    try:
        chosen = folder or _data()
        logs = read_dataset(chosen)
        seen = select({r: log.sightings for r, log in logs.items()}, interval, sigma_range, sigma_bearing)
        if not seen:
            raise DatasetError(f"{chosen}: no robot sees another: nothing to solve")
    except DatasetError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from error
    outcome = play(logs, seen, window)
    text = table(outcome, chosen.name)
    typer.echo(text)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "mrclam.md").write_text(text)
        draw(outcome, chosen.name, out / "mrclam.png")
        typer.echo(f"written: {out / 'mrclam.md'}, {out / 'mrclam.png'}")


def _data() -> Path:
    for place in places():
        if (found := place / "mrclam" / "MRCLAM_Dataset7").is_dir():
            return found
    raise DatasetError("no mrclam/MRCLAM_Dataset7 here: set MRTM_DATA to the folder it is in, or name a data set")


if __name__ == "__main__":
    app()
