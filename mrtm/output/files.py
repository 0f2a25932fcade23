"""Files appear whole or not at all."""

import errno
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path`` to write to; on success it takes its place, on an error it is removed.

    Raises:
        OSError: as the block does, or for want of memory; its file is always ``path``: of a full disk the system tells
            no name.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
    except MemoryError as error:
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def to_json(value: Any) -> str:
    """Strict JSON, an entry or a list's item a line; NaN and infinities, which JSON lacks, become null."""
    return _lines(_plain(value), 2) + "\n"


def _lines(value: Any, levels: int) -> str:
    if levels == 0 or not value or not isinstance(value, dict | list):
        return json.dumps(value, allow_nan=False)
    indent = "  " * (3 - levels)
    if isinstance(value, dict):
        items = [f"{json.dumps(key)}: {_lines(item, levels - 1)}" for key, item in value.items()]
    else:
        items = [_lines(item, levels - 1) for item in value]
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    return f"{opening}\n" + ",\n".join(indent + item for item in items) + f"\n{indent[2:]}{closing}"


def _plain(value: Any) -> Any:
    match value:
        case dict():
            return {str(key): _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
        case np.ndarray() | np.generic():
            return _plain(value.tolist())
        case float():
            return value if math.isfinite(value) else None
        case None | bool() | int() | str():
            return value
        case _:
            return str(value)
