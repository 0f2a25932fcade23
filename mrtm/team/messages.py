"""A message between two robots: one byte for protocol and stage, a checksum, and msgpack compressed by zstandard."""

import hashlib
import reprlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from itertools import islice
from typing import Any

import msgpack
import numpy as np
import zstandard

from mrtm.errors import MrtmError
from mrtm.team.checks import RecordError, check_name
from mrtm.team.codec import KINDS
from mrtm.team.records import Key, Kind
from mrtm.team.store import PART, PART_HASH, Digest, Part

PROTOCOL = 2
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
    PARTS = 1
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


def pack_parts(hashes: Mapping[Part, bytes]) -> dict[str, list[bytes]]:
    """The content of PARTS: for each writer columns of its parts: kinds, blocks, hashes."""
    columns = {}
    for robot, rows in _by_robot(hashes).items():
        columns[robot] = [*_pack_places(rows), b"".join(hashes[part] for *_, part in rows)]
    return columns


def unpack_parts(content: Any) -> dict[Part, bytes]:
    """What ``pack_parts`` packed.

    Raises:
        MessageError: it is of another shape.
    """
    found: dict[Part, bytes] = {}
    for robot, (kinds, blocks, hashes) in _columns(content, 3):
        places = _unpack_places(robot, kinds, blocks)
        if len(hashes) != PART_HASH * len(places):
            raise MessageError(f"message of parts: those of {robot} are not columns of one length")
        names = (hashes[i : i + PART_HASH] for i in range(0, len(hashes), PART_HASH))
        found.update((Part(robot, *place), name) for place, name in zip(places, names, strict=True))
    return found


def pack_keys(digest: Digest) -> dict[str, list[bytes]]:
    """The content of KEYS: for each writer columns of its parts: kinds, blocks, how many records of each; and of these:
    places within the part, versions, beginnings of hashes."""
    columns = {}
    for robot, rows in _by_robot(digest).items():
        known = [sorted(digest[part].items()) for *_, part in rows]
        every = [(number % PART, *stamp) for some in known for number, stamp in some]
        versions = np.array([version for _, version, _ in every], "<u4").tobytes()
        within, hashes = bytes(place for place, *_ in every), b"".join(name[:_SHORT] for *_, name in every)
        columns[robot] = [*_pack_places(rows), bytes(map(len, known)), within, versions, hashes]
    return columns


def unpack_keys(content: Any) -> Digest:
    """What ``pack_keys`` packed; the stamps hold the beginnings of hashes.

    Raises:
        MessageError: it is of another shape.
    """
    digest: Digest = {}
    for robot, (kinds, blocks, counts, within, versions, hashes) in _columns(content, 6):
        places = _unpack_places(robot, kinds, blocks)
        lengths = len(within), len(versions) // 4, len(hashes) // _SHORT
        whole = len(versions) % 4 == len(hashes) % _SHORT == 0
        if not whole or len(counts) != len(places) or {*lengths} != {sum(counts)} or max(within, default=0) >= PART:
            raise MessageError(f"message of keys: those of {robot} are not columns of one length, within their parts")
        beginnings = (hashes[i : i + _SHORT] for i in range(0, len(hashes), _SHORT))
        stamps = zip(within, np.frombuffer(versions, "<u4").tolist(), beginnings, strict=True)
        for (kind, block), count in zip(places, counts, strict=True):
            known = {PART * block + place: (version, name) for place, version, name in islice(stamps, count)}
            digest[Part(robot, kind, block)] = known
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


def _by_robot(parts: Iterable[Part]) -> dict[str, list[tuple[int, int, Part]]]:
    """Kind, block and name of the parts of each writer, ascending."""
    rows: dict[str, list[tuple[int, int, Part]]] = {}
    for part in parts:
        rows.setdefault(part.robot, []).append((KINDS.index(part.kind), part.block, part))
    return {robot: sorted(some) for robot, some in rows.items()}


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
