"""What a robot knows: for every key the highest version of a record it has heard of.

The merge is a join: of two versions of a record the higher stays. Two records of one key and version that differ can
only come from a writer that lost its memory, or from two writers of one name; of these the one with the larger hash
stays, for everybody. So stores that have been told the same records, in any order and number, are equal.
"""

import hashlib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar, cast
from weakref import WeakValueDictionary

from mrtm.team.codec import KINDS, pack, unpack
from mrtm.team.records import AnchorRecord, EdgeRecord, Key, Kind, MapRecord, Record, SightingRecord, VertexRecord

R = TypeVar("R", VertexRecord, EdgeRecord, MapRecord, AnchorRecord, SightingRecord)

HASH = 16
"""Bytes of a record's hash (BLAKE2b)."""

_PART = 8  # bytes of a hash of many records, which is only compared

Stamp = tuple[int, bytes]
"""Version and hash of a record's bytes, or the hash's beginning; the larger wins."""

Digest = dict[str, dict[tuple[Kind, int], Stamp]]
"""What somebody knows: for every writer (kind, number) and stamp of its records."""


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
        self._items: dict[str, dict[tuple[Kind, int], Item]] = {}
        self._hashes: dict[str, bytes] = {}  # of each writer's items, as far as they are known
        self._parts: dict[tuple[str, Kind], tuple[Item, ...]] = {}  # those of one writer and kind, likewise
        self._read: dict[tuple[str, Kind], tuple[Record, ...]] = {}  # their records, but for maps

    def put(self, record: Record) -> bool:
        """Learn a record; False if it, or a higher version, is known already.

        What is kept is what others will receive: a map is reduced as ``map_codec`` says.

        Raises:
            RecordError: if it is too large to travel.
        """
        return self.add(item_of(pack(record)))

    def add(self, item: Item) -> bool:
        """Learn a packed record; False if it, or a higher version, is known already."""
        known = self._items.setdefault(item.key.robot, {})
        place = (item.key.kind, item.key.number)
        if place in known and known[place].stamp >= item.stamp:
            return False
        known[place] = item
        self._hashes.pop(item.key.robot, None)
        self._parts.pop((item.key.robot, item.key.kind), None)
        self._read.pop((item.key.robot, item.key.kind), None)
        return True

    def merge(self, records: Iterable[Record]) -> list[Key]:
        """Learn records; the keys of those that were new, or new versions.

        Raises:
            RecordError: see ``put``.
        """
        return [record.key for record in records if self.put(record)]

    def __len__(self) -> int:
        return sum(map(len, self._items.values()))

    def __contains__(self, key: Key) -> bool:
        return (key.kind, key.number) in self._items.get(key.robot, {})

    def __getitem__(self, key: Key) -> Record:
        """The record of a key, unpacked; KeyError if it is not known."""
        return self.item(key).record

    def item(self, key: Key) -> Item:
        """The packed record of a key; KeyError if it is not known."""
        return self._items[key.robot][key.kind, key.number]

    def keys(self, kind: Kind) -> Iterator[Key]:
        """The keys of one kind, by robot and number."""
        for robot in sorted(self._items):
            yield from (item.key for item in self.part(robot, kind))

    def of(self, kind: type[R]) -> Iterator[R]:
        """The records of one type, by robot and number; maps are unpacked one after the other."""
        for robot in sorted(self._items):
            yield from cast("Iterable[R]", self._records(robot, kind.kind))

    def count(self, kind: type[R]) -> int:
        """How many records of one type there are."""
        return sum(len(self.part(robot, kind.kind)) for robot in self._items)

    def part(self, robot: str, kind: Kind) -> tuple[Item, ...]:
        """The items of one writer and kind, by number."""
        name = robot, kind
        if name not in self._parts:
            known = self._items.get(robot, {})
            self._parts[name] = tuple(item for (found, _), item in sorted(known.items()) if found == kind)
        return self._parts[name]

    def _records(self, robot: str, kind: Kind) -> Iterable[Record]:
        """Those of one writer and kind, by number."""
        if kind is Kind.MAP:
            return (item.record for item in self.part(robot, kind))
        if (robot, kind) not in self._read:
            self._read[robot, kind] = tuple(item.record for item in self.part(robot, kind))
        return self._read[robot, kind]

    def records(self) -> Iterator[Record]:
        """All records, topology first; maps, which come last, are unpacked one after the other."""
        return (item.record for item in self.missing({}))

    def summary(self) -> bytes:
        """A hash of everything: equal if and only if two stores hold the same."""
        whole = hashlib.blake2b(digest_size=_PART)
        for robot, part in sorted(self.writers().items()):
            whole.update(robot.encode() + b"\0" + part)
        return whole.digest()

    def writers(self) -> dict[str, bytes]:
        """For every writer a hash of what is known of it."""
        for robot, known in self._items.items():
            if robot not in self._hashes:
                rows = (b"%d %d %d " % (KINDS.index(k), n, i.version) + i.hash for (k, n), i in sorted(known.items()))
                self._hashes[robot] = hashlib.blake2b(b"".join(rows), digest_size=_PART).digest()
        return dict(self._hashes)

    def digest(self, writers: Collection[str] | None = None) -> Digest:
        """What is known, all or of some writers, which need not be known."""
        names = self._items if writers is None else writers
        return {name: {place: item.stamp for place, item in self._items.get(name, {}).items()} for name in names}

    def missing(self, digest: Digest, writers: Collection[str] | None = None) -> list[Item]:
        """What somebody lacks that knows ``digest``: of all writers, or of some; topology first, maps last."""
        return _sorted(
            item
            for robot in (self._items if writers is None else writers)
            for place, item in self._items.get(robot, {}).items()
            if _newer(item.stamp, digest.get(robot, {}).get(place))
        )

    def wants(self, digest: Digest) -> list[Key]:
        """The keys of what somebody that knows ``digest`` could tell."""
        return [
            Key(kind, robot, number)
            for robot, known in digest.items()
            for (kind, number), stamp in known.items()
            if _newer(stamp, item.stamp if (item := self._items.get(robot, {}).get((kind, number))) else None)
        ]

    def items(self, keys: Iterable[Key]) -> list[Item]:
        """The items of those keys that are known; topology first, maps last."""
        found = (self._items.get(key.robot, {}).get((key.kind, key.number)) for key in keys)
        return _sorted(item for item in found if item is not None)


def _newer(one: Stamp, other: Stamp | None) -> bool:
    """Whether ``one`` replaces ``other``; of hashes only as much is compared as both tell."""
    if other is None:
        return True
    length = min(len(one[1]), len(other[1]))
    return (one[0], one[1][:length]) > (other[0], other[1][:length])


def _sorted(items: Iterable[Item]) -> list[Item]:
    return sorted(items, key=lambda item: (KINDS.index(item.key.kind), item.key.robot, item.key.number))
