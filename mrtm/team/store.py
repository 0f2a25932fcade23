"""What a robot knows: for every key the highest version of a record it has heard of.

The merge is a join: of two versions of a record the higher stays. Two records of one key and version that differ can
only come from a writer that lost its memory, or from two writers of one name; of these the one with the larger hash
stays, for everybody. So stores that have been told the same records, in any order and number, are equal.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeVar, cast
from weakref import WeakValueDictionary

from mrtm.team.codec import KINDS, pack, unpack
from mrtm.team.records import AnchorRecord, EdgeRecord, Key, Kind, MapRecord, Record, SightingRecord, VertexRecord

R = TypeVar("R", VertexRecord, EdgeRecord, MapRecord, AnchorRecord, SightingRecord)

HASH = 16
"""Bytes of a record's hash (BLAKE2b)."""

PART_HASH = 8
"""Bytes of a hash of many records, which is only compared."""

PART = 64
"""Records of consecutive numbers in a part: news are few beside what two robots know already, and mostly the latest."""


class Part(NamedTuple):
    """Records of one writer and kind: those numbered from PART * ``block`` on."""

    robot: str
    kind: Kind
    block: int


Stamp = tuple[int, bytes]
"""Version and hash of a record's bytes, or the hash's beginning; the larger wins."""

