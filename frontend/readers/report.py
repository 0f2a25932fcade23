"""What reading a log met, good and bad."""

import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

EXAMPLES_KEPT = 10
NAMES_KEPT = 50
_NAME = re.compile(r"[A-Za-z][\w.-]{0,39}", re.ASCII)


@dataclass(slots=True)
class Report:
    """Counts of one pass over a log, filled while its scans are taken.

    Attributes:
        path: the log.
        lines: number of lines by message name ("FLASER", "ODOM", "#" for comments, ...), unknown names too.
        laser: what the scans are of, in words, once the first scan is out ("FLASER, 180 beams ...").
        scans: scans given out.
        skipped: lines that could not be used; the first ten are in ``skipped_examples`` as (line number, reason).
        duplicates: scans skipped because they repeat the scan before them.
        backward_steps: times the clock stepped back from one scan to the next.
        other_lasers: scans of lasers of the same log that were not read, by message name.
        readings: ranges read.
        masked: of these, unusable ones (NaN, negative, zero).
        no_returns: of these, ones that hit nothing.
        first_time, last_time: least and greatest time of a scan, seconds, the log's own clock; NaN without a scan.
        damage: how a compressed or unreadable file ended early; empty if it did not.
    """

    path: Path
    lines: Counter[str] = field(default_factory=Counter)
    laser: str = ""
    scans: int = 0
    skipped: int = 0
    skipped_examples: list[tuple[int, str]] = field(default_factory=list)
    duplicates: int = 0
    backward_steps: int = 0
    other_lasers: Counter[str] = field(default_factory=Counter)
    readings: int = 0
    masked: int = 0
    no_returns: int = 0
    first_time: float = float("nan")
    last_time: float = float("nan")
    damage: str = ""

    @property
    def duration(self) -> float:
        """Seconds between the least and the greatest time of a scan."""
        return self.last_time - self.first_time

    def skip(self, line: int, reason: str) -> None:
        """Count a line that cannot be used and keep the first few reasons."""
        self.skipped += 1
        if len(self.skipped_examples) < EXAMPLES_KEPT:
            self.skipped_examples.append((line, reason))

    def count_unknown(self, line: int, word: bytes) -> None:
        """Count a line of a message this project does not read, or skip it if ``word`` is no message's name."""
        name = word.decode("ascii", "replace")
        if not _NAME.fullmatch(name):
            self.skip(line, f"{_shown(word)} is not the name of a message")
        elif name in self.lines or len(self.lines) < NAMES_KEPT:
            self.lines[name] += 1
        else:
            self.lines["(others)"] += 1

    def blemishes(self) -> list[str]:
        """What a user should know of, one line each; empty for a clean log."""
        found = []
        if self.damage:
            found.append(f"{self.path}: {self.damage}; what came before was used")
        if self.skipped:
            found.append(f"{self.path}: skipped {_number(self.skipped, 'line')} that could not be used")
            found += [f"{self.path}:{line}: {reason}" for line, reason in self.skipped_examples]
        if self.duplicates:
            found.append(f"{self.path}: skipped {_number(self.duplicates, 'repeated scan')}")
        if self.backward_steps:
            found.append(f"{self.path}: the clock steps back {_number(self.backward_steps, 'time')}")
        if self.masked:
            share = 100.0 * self.masked / max(self.readings, 1)
            found.append(f"{self.path}: masked {_number(self.masked, 'unusable range')} ({share:.2g} %)")
        for name, count in sorted(self.other_lasers.items()):
            found.append(f"{self.path}: left out {_number(count, 'scan')} of another laser, {name}")
        return found


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _shown(word: bytes) -> str:
    return ascii(word[:20].decode("latin-1")) + ("..." if len(word) > 20 else "")
