"""A message between two robots: one byte for protocol and stage, a checksum, and msgpack compressed by zstandard."""

import hashlib
import reprlib
from enum import IntEnum
from typing import Any

import msgpack
import numpy as np
import zstandard

from mrtm.errors import MrtmError
from mrtm.team.codec import KINDS
from mrtm.team.records import RecordError, check_name
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
    RECORDS = 3


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


def pack_keys(ask: bool, digest: Digest) -> list[Any]:
    """The content of KEYS: whether the other's are wanted, and for each writer four columns of its records."""
    columns = {}
    for writer, known in digest.items():
        rows = sorted((KINDS.index(kind), number, *stamp) for (kind, number), stamp in known.items())
        numbers = np.array([row[1] for row in rows], np.uint32)
        columns[writer] = [
            bytes(row[0] for row in rows),
            np.diff(numbers, prepend=np.uint32(0)).astype("<u4").tobytes(),  # mostly 1, modulo 2^32
            np.array([row[2] for row in rows], "<u4").tobytes(),
            b"".join(row[3][:_SHORT] for row in rows),
        ]
    return [ask, columns]


def unpack_keys(content: Any) -> tuple[bool, Digest]:
    """What ``pack_keys`` packed; the stamps hold the beginnings of hashes.

    Raises:
        MessageError: it is of another shape.
    """
    match content:
        case [bool(ask), dict(columns)]:
            return ask, {_check_writer(writer): _known(writer, column) for writer, column in columns.items()}
    raise MessageError(f"message of keys: {reprlib.repr(content)}; must be whether to answer, and writers")


def _known(writer: str, columns: Any) -> dict[Any, Any]:
    match columns:
        case [bytes(kinds), bytes(numbers), bytes(versions), bytes(hashes)]:
            n = len(kinds)
            lengths = (len(numbers), len(versions), len(hashes))
            if lengths == (4 * n, 4 * n, _SHORT * n) and max(kinds, default=0) < len(KINDS):
                return {
                    (KINDS[kind], number): (version, hashes[_SHORT * i : _SHORT * (i + 1)])
                    for i, (kind, number, version) in enumerate(
                        zip(
                            kinds,
                            np.cumsum(np.frombuffer(numbers, "<u4"), dtype=np.uint32).tolist(),
                            np.frombuffer(versions, "<u4").tolist(),
                            strict=True,
                        )
                    )
                }
    raise MessageError(f"message of keys: those of {writer} are not four columns of one length")


def _check_writer(name: Any) -> str:
    try:
        check_name(name, "message", "writer")
    except RecordError as error:
        raise MessageError(str(error)) from error
    assert isinstance(name, str)
    return name


def _checksum(head: int, body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=_CHECKSUM, salt=bytes([head])).digest()
