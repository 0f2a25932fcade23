"""What reading a log met, good and bad."""

import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

EXAMPLES_KEPT = 10
NAMES_KEPT = 50
MOST_JUMPS = 0.1  # of the scans: more are no faults of a counter
_NAME = re.compile(r"[A-Za-z][\w.-]{0,39}", re.ASCII)


@dataclass(slots=True)
class Report:
    """Counts of one pass over a log, filled while its scans are taken.

    Attributes:
        path: the log.
        unit: what the log consists of: "line", or "object" where it is binary.
        lines: number of lines or objects by name ("FLASER", "ODOM", "#" for comments, ...), unknown names too.
        laser: what the scans are of, in words, once the first scan is out ("FLASER, 180 beams ...").
        scans: scans given out.
        sightings: other robots seen, as given out.
        skipped: lines that could not be used; the first ten are in ``skipped_examples`` as (line number, reason).
        duplicates: scans skipped because they repeat the scan before them.
        backward_steps: times the clock stepped back from one scan to the next.
        jumps: times the odometry jumped farther than a robot can drive; the first as (line number, metres).
        other_lasers: scans of lasers of the same log that were not read, by message name.
        readings: ranges read.
        masked: of these, unusable ones (NaN, negative, zero).
        no_returns: of these, ones that hit nothing.
        first_time, last_time: least and greatest time of a scan, seconds, the log's own clock; NaN without a scan.
        fraction: how much of the file has been read, 0 to 1.
        damage: how a compressed or unreadable file ended early; empty if it did not.
    """

    path: Path
    unit: str = "line"
    lines: Counter[str] = field(default_factory=Counter)
    laser: str = ""
    scans: int = 0
    sightings: int = 0
    skipped: int = 0
    skipped_examples: list[tuple[int, str]] = field(default_factory=list)
    duplicates: int = 0
    backward_steps: int = 0
    jumps: int = 0
    first_jump: tuple[int, float] = (0, 0.0)
    other_lasers: Counter[str] = field(default_factory=Counter)
    readings: int = 0
    masked: int = 0
    no_returns: int = 0
    first_time: float = float("nan")
    last_time: float = float("nan")
    fraction: float = 0.0
    damage: str = ""

    @property
    def duration(self) -> float:
        """Seconds between the least and the greatest time of a scan."""
        return self.last_time - self.first_time

    def place(self, line: int) -> str:
        """Where in the log: ``path:12``, or ``path: object 12``."""
        return f"{self.path}:{line}" if self.unit == "line" else f"{self.path}: {self.unit} {line}"

    def skip(self, line: int, reason: str) -> None:
        """Count a line that cannot be used and keep the first few reasons."""
        self.skipped += 1
        if len(self.skipped_examples) < EXAMPLES_KEPT:
            self.skipped_examples.append((line, reason))

    def jump(self, line: int, metres: float) -> None:
        """Count a jump of the odometry."""
        self.jumps += 1
        if self.jumps == 1:
            self.first_jump = line, metres

    def count_unknown(self, line: int, word: bytes) -> None:
        """Count a line of a message this project does not read, or skip it if ``word`` is no message's name."""
        name = word.decode("ascii", "replace")
        if _NAME.fullmatch(name):
            _count(self.lines, name)
        else:
            self.skip(line, f"{_shown(word)} is not the name of a message")

    def leave_out(self, laser: bytes) -> None:
        """Count a scan of a laser that is not read."""
        _count(self.other_lasers, ascii(laser[:40].decode("latin-1"))[1:-1])

    def blemishes(self) -> list[str]:
        """What a user should know of, one line each; empty for a clean log."""
        found = []
        if self.damage:
            found.append(f"{self.path}: {self.damage}; what came before was used")
        if self.skipped:
            found.append(f"{self.path}: skipped {_number(self.skipped, self.unit)} that could not be used")
            found += [f"{self.place(line)}: {reason}" for line, reason in self.skipped_examples]
        if self.duplicates:
            found.append(f"{self.path}: skipped {_number(self.duplicates, 'repeated scan')}")
        if self.backward_steps:
            found.append(f"{self.path}: the clock steps back {_number(self.backward_steps, 'time')}")
        if self.jumps:
            line, metres = self.first_jump
            unit = "; is it in metres?" if self.jumps > MOST_JUMPS * self.scans else ""
            found.append(
                f"{self.place(line)}: odometry jumps by {metres:.0f} m, farther than a robot drives between two scans: "
                f"taken as no motion, {_number(self.jumps, 'time')}{unit}"
            )
        if self.masked:
            share = 100.0 * self.masked / max(self.readings, 1)
            found.append(f"{self.path}: masked {_number(self.masked, 'unusable range')} ({share:.2g} %)")
        for name, count in sorted(self.other_lasers.items()):
            found.append(f"{self.path}: left out {_number(count, 'scan')} of another laser, {name}")
        return found


def _count(names: Counter[str], name: str) -> None:
    names[name if name in names or len(names) < NAMES_KEPT else "(others)"] += 1


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _shown(word: bytes) -> str:
    return ascii(word[:20].decode("latin-1")) + ("..." if len(word) > 20 else "")
