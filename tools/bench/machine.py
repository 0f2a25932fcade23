"""Where and on what the numbers were made: processor, memory, versions, commit, date."""

import os
import platform
import subprocess
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from tools.bench.logs import ROOT


@dataclass(frozen=True, slots=True)
class Setting:
    """Machine and state of the project.

    Attributes:
        processor: its name.
        cores: that this process may use.
        memory: of the machine, GB.
        system: operating system and Python.
        load: the average number of running processes before the benchmark began: above a few tenths, others were busy.
        commit: short hash; "+ changes" if files of the project were changed since.
        day: when.
    """

    processor: str
    cores: int
    memory: float
    system: str
    load: float
    commit: str
    day: date

    def lines(self) -> list[str]:
        """For the head of a report."""
        return [
            f"- machine: {self.processor}, {self.cores} cores, {self.memory:.0f} GB; {self.system}",
            f"- load average before: {self.load:.2f}",
            f"- commit: {self.commit}; date: {self.day.isoformat()}",
        ]


def setting() -> Setting:
    """What can be found out about here and now."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    system = f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
    return Setting(_processor(), cores, memory, system, os.getloadavg()[0], _commit(), date.today())


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _commit() -> str:
    try:
        hash_ = _git("rev-parse", "--short", "HEAD")
        return hash_ + (" + changes" if _git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()
