"""Public logs by name: what there is, and getting it.

The registry ships with the package (``registry.toml``, also seen as ``data/registry.toml``). A file appears at its
place whole and checked, or not at all; what a broken connection left is kept beside it as ``NAME.*.part``, and the
next call goes on from there if the server still has the same version of the file.
"""

import hashlib
import logging
import os
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from glob import escape
from importlib.resources import files
from pathlib import Path, PurePosixPath
from typing import Annotated
from urllib.parse import unquote, urlsplit

import pooch
import requests
import urllib3.exceptions
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from mrtm.errors import MrtmError
from mrtm.progress import Progress

TRIES = 3
"""Times a file is asked for in one call when the connection keeps breaking."""

_TIMEOUT = (10.0, 30.0)  # seconds to connect, and between two pieces
_PIECE = 1 << 16
_BROKEN = (
    requests.ConnectionError,
    requests.Timeout,
    requests.exceptions.ChunkedEncodingError,
    urllib3.exceptions.HTTPError,
)


class FetchError(MrtmError):
    """A log that is not in the registry, or that could not be downloaded."""


class RemoteFile(BaseModel):
    """A file of a public log: ``url``, and ``sha256`` if it is known."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    url: Annotated[str, Field(pattern=r"^https?://[^/]+/.*[^/]$")]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None

    @property
    def name(self) -> str:
        """What the file is called once it is here."""
        return PurePosixPath(unquote(urlsplit(self.url).path)).name


class PublicLog(BaseModel):
    """An entry of the registry; the head of ``registry.toml`` says what its keys mean."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    what: str
    licence: str
    citation: str
    page: str
    files: tuple[RemoteFile, ...]
    scans: int | None = None
    beams: int | None = None


@dataclass(frozen=True, slots=True)
class Fetched:
    """A file that is here now.

    Attributes:
        path: where.
        sha256: of its content.
        checked: whether the registry knows its sum.
        new: whether it was downloaded by this call.
    """

    path: Path
    sha256: str
    checked: bool
    new: bool


def registry() -> dict[str, PublicLog]:
    """The public logs by name."""
    text = files("mrtm").joinpath("registry.toml").read_text(encoding="utf-8")
    return TypeAdapter(dict[str, PublicLog]).validate_python(tomllib.loads(text))


def table() -> str:
    """What there is, for people to read; as wide as the terminal, one line a log where it is not one."""
    from rich.console import Console
    from rich.table import Table

    rows = Table("name", "what", "scans", "licence", box=None, pad_edge=False)
    for name, log in registry().items():
        scans = "" if log.scans is None else f"{log.scans}" + (f" x {log.beams}" if log.beams else "")
        where = "" if log.files else " (no address known)"
        rows.add_row(name, log.what + where, scans, log.licence)
    console = Console(markup=False, highlight=False)
    with console.capture() as captured:
        console.print(rows)
    return captured.get()


def fetch(name: str, to: Path, progress: Progress = lambda fraction, doing: None) -> Iterator[Fetched]:
    """Download the files of a public log, one after the other.

    A file that is there already is not downloaded again, unless its sum is not the registry's.

    Args:
        name: in the registry.
        to: directory; made if it is not there.
        progress: told how far each file is.

    Raises:
        FetchError: no such name, no address, no network, no such file, a wrong sum, or ``to`` cannot be written.
    """
    logs = registry()
    if name not in logs:
        raise FetchError(f"{name}: no such log in the registry; there is: {', '.join(logs)}")
    log = logs[name]
    if not log.files:
        raise FetchError(f"{name}: no address is known that still serves this log; it is described at {log.page}")
    for file in log.files:
        yield download(file, to, progress)


