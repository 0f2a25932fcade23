"""What reads files, and what must hold of whatever it makes of any input."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from frontend.errors import FrontendError
from frontend.readers import open_log
from frontend.records import LaserScan
from mrtm.config import load_config, to_yaml
from mrtm.errors import MrtmError
from mrtm.evaluation import evaluate_output
from mrtm.evaluation.relations import read_relations
from mrtm.evaluation.trajectory import read_tum
from mrtm.info import describe, log_info
from mrtm.team.session_file import read_session
from mrtm.team.sightings_file import TimedSighting, read_sightings
from tools.fuzzing import seeds

ERRORS = (FrontendError, MrtmError)
"""The trees of errors that are the user's to mend: what bad input may end in."""

LONGEST_MESSAGE = 1000


class BrokenPromiseError(AssertionError):
    """What a reader gave or said is not what it promises."""


@dataclass(frozen=True, slots=True)
class Target:
    """A reader: its ``name``, valid inputs, and ``read(file)``, which checks the promises itself."""

    name: str
    seeds: list[bytes]
    read: Callable[[Path], None]


def targets() -> list[Target]:
    """Every reader; a format of logs is found as ``open_log`` finds it, and has its seeds in ``seeds.LOGS``."""
    logs = [
        Target(f"log:{name}", [*plain, *plain, *(pack(log) for log in plain for pack in seeds.COMPRESSED)], read_log)
        for name, plain in seeds.LOGS.items()
    ]
    return [
        *logs,
        Target("configuration", seeds.CONFIGURATIONS, _read_configuration),
        Target("option", seeds.OPTIONS, _read_option),
        Target("session", seeds.SESSIONS, _read_session),
        Target("sightings", seeds.SIGHTINGS, _read_sightings),
        Target("relations", seeds.RELATIONS, _read_relations),
        Target("trajectory", seeds.TRAJECTORIES, _read_trajectory),
        Target("run", seeds.RUNS, _read_run),
        Target("info", [log for plain in seeds.LOGS.values() for log in plain], _read_info),
    ]


def holds(target: Target, file: Path) -> None:
    """Let the target read ``file``: it may end in one of the project's own errors, told in one line, and in no other.

    Raises:
        BrokenPromiseError: a promise does not hold.
        Exception: whatever else the reader lets through.
    """
    try:
        target.read(file)
    except ERRORS as error:
        _one_line(str(error))


def read_log(file: Path) -> None:
    """Read a log to its end; scans are what ``LaserScan`` promises, blemishes are lines."""
    log = open_log(file)
    for record in log.records():
        _must(math.isfinite(record.time), f"time {record.time}")
        if isinstance(record, LaserScan):
            _check_scan(record)
        else:
            _must(math.isfinite(record.range) and record.range > 0.0, f"sighting at {record.range} m")
            _must(math.isfinite(record.bearing), f"sighting at bearing {record.bearing}")
    for line in log.report.blemishes():
        _one_line(line)


def _check_scan(scan: LaserScan) -> None:
    laser = scan.laser
    _must(scan.ranges.shape == laser.angles.shape and scan.ranges.dtype == np.float32, "ranges do not fit the angles")
    _must(bool(np.all(np.isfinite(laser.angles)) and np.all(np.isfinite(laser.mount))), "angles or mount not finite")
    _must(laser.max_range > 0.0, f"max_range {laser.max_range}")
    usable = scan.ranges[~np.isnan(scan.ranges)]
    _must(bool(np.all(usable > 0.0)), "a range that is not positive")
    _must(bool(np.all(usable[np.isfinite(usable)] <= laser.max_range)), "a range beyond max_range")
    _must(scan.odometry.shape == (3,) and bool(np.all(np.isfinite(scan.odometry))), "odometry not finite")
    _must(-np.pi < scan.odometry[2] <= np.pi, f"heading {scan.odometry[2]}")


def _read_configuration(file: Path) -> None:
    _reads_back(file, [])


def _read_option(file: Path) -> None:
    _reads_back(None, [file.read_bytes().decode("utf-8", "surrogateescape")])


def _reads_back(file: Path | None, options: list[str]) -> None:
    config = load_config(file, options=options)
    values = [line.partition("#")[0].strip() for line in to_yaml(config).splitlines()]
    _must(len(values) > 10 and all(values), "the configuration does not print")


def _read_session(file: Path) -> None:
    """The file as a team's session, beside good sightings; its logs are not read."""
    with TemporaryDirectory(dir=file.parent) as place:
        Path(place, "seen.csv").write_bytes(seeds.SIGHTINGS[0])
        path = Path(place, "team.yaml")
        path.write_bytes(file.read_bytes())
        session = read_session(path)
    names = [member.name for member in session.members]
    _must(0 < len(names) == len({name.casefold() for name in names}), f"the robots are {names}")
    for member in session.members:
        _must(Path(member.name).name == member.name and member.name.isprintable(), f"the name {member.name!r}")
        _must(0.0 <= member.begin < member.end and math.isfinite(member.start), f"{member}")
    _must(set(session.truth) <= set(names), "truth of a stranger")
    _check_sightings(session.sightings, names)


def _read_sightings(file: Path) -> None:
    _check_sightings(read_sightings(file, ("red", "blue")), ["red", "blue"])


def _check_sightings(sightings: Sequence[TimedSighting], robots: list[str]) -> None:
    times = [sighting.time for sighting in sightings]
    _must(times == sorted(times) and all(map(math.isfinite, times)), "times not in order")
    for sighting in sightings:
        _must({sighting.observer, sighting.observed} <= set(robots), f"{sighting} of a stranger")
        _must(sighting.observer != sighting.observed, f"{sighting} of oneself")
        known = sighting.measurement.relative_pose()
        _must(known is None or bool(np.all(np.linalg.eigvalsh(known.covariance) > 0.0)), f"{sighting}: covariance")


def _read_relations(file: Path) -> None:
    relations = read_relations(file)
    _must(bool(np.all(np.isfinite(relations.times)) and np.all(np.isfinite(relations.poses))), "not finite")
    _must(len(relations.times) == len(relations.poses) > 0, "lengths differ")


def _read_trajectory(file: Path) -> None:
    poses = read_tum(file)
    _must(bool(np.all(np.isfinite(poses.times)) and np.all(np.isfinite(poses.poses))), "not finite")
    _must(len(poses.times) == len(poses.poses) > 0, "lengths differ")


def _read_run(file: Path) -> None:
    """The file as the ``run.json`` of a run whose other files are as they should be."""
    with TemporaryDirectory(dir=file.parent) as out:
        trajectory = Path(out, "trajectory", "robot.tum")
        trajectory.parent.mkdir()
        trajectory.write_bytes(seeds.TRAJECTORIES[0])
        Path(out, "run.json").write_bytes(file.read_bytes())
        evaluation = evaluate_output(Path(out), truth=trajectory)
        _must(len(evaluation.ate) == 1, "not one component")
        _must((Path(out) / "evaluation.json").exists(), "nothing written")


def _read_info(file: Path) -> None:
    lines = list(describe(log_info(file)))
    for line in lines:
        _must(line.isprintable(), f"not one printable line: {line!r}")


def _one_line(message: str) -> None:
    _must(message.isprintable(), f"not one printable line: {message!r}")
    _must(len(message) <= LONGEST_MESSAGE, f"a message of {len(message)} characters: {message[:100]!r}...")


def _must(holds: bool, otherwise: str) -> None:
    if not holds:
        raise BrokenPromiseError(otherwise)
