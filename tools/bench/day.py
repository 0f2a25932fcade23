"""A long day of driving, simulated: does a scan cost the same in the last hour as in the first?"""

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from frontend.readers import Log
from frontend.records import FloatArray, LaserScan
from mrtm.cli import app
from mrtm.evaluation import TimedPoses, evaluate_ate, read_tum
from tools.bench.machine import Setting
from tools.bench.systems import run_record
from tools.bench.table import markdown
from tools.simulation import BUILDINGS, LMS200, Driving, SimulatedLog, stream, write_carmen

HOUR = 3600.0
GENTLE = Driving(speed=0.35, turn_rate=0.3)
"""Half the usual speed: fewer scans a second must not mean wider gaps between them."""


@dataclass(frozen=True, slots=True)
class Hour:
    """One hour of the day: how many ``scans``, seconds of ``wall`` clock and ``cpu`` for them, ``memory`` in MB at its
    end, and the ``vertices`` made in it."""

    scans: int
    wall: float
    cpu: float
    memory: float
    vertices: int


@dataclass(frozen=True, slots=True)
class Day:
    """What was measured.

    Attributes:
        building: and the rate of scans, in words.
        hours: one by one.
        after: seconds from the last scan to the end, with the output.
        ate: RMSE of the positions against the truth, metres: the map has to be whole for the rest to count.
    """

    building: str
    hours: list[Hour]
    after: float
    ate: float

    def ratio(self, cost: Callable[[Hour], float]) -> float:
        """Cost per scan of the last hour over that of the first."""
        first, last = self.hours[0], self.hours[-1]
        return (cost(last) / last.scans) / (cost(first) / first.scans)


def drive_day(building: str, hours: float, rate: float, work: Path, options: Sequence[str] = ()) -> Day:
    """Simulate the drive, map it with ``mrtm run`` in this process, and measure hour by hour.

    Kernels should have been loaded before, or the first hour pays for it.

    Args:
        building: of ``tools.simulation``; its first closed route is driven lap after lap.
        hours: of driving.
        rate: scans a second.
        work: directory for the log and what the run leaves.
        options: for ``mrtm run``.
    """
    plan = BUILDINGS[building](0)
    route = next(name for name, points in plan.routes.items() if points[0][:2] == points[-1][:2])  # closed: in laps
    laser = replace(LMS200, rate=rate)
    truth: list[SimulatedLog] = []
    parts = stream(plan, route, laser, seed=1, driving=GENTLE, hours=hours)
    write_carmen(_remembering(parts, truth), work / "day.clf")
    marks: list[tuple[float, ...]] = []
    with _watched(marks, hours):
        app(["run", str(work / "day.clf"), "--out", str(work / "out"), "--quiet", *options], standalone_mode=False)
    ended = time.perf_counter()
    made = _made(run_record(work / "out"), marks[0][0], len(marks) - 1)
    found = [
        Hour(int(b[1] - a[1]), b[2] - a[2], b[3] - a[3], b[4], vertices)
        for a, b, vertices in zip(marks, marks[1:], made, strict=False)
    ]
    words = f"{building}, {hours:g} h at {rate:g} scans a second, {GENTLE.speed:g} m/s"
    return Day(words, found, ended - marks[-1][2], _ate(truth, work / "out"))


def _remembering(parts: Iterator[SimulatedLog], kept: list[SimulatedLog]) -> Iterator[SimulatedLog]:
    for part in parts:
        kept.append(replace(part, ranges=part.ranges[:0]))
        yield part


@contextmanager
def _watched(marks: list[tuple[float, ...]], hours: float) -> Iterator[None]:
    """While the block runs, every pass over a log notes the state of the process at each full hour of the log's clock.

    A mark is the log's time, scans so far, wall clock, CPU, memory. Between two marks the run reads and maps an hour.
    """
    plain = Log.scans

    def scans(log: Log) -> Iterator[LaserScan]:
        count, due = 0, -np.inf
        last = None
        for scan in plain(log):
            if scan.time >= due and len(marks) <= hours:
                marks.append((scan.time, count, time.perf_counter(), time.process_time(), _memory()))
                due = scan.time + HOUR
            last = scan
            yield scan
            count += 1
        if last is not None:
            marks.append((last.time, count, time.perf_counter(), time.process_time(), _memory()))

    Log.scans = scans  # type: ignore[method-assign, assignment]
    try:
        yield
    finally:
        Log.scans = plain  # type: ignore[method-assign]
    while len(marks) > 2 and marks[-1][0] - marks[-2][0] < HOUR / 2:
        del marks[-2]  # the last lap ends a little after the full hour: it belongs to the hour before


def _memory() -> float:
    """MB of this process now; where the system does not tell, its peak so far."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def _made(record: dict[str, Any], began: float, hours: int) -> list[int]:
    """New vertices in each hour; the first vertex is not an event."""
    times: FloatArray = np.array([e["time"] for e in record["events"] if e["kind"] == "new vertex"], float)
    inside = np.minimum((times - began) // HOUR, hours - 1).astype(np.int64)
    return [int(count) for count in np.bincount(inside, minlength=hours)]


def _ate(truth: Sequence[SimulatedLog], out: Path) -> float:
    reference = TimedPoses(
        np.concatenate([part.times for part in truth]), np.concatenate([part.poses for part in truth])
    )
    (robot,) = run_record(out)["robots"]
    estimate = read_tum(out / "trajectory" / f"{robot}.tum")
    return evaluate_ate({robot: reference}, {robot: estimate}).translation.rmse


def day_report(day: Day, setting: Setting, options: Sequence[str], note: str, picture: str) -> str:
    """The day as Markdown."""
    count = len(day.hours)
    lines = ["# A simulated day of driving", "", *([f"**{note}**", ""] if note else []), *setting.lines()]
    lines += [
        f"- drive: {day.building}; options of mrtm: {' '.join(options) or 'none'}",
        "",
        f"A scan in hour {count} costs **{day.ratio(lambda hour: hour.cpu):.2f} times** the CPU of one in hour 1 "
        f"({day.ratio(lambda hour: hour.wall):.2f} times the wall clock). Memory grew by "
        f"{day.hours[-1].memory - day.hours[0].memory:.0f} MB from the end of hour 1 to the end of hour {count}. "
        f"From the last scan to the end of the output it took {day.after:.1f} s. ATE, RMSE: {day.ate:.3f} m.",
        "",
        f"![cost and memory by hour]({picture})",
        "",
    ]
    rows = [
        [
            str(number),
            str(hour.scans),
            f"{1e3 * hour.wall / hour.scans:.2f}",
            f"{1e3 * hour.cpu / hour.scans:.2f}",
            f"{hour.memory:.0f}",
            str(hour.vertices),
        ]
        for number, hour in enumerate(day.hours, 1)
    ]
    header = ("hour", "scans", "wall, ms a scan", "CPU, ms a scan", "memory, MB", "new vertices")
    return "\n".join([*lines, *markdown(header, rows)]) + "\n"