def download(file: RemoteFile, to: Path, progress: Progress = lambda fraction, doing: None) -> Fetched:
    """Download one file into the directory ``to``; see :func:`fetch`.

    Raises:
        FetchError: as :func:`fetch`.
    """
    pooch.get_logger().setLevel(logging.WARNING)  # it would print the sum, and advice for programmers
    target = to.absolute() / file.name
    downloader = _Resuming(target, progress)
    known = file.sha256 and f"sha256:{file.sha256}"
    try:
        pooch.retrieve(file.url, known, fname=target.name, path=target.parent, downloader=downloader)
        return Fetched(to / file.name, pooch.file_hash(str(target)), file.sha256 is not None, downloader.used)
    except requests.HTTPError as error:
        raise FetchError(f"{file.url}: the server says {error.response.status_code} {error.response.reason}") from error
    except _BROKEN as error:
        raise FetchError(f"{file.url}: {_why(error, target)}") from error
    except requests.RequestException as error:
        raise FetchError(f"{file.url}: {error}") from error
    except OSError as error:
        raise FetchError(f"{target}: cannot be written: {error.strerror}") from error
    except ValueError as error:
        raise FetchError(
            f"{file.url}: what came is not the file of the registry, whose sha256 is {file.sha256}; nothing was kept"
        ) from error


@dataclass(slots=True)
class _Resuming:
    """A downloader for pooch that goes on where the one before it broke off.

    Pooch gives it a temporary file, and afterwards checks the sum and moves the file to ``target``. The part that is
    kept carries a digest of the file's version (its ETag or date) in its name: parts of two versions never meet.
    """

    target: Path
    progress: Progress
    used: bool = False

    def __call__(self, url: str, output_file: str, pooch: object) -> None:
        self.used = True
        for left in reversed(range(TRIES)):
            try:
                part = self._continue(url)
                break
            except _BROKEN:
                if not left:
                    raise
        os.replace(part, output_file)
        for stale in parts(self.target):
            stale.unlink()

    def _continue(self, url: str) -> Path:
        """Get what is missing of the file; returns the whole of it."""
        with _get(url) as response:
            version = _version(response)
            digest = hashlib.sha256(f"{url} {version}".encode()).hexdigest()
            part = self.target.with_name(f"{self.target.name}.{digest[:12]}.part")
            have = part.stat().st_size if version and part.exists() else 0
            length = response.headers.get("Content-Length", "")
            if not have:
                self._write(part, "wb", response)
                return part
        if length != str(have):
            with _get(url, {"Range": f"bytes={have}-", "If-Range": version}) as rest:
                goes_on = rest.headers.get("Content-Range", "").startswith(f"bytes {have}-")
                self._write(part, "ab" if rest.status_code == 206 and goes_on else "wb", rest)
        return part

    def _write(self, part: Path, mode: str, response: requests.Response) -> None:
        with part.open(mode) as file:
            done = file.tell()
            length = response.headers.get("Content-Length", "")
            total = done + int(length) if length.isdecimal() else 0
            # The bytes as they are: a log.gz that the server declares to be compressed must stay compressed.
            for piece in response.raw.stream(_PIECE, decode_content=False):
                file.write(piece)
                done += len(piece)
                size = f"{done / 1e6:.1f} of {total / 1e6:.1f} MB" if total else f"{done / 1e6:.1f} MB"
                self.progress(done / total if total else 0.0, f"{self.target.name}: {size}")


def parts(target: Path) -> list[Path]:
    """What broken connections left of the file that is to be ``target``."""
    return list(target.parent.glob(f"{escape(target.name)}.*.part"))


def _get(url: str, headers: dict[str, str] | None = None) -> requests.Response:
    response = requests.get(
        url, headers={"Accept-Encoding": "identity", **(headers or {})}, stream=True, timeout=_TIMEOUT
    )
    response.raise_for_status()
    return response


def _version(response: requests.Response) -> str:
    """What tells this version of the file from another; empty if nothing does."""
    tag = response.headers.get("ETag", "")
    return tag if tag and not tag.startswith("W/") else response.headers.get("Last-Modified", "")


def _why(error: Exception, target: Path) -> str:
    kept = sum(part.stat().st_size for part in parts(target))
    if kept:
        return f"the connection broke off; {kept} bytes are kept, the same command goes on from there"
    if isinstance(error, requests.Timeout):
        return "the server does not answer; try again later"
    if isinstance(error, requests.ConnectionError):
        return "no connection to the server; is there a network?"
    return "the connection broke off; try again"
