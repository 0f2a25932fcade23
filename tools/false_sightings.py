"""Copies a team session and adds false sightings to it: ``python -m tools.false_sightings SESSION OUT --share 0.3``.

Random ones (``--share``) show anybody to anybody, anywhere. A cluster (``--cluster``) is worse: its sightings, all
between the same two robots, agree with each other on where the one's frame lies in the other's, and are wrong.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml

from frontend.errors import FrontendError
from frontend.readers import open_log
from frontend.records import FloatArray
from mrtm.errors import MrtmError
from mrtm.evaluation.trajectory import TimedPoses, interpolate, read_tum
from mrtm.team.session_file import Member, TeamSession, read_session
from mrtm.team.sightings_file import TimedSighting
from mrtm.team.window import windowed
from tools.simulation import SightingModel, SimulatedSighting, SimulationError, false_sightings
from tools.simulation.laser import BODY
from tools.simulation.poses import between, compose
from tools.simulation.sightings import in_order, noisy, sightings_of, write_sightings

WRONG = 2.0  # metres at least from where the other robot is to where a cluster shows it
ATTEMPTS = 1000
AHEAD = (-np.pi / 2, np.pi / 2)  # bearings a laser that looks ahead can see

app = typer.Typer(add_completion=False)


@app.command()
def main(
    session: Annotated[Path, typer.Argument(help="The session's YAML file.")],
    out: Annotated[Path, typer.Argument(help="Folder for the copy (its logs stay where they are) and false.csv.")],
    share: Annotated[float, typer.Option(min=0, max=0.99, help="Of all sightings, how many are false at random.")] = 0,
    cluster: Annotated[int, typer.Option(min=0, help="Add so many that agree with each other.")] = 0,
    trajectories: Annotated[
        Path | None,
        typer.Option(help="For --cluster: folder of ROBOT.tum, as a run leaves it; or the session's truth."),
    ] = None,
    max_range: Annotated[float, typer.Option(min=4 * BODY, help="Metres that robots see each other.")] = 8.0,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
) -> None:
    """Write a copy of a session with false sightings, and which they are."""
    try:
        team = read_session(session)
        if out.resolve() == session.parent.resolve():
            raise SimulationError(f"{out}: is the session's own folder; give another for the copy")
        model = _model(team, max_range, share)
        rng = np.random.default_rng(seed)
        playing = {member.name: _playing(member) for member in team.members}
        spans = {name: (times.begin, times.end) for name, times in playing.items()}
        false = false_sightings(spans, model, len(team.sightings), rng, bearings=AHEAD)
        if cluster:
            paths = {name: _path(name, times, team, trajectories) for name, times in playing.items()}
            false += consistent_cluster(paths, spans, model, cluster, rng)
        copy = _write(team, in_order(false), session, out)
    except (FrontendError, MrtmError, SimulationError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from error
    typer.echo(f"{copy}: {len(team.sightings)} sightings and {len(false)} false ones, see {out / 'false.csv'}")


def consistent_cluster(
    paths: dict[str, TimedPoses],
    spans: dict[str, tuple[float, float]],
    model: SightingModel,
    count: int,
    rng: np.random.Generator,
) -> list[SimulatedSighting]:
    """Sightings of one robot by another that all tell, up to the sensor's noise, the same wrong offset of their frames.

    Args:
        paths: frame_T_robot at team times, by robot; all in one frame.
        spans: first and last team time of each robot.
        model: of the sensor.
        count: how many.
        rng: draws the two robots, the offset, the moments and the noise.

    Raises:
        SimulationError: no offset was found that lets them see each other so often.
    """
    for _ in range(ATTEMPTS):
        observer, observed = rng.choice(list(paths), 2, replace=False).tolist()
        times = np.arange(
            np.ceil(max(spans[observer][0], spans[observed][0])), min(spans[observer][1], spans[observed][1])
        )
        (a, known_a), (b, known_b) = interpolate(paths[observer], times), interpolate(paths[observed], times)
        known = known_a & known_b
        times, a, b = times[known], a[known], b[known]
        if len(times) < count:
            continue
        first = int(rng.integers(len(times)))
        away, bearing, heading = rng.uniform((2 * BODY, AHEAD[0], -np.pi), (model.max_range, AHEAD[1], np.pi))
        shown = np.array((away * np.cos(bearing), away * np.sin(bearing), heading))
        offset = compose(compose(a[first], shown), between(b[first], np.zeros(3)))
        relative = compose(between(a, np.broadcast_to(offset, a.shape)), b)
        visible = _visible(relative, model) & (np.hypot(*(relative - between(a, b))[:, :2].T) > WRONG)
        if visible.sum() >= count:
            chosen = np.sort(rng.choice(np.flatnonzero(visible), count, replace=False))
            return sightings_of((observer, observed), times[chosen], noisy(relative[chosen], model, rng), model)
    raise SimulationError(f"--cluster {count}: found no two robots that could so often seem to see each other")


def _visible(relative: FloatArray, model: SightingModel) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    away = np.hypot(relative[:, 0], relative[:, 1])
    return np.asarray((away > 2 * BODY) & (away < model.max_range) & (relative[:, 0] > 0))


def _model(team: TeamSession, max_range: float, share: float) -> SightingModel:
    """The sensor, as precise as the session's own."""
    if not team.sightings:
        return SightingModel(max_range, false_share=share)
    one = team.sightings[0].measurement
    return SightingModel(max_range, 1.0, one.sigma_range, one.sigma_bearing, one.sigma_heading, share)


