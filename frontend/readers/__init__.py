"""Robot logs as laser scans and, where the laser knows reflective tags, sightings of other robots.

``open_log(path)`` recognises compression and format by content. A format is a module of this package with a ``NAME``,
``sniff(first_bytes) -> bool`` and ``read(blocks, report) -> Iterator[Record]``; adding one adds the format.
"""

import pkgutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Protocol, cast

from frontend.errors import LogError
from frontend.readers.lines import read_blocks
from frontend.readers.report import Report
from frontend.readers.scans import Record
from frontend.records import LaserScan

CHECKED = 8  # blocks, of a file of no known format: more than bzip2 unpacks before it finds damage

__all__ = ["Log", "Record", "Report", "open_log"]


class _Format(Protocol):
    NAME: str

    def sniff(self, head: bytes) -> bool: ...

    def read(self, blocks: Iterator[bytes], report: Report) -> Iterator[Record]: ...


@dataclass(slots=True)
class Log:
    """A robot's log.

    Attributes:
        path: the file.
        format: the format's name, for example "CARMEN".
        report: what the latest pass has met so far.
    """

    path: Path
    format: str
    _reader: _Format = field(repr=False)
    report: Report = field(init=False)

    def __post_init__(self) -> None:
        self.report = Report(self.path)

    def records(self) -> Iterator[Record]:
        """Yield scans and sightings in file order, in memory that does not grow with the log; each call reads anew.

        A sighting follows the scan it was made in and has its time.

        Raises:
            LogError: the file cannot be read, has no usable scan, or its number of beams changes.
        """
        report = self.report = Report(self.path)
        yield from self._reader.read(read_blocks(self.path, report), report)
        if not report.scans:
            raise LogError(f"{self.path}: no usable scan{_why(report)}")

    def scans(self) -> Iterator[LaserScan]:
        """``records`` without the sightings."""
        return (record for record in self.records() if isinstance(record, LaserScan))


def open_log(path: Path) -> Log:
    """Recognise a log by its content; its scans are read later, by ``scans()``.

    Raises:
        LogError: the file is missing, empty, unreadable, or of no known format.
    """
    if path.is_dir():
        raise LogError(f"{path}: is a directory, not a log")
    if not path.exists():
        raise LogError(f"{path}: no such file")
    report = Report(path)
    blocks = read_blocks(path, report)
    head = next(blocks, b"")
    if not head:
        raise LogError(f"{path}: {report.damage or 'is empty'}")
    formats = _formats()
    for reader in formats:
        if reader.sniff(head):
            return Log(path, reader.NAME, reader)
    for _ in islice(blocks, CHECKED):
        pass
    if report.damage:  # nonsense comes of that, too
        raise LogError(f"{path}: {report.damage}")
    known = ", ".join(reader.NAME for reader in formats)
    raise LogError(f"{path}: not a log of a known format ({known}, plain or compressed with gzip, bzip2 or xz)")


@cache
def _formats() -> tuple[_Format, ...]:
    modules = [import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
    return tuple(cast(_Format, module) for module in modules if hasattr(module, "sniff"))


def _why(report: Report) -> str:
    if report.damage:
        return f"; {report.damage}"
    if report.skipped_examples:
        line, reason = report.skipped_examples[0]
        return f"; {report.unit} {line}: {reason}"
    found = ", ".join(f"{count} {name}" for name, count in sorted(report.lines.items()))
    return f" among its {report.unit}s ({found})" if found else ""
