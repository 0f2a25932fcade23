"""Bytes and lines of a file, compressed or not, in memory that does not grow with the file or with a line."""

import bz2
import codecs
import gzip
import lzma
import os
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, cast

import numpy as np

from frontend.errors import LogError
from frontend.readers.report import Report
from frontend.records import FloatArray

BLOCK = 1 << 17
LONGEST_LINE = 1 << 17

# The first bytes say how a file is compressed, whatever it is called.
_OPENERS: dict[bytes, Callable[..., object]] = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ\x00": lzma.open}
# MemoryError: the header of an xz file asks for as much as it likes.
_DAMAGE = (EOFError, MemoryError, OSError, lzma.LZMAError, zlib.error)


class Unreadable(Exception):
    """A line or object that cannot be used; the message is the reason."""


def read_blocks(path: Path, report: Report) -> Iterator[bytes]:
    """Yield the uncompressed content in blocks of at most ``BLOCK`` bytes.

    A compressed file that is cut off or damaged gives what it holds up to there, and ``report.damage`` says so.

    Raises:
        LogError: the file cannot be opened or read from the disk.
    """
    if path.exists() and not path.is_file():
        raise LogError(f"{path}: is a pipe or a device, not a file; save it first")
    try:
        file = path.open("rb")
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error
    with file:
        start = file.read(6)
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        opener = next((opener for magic, opener in _OPENERS.items() if start.startswith(magic)), None)
        stream = file if opener is None else cast(IO[bytes], opener(file, "rb"))
        done = 0
        while True:
            try:
                # read1 gives what there is; read would lose the bytes before the damage.
                block = cast(bytes, stream.read1(BLOCK))  # type: ignore[attr-defined]
            except _DAMAGE as error:
                if opener is None or getattr(error, "errno", None) is not None:
                    raise LogError(f"{path}: cannot be read: {error}") from error
                report.damage = f"the compressed data is cut off or damaged after {done} bytes ({error})"
                return
            if not block:
                return
            done += len(block)
            report.fraction = file.tell() / size if size else 1.0
            yield block


def split_lines(blocks: Iterator[bytes], report: Report) -> Iterator[tuple[int, bytes]]:
    """Yield (line number from 1, line without its end).

    Skipped are lines above ``LONGEST_LINE`` bytes, and a last line that has no end: half a line can look like a whole
    one that says something else.
    """
    number = 0
    tail = b""
    overlong = False
    for block in blocks:
        if number == 0 and not tail:
            block = block.removeprefix(codecs.BOM_UTF8)
        lines = (tail + block).split(b"\n")
        tail = lines.pop()
        for line in lines:
            number += 1
            if overlong or len(line) > LONGEST_LINE:
                report.skip(number, f"longer than {LONGEST_LINE} bytes")
                overlong = False
            else:
                yield number, line
        if len(tail) > LONGEST_LINE:
            overlong, tail = True, b""
    if overlong:
        report.skip(number + 1, f"longer than {LONGEST_LINE} bytes")
    elif tail:
        report.skip(number + 1, "cut off")


def numbers(text: bytes) -> FloatArray:
    """The numbers of a text, separated by blanks.

    Raises:
        Unreadable: something in it is not a number.
    """
    try:
        return np.fromstring(text, dtype=np.float64, sep=" ")
    except ValueError:
        raise Unreadable("a field is not a number") from None