@dataclass(frozen=True, slots=True)
class _Playing:
    """First and last team time of a robot, and team time minus its log's."""

    begin: float
    end: float
    ahead: float


def _playing(member: Member) -> _Playing:
    stamps = np.array([(time, scan.time) for time, scan in windowed(open_log(member.log), member)])
    # A window's team times may begin below 0, where no sighting can be.
    return _Playing(max(0.0, stamps[:, 0].min()), stamps[:, 0].max(), float(stamps[0, 0] - stamps[0, 1]))


def _path(robot: str, times: _Playing, team: TeamSession, folder: Path | None) -> TimedPoses:
    if folder is None and robot not in team.truth:
        raise SimulationError(
            f"--cluster: the session has no truth of {robot}; run it and give --trajectories OUT/trajectory"
        )
    found = read_tum(folder / f"{robot}.tum" if folder is not None else team.truth[robot])
    return TimedPoses(found.times + times.ahead, found.poses)


def _write(team: TeamSession, false: list[SimulatedSighting], session: Path, out: Path) -> Path:
    """Writes the copy; returns its YAML file."""
    out.mkdir(parents=True, exist_ok=True)
    sightings = in_order([*map(_as_simulated, team.sightings), *false])
    write_sightings(sightings, out / "sightings.csv")
    write_sightings(false, out / "false.csv")
    robots: dict[str, dict[str, Any]] = {}
    for member in team.members:
        robots[member.name] = {"log": str(member.log.resolve()), "from": member.begin, "start": member.start}
        if np.isfinite(member.end):
            robots[member.name]["to"] = member.end
    content: dict[str, Any] = {"robots": robots, "sightings": "sightings.csv"}
    if team.relations is not None:
        content["relations"] = str(team.relations.resolve())
    if team.truth:
        content["truth"] = {name: str(path.resolve()) for name, path in team.truth.items()}
    copy = out / session.name
    copy.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return copy


def _as_simulated(sighting: TimedSighting) -> SimulatedSighting:
    one = sighting.measurement
    sigmas = one.sigma_range, one.sigma_bearing, one.sigma_heading
    return SimulatedSighting(
        sighting.time, sighting.observer, sighting.observed, one.range, one.bearing, one.heading, sigmas
    )


if __name__ == "__main__":
    app()