Digest = dict[Part, dict[int, Stamp]]
"""What somebody knows: for every part the number and stamp of its records."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Item:
    """A checked record as it travels and is kept.

    Attributes:
        key, version: of the record.
        hash: of ``data``.
        data: the packed record.
    """

    key: Key
    version: int
    hash: bytes
    data: bytes
    _record: Record | None

    @property
    def stamp(self) -> Stamp:
        """What decides between two items of a key."""
        return self.version, self.hash

    @property
    def record(self) -> Record:
        """The record; a map, which is large, is unpacked at every call."""
        return unpack(self.data) if self._record is None else self._record


# Robots that are played in one process share what they hold: each record is checked and kept once.
_items: WeakValueDictionary[bytes, Item] = WeakValueDictionary()


def item_of(data: bytes) -> Item:
    """The item of a packed record.

    Raises:
        RecordError: if it does not check.
    """
    name = hashlib.blake2b(data, digest_size=HASH).digest()
    item = _items.get(name)
    if item is None:
        record = unpack(data)
        kept = None if isinstance(record, MapRecord) else record
        item = _items[name] = Item(record.key, record.version, name, data, kept)
    return item


class Store:
    """The records a robot knows, its own and those it was told."""

    def __init__(self) -> None:
        self._items: dict[tuple[str, Kind], dict[int, dict[int, Item]]] = {}  # by block, by number
        self._counts: Counter[Kind] = Counter()
        self._hashes: dict[Part, bytes] = {}
        self._changed: set[Part] = set()  # parts with another hash by now
        self._summary: bytes | None = None  # if it is known
        self._runs: dict[tuple[str, Kind], tuple[Item, ...]] = {}  # those of one writer and kind, likewise
        self._records: dict[tuple[str, Kind], tuple[Record, ...]] = {}  # theirs, but for maps

    def put(self, record: Record) -> bool:
        """Learn a record; False if it, or a higher version, is known already.

        What is kept is what others will receive: a map is reduced as ``map_codec`` says.

        Raises:
            RecordError: if it is too large to travel.
        """
        return self.add(item_of(pack(record)))

    def add(self, item: Item) -> bool:
        """Learn a packed record; False if it, or a higher version, is known already."""
        run, part = (item.key.robot, item.key.kind), _part_of(item.key)
        known = self._items.setdefault(run, {}).setdefault(part.block, {})
        old = known.get(item.key.number)
        if old is not None and old.stamp >= item.stamp:
            return False
        known[item.key.number] = item
        self._counts[part.kind] += old is None
        self._summary = None
        self._changed.add(part)
        self._runs.pop(run, None)
        self._records.pop(run, None)
        return True

    def merge(self, records: Iterable[Record]) -> list[Key]:
        """Learn records; the keys of those that were new, or new versions.

        Raises:
            RecordError: see ``put``.
        """
        return [record.key for record in records if self.put(record)]

    def __len__(self) -> int:
        return self._counts.total()

    def __contains__(self, key: Key) -> bool:
        return key.number in self._within(_part_of(key))

    def __getitem__(self, key: Key) -> Record:
        """The record of a key, unpacked; KeyError if it is not known."""
        return self.item(key).record

    def item(self, key: Key) -> Item:
        """The packed record of a key; KeyError if it is not known."""
        return self._within(_part_of(key))[key.number]

    def keys(self, kind: Kind) -> Iterator[Key]:
        """The keys of one kind, by robot and number."""
        for robot in self._robots(kind):
            yield from (item.key for item in self.run(robot, kind))

    def of(self, kind: type[R]) -> Iterator[R]:
        """The records of one type, by robot and number; maps are unpacked one after the other."""
        for robot in self._robots(kind.kind):
            yield from cast("Iterable[R]", self._read(robot, kind.kind))

    def count(self, kind: type[R]) -> int:
        """How many records of one type there are."""
        return self._counts[kind.kind]

    def run(self, robot: str, kind: Kind) -> tuple[Item, ...]:
        """The items of one writer and kind, by number."""
        name = robot, kind
        if name not in self._runs:
            blocks = sorted(self._items.get(name, {}).items())
            self._runs[name] = tuple(item for _, known in blocks for _, item in sorted(known.items()))
        return self._runs[name]

    def records(self) -> Iterator[Record]:
        """All records, topology first; maps, which come last, are unpacked one after the other."""
        return (item.record for item in self.missing({}))

    def summary(self) -> bytes:
        """A hash of everything: equal if and only if two stores hold the same."""
        if self._summary is None:
            whole = hashlib.blake2b(digest_size=PART_HASH)
            for part, name in sorted(self.parts().items()):
                whole.update(f"{part.robot} {part.kind} {part.block} ".encode() + name)
            self._summary = whole.digest()
        return self._summary

    def parts(self) -> dict[Part, bytes]:
        """For every part a hash of what is known of it."""
        while self._changed:
            part = self._changed.pop()
            known = sorted(self._within(part).items())
            rows = (b"%d %d " % (number, item.version) + item.hash for number, item in known)
            self._hashes[part] = hashlib.blake2b(b"".join(rows), digest_size=PART_HASH).digest()
        return dict(self._hashes)

    def digest(self, parts: Iterable[Part] | None = None) -> Digest:
        """What is known, all or of some parts, of which nothing need be known."""
        chosen = self._known() if parts is None else ((part, self._within(part)) for part in parts)
        return {part: {number: item.stamp for number, item in known.items()} for part, known in chosen}

    def missing(self, digest: Digest, parts: Iterable[Part] | None = None) -> list[Item]:
        """What somebody lacks that knows ``digest``: of all parts, or of some; topology first, maps last."""
        chosen = self._known() if parts is None else ((part, self._within(part)) for part in parts)
        return _sorted(
            item
            for part, known in chosen
            for number, item in known.items()
            if _newer(item.stamp, digest.get(part, {}).get(number))
        )

    def wants(self, digest: Digest) -> list[Key]:
        """The keys of what somebody that knows ``digest`` could tell."""
        return [
            Key(part.kind, part.robot, number)
            for part, theirs in digest.items()
            for number, stamp in theirs.items()
            if _newer(stamp, item.stamp if (item := self._within(part).get(number)) else None)
        ]

    def items(self, keys: Iterable[Key]) -> list[Item]:
        """The items of those keys that are known; topology first, maps last."""
        found = (self._within(_part_of(key)).get(key.number) for key in keys)
        return _sorted(item for item in found if item is not None)

    def _robots(self, kind: Kind) -> list[str]:
        return sorted(robot for robot, of_kind in self._items if of_kind is kind)

    def _read(self, robot: str, kind: Kind) -> Iterable[Record]:
        """The records of one writer and kind, by number."""
        if kind is Kind.MAP:
            return (item.record for item in self.run(robot, kind))
        if (robot, kind) not in self._records:
            self._records[robot, kind] = tuple(item.record for item in self.run(robot, kind))
        return self._records[robot, kind]

    def _known(self) -> Iterator[tuple[Part, dict[int, Item]]]:
        for run, blocks in self._items.items():
            for block, known in blocks.items():
                yield Part(*run, block), known

    def _within(self, part: Part) -> Mapping[int, Item]:
        return self._items.get((part.robot, part.kind), {}).get(part.block, {})


def _part_of(key: Key) -> Part:
    return Part(key.robot, key.kind, key.number // PART)


def _newer(one: Stamp, other: Stamp | None) -> bool:
    """Whether ``one`` replaces ``other``; of hashes only as much is compared as both tell."""
    if other is None:
        return True
    length = min(len(one[1]), len(other[1]))
    return (one[0], one[1][:length]) > (other[0], other[1][:length])


def _sorted(items: Iterable[Item]) -> list[Item]:
    return sorted(items, key=lambda item: (KINDS.index(item.key.kind), item.key.robot, item.key.number))
