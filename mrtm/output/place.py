"""The place that a command writes to: looked at before the work, so that nothing is worked out in vain or written over.

What a command may write is told by directory, as a pattern of names: how many maps there will be only the work tells.
"""

import contextlib
import json
import os
import re
import tempfile
from collections.abc import Collection, Iterable
from pathlib import Path

from mrtm.errors import OutputError

Outputs = list[tuple[Path, re.Pattern[str]]]

_RUN = r"graph\.g2o|map(-[1-9][0-9]*)?\.(pgm|yaml|png)"
_LISTED = re.compile(rf"{_RUN}|trajectory/[^/]+\.tum|local_maps/[^/]+\.npz")


def run_outputs(out: Path, robots: Collection[str]) -> Outputs:
    """What a run of these robots, and its evaluation, may write.

    Raises:
        OutputError: the system has no file names with the letters of a robot's.
    """
    names = _any_of(robots)
    return [
        (out, re.compile(rf"run\.json|evaluation\.json|{_RUN}")),
        (out / "trajectory", re.compile(rf"{names}\.tum")),
        (out / "local_maps", re.compile(rf"{names}-[0-9]+\.npz")),
    ]


def comparison_outputs(out: Path, robots: Collection[str]) -> Outputs:
    """What a comparison may write; errors as of ``run_outputs``."""
    return [(out, re.compile(rf"comparison\.(md|json)|fig3-{_any_of(robots)}\.png|fig[456]\.png"))]


def file_output(path: Path) -> Outputs:
    """A single file, which comes into being under another name beside it."""
    return [(path.parent, re.compile(rf"{re.escape(path.name)}(\.part)?"))]


def check_outputs(outputs: Outputs, inputs: Iterable[Path], earlier: Collection[Path] = ()) -> None:
    """Refuse a place that cannot be written to, or where a file that the command reads would be lost.

    Nothing is left there. Of an input that is a link both the link and what it stands for are kept.

    Args:
        outputs: what may be written.
        inputs: what the command reads.
        earlier: what it will remove.

    Raises:
        OutputError: naming the place or the input.
    """
    for directory, names in outputs:
        _try_directory(directory)
        for entry in directory.iterdir() if directory.is_dir() else ():
            if names.fullmatch(entry.name) and entry.is_dir():
                raise OutputError(f"{entry}: a directory where a file is to be written; move it, or write elsewhere")
    real = [(os.path.realpath(directory), names) for directory, names in outputs]
    removed = {_entry(path) for path in earlier}
    for file in inputs:
        for place, name in (_entry(file), os.path.split(os.path.realpath(file))):
            if any(place == there and names.fullmatch(name) for there, names in real):
                raise OutputError(f"{file}: is read, and would be written over; move it, or write elsewhere")
            if (place, name) in removed:
                raise OutputError(f"{file}: is read, and would be removed as an earlier run's; write elsewhere")


def earlier_files(out: Path) -> list[Path]:
    """The files that the run whose ``run.json`` is in ``out`` says it wrote there, but for that; none without one."""
    try:
        run = json.loads((out / "run.json").read_bytes())
    except (OSError, ValueError, RecursionError):
        return []
    names = run.get("files") if isinstance(run, dict) else None
    # Only what is called as a run calls its files: what is removed must not depend on what somebody wrote there.
    return [out / n for n in names if isinstance(n, str) and _LISTED.fullmatch(n)] if isinstance(names, list) else []


def remove_earlier(out: Path) -> None:
    """Remove what an earlier run and its evaluation left in ``out``, the ``.json`` first: the rest alone is no run."""
    files = earlier_files(out)
    if (out / "run.json").exists():
        for name in ("evaluation.json", "run.json"):
            (out / name).unlink(missing_ok=True)
    for file in files:
        file.unlink(missing_ok=True)


def _any_of(names: Iterable[str]) -> str:
    for name in names:
        try:
            os.fsencode(name)
        except UnicodeEncodeError as error:
            complaint = "no file can be called so in this locale; set LC_ALL=C.UTF-8, or rename the robot"
            raise OutputError(f"{name}: {complaint}") from error
    return f"({'|'.join(map(re.escape, names))})"


def _entry(path: Path) -> tuple[str, str]:
    """Where the directory entry itself is, whatever it links to."""
    return os.path.realpath(path.parent), path.name


def _try_directory(directory: Path) -> None:
    """Write into it, made for the purpose where it is not there: rights do not tell all about strange file systems."""
    missing = [place for place in (directory, *directory.parents) if not os.path.exists(place)]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        reason = "not a directory" if isinstance(error, FileExistsError) else error.strerror
        raise OutputError(f"{directory}: cannot be written into ({reason}); give another directory") from error
    finally:
        for place in missing:
            with contextlib.suppress(OSError):
                place.rmdir()
