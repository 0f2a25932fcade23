"""A message between two robots: one byte for protocol and stage, a checksum, and msgpack compressed by zstandard."""

import hashlib
import reprlib
from collections.abc import Iterable, Iterator, Sequence
from enum import IntEnum
from typing import Any

import msgpack
import numpy as np
import zstandard

from mrtm.errors import MrtmError
from mrtm.team.checks import RecordError, check_name
from mrtm.team.codec import KINDS
from mrtm.team.records import Key, Kind
from mrtm.team.store import Digest

PROTOCOL = 1
LARGEST_MESSAGE = 2**20
"""Bytes, packed and unpacked."""
CHUNK = 32 * 1024
"""Bytes of records after which the next message begins."""

_LONGEST_LIST = CHUNK // 8
_CHECKSUM = 8
_SHORT = 4  # bytes of a record's hash that KEYS tells: enough, as they are compared for one key and version only


class MessageError(MrtmError):
    """Bytes that are no message of this protocol."""


class Stage(IntEnum):
    """The messages of a meeting, see ``exchange``; a message is answered by later ones only."""

    SUMMARY = 0
    WRITERS = 1
    KEYS = 2
    WANTS = 3
    RECORDS = 4


def seal(stage: Stage, content: Any) -> bytes:
    """A message."""
    body = zstandard.ZstdCompressor(level=9).compress(msgpack.packb(content))
    head = PROTOCOL << 4 | stage
    return bytes([head]) + _checksum(head, body) + body


def open_message(message: bytes) -> tuple[Stage, Any]:
    """Stage and content, which is plain msgpack of any shape.

    Raises:
        MessageError: the message is damaged, too large, or of another protocol.
    """
    if not 1 + _CHECKSUM < len(message) <= LARGEST_MESSAGE:
        raise MessageError(f"message of {len(message)} bytes; must be {2 + _CHECKSUM} to {LARGEST_MESSAGE}")
    protocol, stage = divmod(message[0], 16)
    body = message[1 + _CHECKSUM :]
    if message[1 : 1 + _CHECKSUM] != _checksum(message[0], body):
        raise MessageError(f"message of {len(message)} bytes is damaged: its checksum differs")
    if protocol != PROTOCOL or stage not in list(Stage):
        raise MessageError(f"message speaks protocol {protocol} stage {stage}; must be protocol {PROTOCOL}")
    try:
        claimed = zstandard.get_frame_parameters(body).content_size
        if claimed > LARGEST_MESSAGE:
            raise MessageError(f"message claims {claimed} bytes unpacked; must be at most {LARGEST_MESSAGE}")
        content = zstandard.ZstdDecompressor().decompress(body, LARGEST_MESSAGE, allow_extra_data=False)
        return Stage(stage), msgpack.unpackb(content, max_array_len=_LONGEST_LIST)
    except (zstandard.ZstdError, ValueError, TypeError, msgpack.UnpackException) as error:
        raise MessageError(f"message cannot be unpacked: {error}") from error


def unpack_writers(content: Any) -> dict[str, bytes]:
    """The content of WRITERS: a hash for each writer.

    Raises:
        MessageError: it is of another shape.
    """
    if not isinstance(content, dict) or not all(isinstance(part, bytes) for part in content.values()):
        raise MessageError(f"message of writers: {reprlib.repr(content)}; must be a hash for each")
    for name in content:
        _check_writer(name)
    return content


def pack_keys(digest: Digest) -> dict[str, list[bytes]]:
    """The content of KEYS: for each writer columns of its records: kinds, numbers, versions, beginnings of hashes."""
    columns = {}
    for writer, known in digest.items():
        rows = sorted((KINDS.index(kind), number, *stamp) for (kind, number), stamp in known.items())
        versions = np.array([row[2] for row in rows], "<u4").tobytes()
        columns[writer] = [*_pack_places(rows), versions, b"".join(row[3][:_SHORT] for row in rows)]
    return columns


def unpack_keys(content: Any) -> Digest:
    """What ``pack_keys`` packed; the stamps hold the beginnings of hashes.

    Raises:
        MessageError: it is of another shape.
    """
    digest: Digest = {}
    for writer, (kinds, numbers, versions, hashes) in _columns(content, 4):
        places = _unpack_places(writer, kinds, numbers)
        if len(versions) != 4 * len(places) or len(hashes) != _SHORT * len(places):
            raise MessageError(f"message of keys: those of {writer} are not columns of one length")
        beginnings = (hashes[i : i + _SHORT] for i in range(0, len(hashes), _SHORT))
        stamps = zip(np.frombuffer(versions, "<u4").tolist(), beginnings, strict=True)
        digest[writer] = dict(zip(places, stamps, strict=True))
    return digest


def pack_wants(keys: Iterable[Key]) -> dict[str, list[bytes]]:
    """The content of WANTS: for each writer columns of records: kinds, numbers."""
    rows: dict[str, list[tuple[int, int]]] = {}
    for key in keys:
        rows.setdefault(key.robot, []).append((KINDS.index(key.kind), key.number))
    return {writer: _pack_places(sorted(places)) for writer, places in rows.items()}


def unpack_wants(content: Any) -> list[Key]:
    """What ``pack_wants`` packed.

    Raises:
        MessageError: it is of another shape.
    """
    return [
        Key(kind, writer, number)
        for writer, columns in _columns(content, 2)
        for kind, number in _unpack_places(writer, *columns)
    ]


def _columns(content: Any, count: int) -> Iterator[tuple[str, list[bytes]]]:
    if not isinstance(content, dict):
        raise MessageError(f"message of keys: {reprlib.repr(content)}; must be columns for each writer")
    for writer, columns in content.items():
        _check_writer(writer)
        if not isinstance(columns, list) or [type(column) for column in columns] != [bytes] * count:
            raise MessageError(f"message of keys: those of {writer} are not {count} columns of bytes")
        yield writer, columns


def _pack_places(rows: Sequence[tuple[Any, ...]]) -> list[bytes]:
    """Two columns of rows that begin with kind and number, ascending; numbers less the one before, mostly 1."""
    numbers = np.array([row[1] for row in rows], np.uint32)
    return [bytes(row[0] for row in rows), np.diff(numbers, prepend=np.uint32(0)).astype("<u4").tobytes()]


def _unpack_places(writer: str, kinds: bytes, numbers: bytes) -> list[tuple[Kind, int]]:
    if len(numbers) != 4 * len(kinds) or max(kinds, default=0) >= len(KINDS):
        raise MessageError(f"message of keys: those of {writer} are not columns of one length, of known kinds")
    running = np.cumsum(np.frombuffer(numbers, "<u4"), dtype=np.uint32).tolist()
    return [(KINDS[kind], number) for kind, number in zip(kinds, running, strict=True)]


def _check_writer(name: Any) -> str:
    try:
        check_name(name, "message", "writer")
    except RecordError as error:
        raise MessageError(str(error)) from error
    assert isinstance(name, str)
    return name


def _checksum(head: int, body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=_CHECKSUM, salt=bytes([head])).digest()
