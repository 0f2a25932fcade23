"""What the benchmark runs, each as a process of its own: what they have in common, and mrtm itself."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from mrtm.evaluation import TimedPoses, read_tum
from tools.bench.logs import BenchLog
from tools.bench.recording import Recording


class OutputError(Exception):
    """A program left behind something other than what it should have; the message is one line."""


class System(Protocol):
    """A program that turns a log into a trajectory."""

    @property
    def name(self) -> str:
        """For tables."""

    @property
    def about(self) -> str:
        """What it is and how it was set up, in one line."""

    @property
    def install(self) -> str:
        """The command that installs it."""

    def installed(self) -> bool:
        """Whether it can be run here."""

    def prepare(self, log: BenchLog, recording: Recording, work: Path) -> list[str]:
        """Write what it reads into the empty directory ``work``, which is not measured; the command to run."""

    def trajectory(self, recording: Recording, work: Path) -> TimedPoses:
        """Its pose at every scan, from the files it left in ``work``.

        Raises:
            OutputError: they are not what they should be.
        """


@dataclass(frozen=True)
class Mrtm:
    """The project's own command, ``mrtm run``, as a user would call it."""

    options: Sequence[str] = ()
    name: str = "mrtm"
    about: str = "this project"
    install: str = ""

    def installed(self) -> bool:
        return True

    def prepare(self, log: BenchLog, recording: Recording, work: Path) -> list[str]:
        chosen = [part for option in self.options for part in ("--set", option)]
        return [sys.executable, "-m", "mrtm", "run", str(log.path), "--out", str(work), "--quiet", *chosen]

    def trajectory(self, recording: Recording, work: Path) -> TimedPoses:
        (robot,) = run_record(work)["robots"]
        return read_tum(work / "trajectory" / f"{robot}.tum")


def run_record(work: Path) -> dict[str, Any]:
    """What mrtm wrote about its own run."""
    record: dict[str, Any] = json.loads((work / "run.json").read_text())
    return record
