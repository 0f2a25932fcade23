"""Mutations of bytes, of bits, numbers and lines in them; the same random numbers make the same ones."""

import re
from collections.abc import Callable, Sequence
from random import Random

LARGEST = 1 << 16

_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_NUMBERS = (
    *(b"nan", b"inf", b"-inf", b"0", b"-0", b"-1", b"1", b"2", b"3", b"1e308", b"-1e308", b"1e400", b"1e-400", b"0x10"),
    *(b"2147483647", b"-2147483648", b"4294967295", b"4294967296", b"9223372036854775808", b"9" * 400, b"9" * 5000),
    *(b"", b"-", b".", b"1e", b"1_0", b"1.2.3", b"0.1", b"81.91", b"1e-9", b"true", b"~", b"99999", b"1e6"),
)
_WORDS = (
    *(
        b"FLASER",
        b"RLASER",
        b"ODOM",
        b"RAWLASER1",
        b"ROBOTLASER1",
        b"PARAM",
        b"SYNC",
        b"# ",
        b"laser 01",
        b"position 00",
    ),
    *(
        b"\xff",
        b"\0",
        b"\xef\xbb\xbf",
        b"\r\n",
        b"\t",
        b"\x85",
        b"\xe2\x80\xa8",
        b": ",
        b"[",
        b"{",
        b"&a ",
        b"*a",
        b"!!int ",
    ),
    *(b"!!timestamp x", b"2001-99-99", b"<<: ", b"---\n", b"? ", b"|\n", b"\x88", b"\x97CObservation2DRangeScan\x06"),
    *(b"\x95CActionCollection", b"\x87CPose2D\x01", b"\x87nullptr", b"BZh9", b"\x1f\x8b\x08", b"\xfd7zXZ\0"),
)
_INTEGERS = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


def mutate(random: Random, seeds: Sequence[bytes]) -> bytes:
    """One of the seeds with one to some ten mutations, at most ``LARGEST`` bytes."""
    data = random.choice(seeds)
    while True:
        data = random.choice(_MUTATIONS)(random, data, seeds)[:LARGEST]
        if random.random() < 0.4:
            return data


def _slice(random: Random, data: bytes, longest: int = 64) -> tuple[int, int]:
    start = random.randrange(len(data) + 1)
    return start, min(len(data), start + random.randrange(1, longest))


def _bit(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    if not data:
        return data
    at = random.randrange(len(data))
    return data[:at] + bytes([data[at] ^ 1 << random.randrange(8)]) + data[at + 1 :]


def _byte(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    at = random.randrange(len(data) + 1)
    return data[:at] + random.randbytes(1) + data[at + 1 :]


def _insert(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    at = random.randrange(len(data) + 1)
    return data[:at] + random.randbytes(random.randrange(1, 16)) + data[at:]


def _word(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    start, end = _slice(random, data, 8)
    return data[:start] + random.choice(_WORDS) + data[random.choice((start, end)) :]


def _delete(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    start, end = _slice(random, data)
    return data[:start] + data[end:]


def _cut(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    return data[: random.randrange(len(data) + 1)]


def _repeat(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    start, end = _slice(random, data, 200)
    return data[:end] + data[start:end] * random.choice((1, 1, 2, 10, 100)) + data[end:]


def _move(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    start, end = _slice(random, data, 200)
    rest = data[:start] + data[end:]
    at = random.randrange(len(rest) + 1)
    return rest[:at] + data[start:end] + rest[at:]


def _splice(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    other = random.choice(seeds)
    return data[: random.randrange(len(data) + 1)] + other[random.randrange(len(other) + 1) :]


def _number(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    found = _NUMBER.search(data, random.randrange(len(data) + 1))
    if found is None:
        return data
    return data[: found.start()] + random.choice(_NUMBERS) + data[found.end() :]


def _integer(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    """A binary integer: where a length, a count or a version may stand."""
    at, width = random.randrange(len(data) + 1), random.choice((1, 2, 4, 8))
    value = random.choice(_INTEGERS) & (1 << 8 * width) - 1
    return data[:at] + value.to_bytes(width, random.choice(("little", "big"))) + data[at + width :]


def _swap_lines(random: Random, data: bytes, seeds: Sequence[bytes]) -> bytes:
    lines = data.split(b"\n")
    first, second = random.randrange(len(lines)), random.randrange(len(lines))
    lines[first], lines[second] = lines[second], lines[first]
    return b"\n".join(lines)


_MUTATIONS: tuple[Callable[[Random, bytes, Sequence[bytes]], bytes], ...] = (
    *(_bit, _byte, _insert, _word, _word, _delete, _cut, _repeat, _move, _splice, _number, _number, _number),
    *(_integer, _swap_lines),
)
