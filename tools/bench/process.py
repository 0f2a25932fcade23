"""Runs a whole process and measures what it took."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

LAUNCHER = Path(__file__).with_name("launcher.py")


class ProcessError(Exception):
    """A process of the benchmark failed or took too long; the message is one line."""


@dataclass(frozen=True, slots=True)
class Cost:
    """What a process took: seconds of wall clock, seconds of CPU in all threads and children, peak memory in MB."""

    wall: float
    cpu: float
    memory: float


def measure(command: Sequence[str], output: Path, limit: float) -> Cost:
    """Run a command to its end, its own output going to a file.

    Args:
        command: program and arguments.
        output: file for what it prints.
        limit: seconds after which it is killed, with its children.

    Raises:
        ProcessError: it could not be started, failed, or was killed.
    """
    launcher = subprocess.Popen(
        [sys.executable, "-I", "-S", str(LAUNCHER), str(output), *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        said, complaint = launcher.communicate(timeout=limit)
    except BaseException as error:
        os.killpg(launcher.pid, signal.SIGKILL)
        launcher.wait()
        if isinstance(error, subprocess.TimeoutExpired):
            raise ProcessError(f"stopped after {limit:g} s") from error
        raise
    if launcher.returncode < 0:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(launcher.pid, signal.SIGKILL)  # what it had started, if that still runs
        raise ProcessError(f"killed by signal {-launcher.returncode}, with what had started it")
    if launcher.returncode > 0:
        raise ProcessError(f"{command[0]}: cannot be run ({complaint.strip().splitlines()[-1]})")
    code, wall, cpu, memory = json.loads(said)
    if code < 0:
        raise ProcessError(f"killed by signal {-code}")
    if code > 0:
        lines = output.read_text(errors="replace").strip().splitlines()
        raise ProcessError(f"ended with code {code}: {lines[-1][:160] if lines else 'it said nothing'}")
    return Cost(wall, cpu, memory / (1e6 if sys.platform == "darwin" else 1e3))  # bytes there, kilobytes elsewhere
