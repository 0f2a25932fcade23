"""Text files, compressed as their name says. The same text gives the same bytes."""

import bz2
import gzip
import io
import lzma
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TextIO, cast


@contextmanager
def new_text(path: Path) -> Iterator[TextIO]:
    """Opens ASCII text to be written, compressed when the name ends in .gz, .bz2 or .xz.

    The file appears under its name when the block ends well; when it does not, an older file stays as it was.

    Raises:
        OSError: the file cannot be written.
    """
    part = path.with_name(path.name + ".part")
    try:
        with (
            part.open("wb") as raw,
            _compressed(raw, path.suffix) as binary,
            io.TextIOWrapper(binary, "ascii", newline="\n") as text,
        ):
            yield text
        os.replace(part, path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(part)):  # none of a full disk
            error.filename = str(path)
        raise


def _compressed(raw: IO[bytes], suffix: str) -> IO[bytes]:
    if suffix == ".gz":  # neither name nor time in the header
        return cast(IO[bytes], gzip.GzipFile("", "wb", compresslevel=9, fileobj=raw, mtime=0))
    if suffix == ".bz2":
        return cast(IO[bytes], bz2.BZ2File(raw, "wb"))
    if suffix == ".xz":
        return cast(IO[bytes], lzma.LZMAFile(raw, "wb"))
    return raw
