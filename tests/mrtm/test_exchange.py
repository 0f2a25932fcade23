"""Meetings: what is sent, what it costs, and what lost, doubled, late, damaged and hostile messages can do: nothing."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from random import Random
from typing import Any

import msgpack
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from factors import VertexId
from mrtm.team import messages
from mrtm.team.codec import pack
from mrtm.team.exchange import MOST_KEYS, Traffic, exchange, opening, receive
from mrtm.team.messages import (
    CHUNK,
    LARGEST_MESSAGE,
    MessageError,
    Stage,
    open_message,
    pack_keys,
    pack_parts,
    seal,
    unpack_keys,
)
from mrtm.team.records import Key, Kind, MapRecord, Record, VertexRecord
from mrtm.team.store import Part, Store, item_of
from tests.mrtm.record_examples import ROBOTS, record_of, room_map


def store_of(*records: Record) -> Store:
    store = Store()
    store.merge(records)
    return store


def everything_of(robot: str, count: int = 60) -> list[Record]:
    """``count`` records of each kind but maps."""
    return [record_of(kind, robot, n, n % 3) for n in range(count) for kind in Kind if kind != Kind.MAP]


def same(a: Store, b: Store) -> bool:
    """By their records, not by the hashes the protocol goes by."""
    return a.digest() == b.digest()


# What a store keeps.


def test_a_store_keeps_the_highest_version() -> None:
    store = Store()
    assert store.put(record_of(Kind.EDGE, version=1))
    assert not store.put(record_of(Kind.EDGE, version=1))
    assert not store.put(record_of(Kind.EDGE, version=0, value=0.7))
    assert store[Key(Kind.EDGE, "red", 3)].version == 1
    assert store.put(record_of(Kind.EDGE, version=2))
    assert store[Key(Kind.EDGE, "red", 3)].version == 2
    assert len(store) == 1


def test_merge_names_what_was_new() -> None:
    store = store_of(record_of(Kind.VERTEX), record_of(Kind.ANCHOR, version=1))
    news = store.merge([record_of(Kind.VERTEX), record_of(Kind.ANCHOR, version=2), record_of(Kind.ANCHOR, "blue")])
    assert news == [Key(Kind.ANCHOR, "red", 3), Key(Kind.ANCHOR, "blue", 3)]
    assert Key(Kind.ANCHOR, "blue", 3) in store
    assert Key(Kind.ANCHOR, "blue", 4) not in store
    with pytest.raises(KeyError):
        store[Key(Kind.ANCHOR, "grey", 3)]


def test_records_come_in_one_order_whatever_the_order_they_came_in() -> None:
    records = [*everything_of("red", 3), *everything_of("blue", 3), room_map()]
    shuffled = Random(1).sample(records, len(records))
    a, b = store_of(*records), store_of(*shuffled)
    assert [r.key for r in a.records()] == [r.key for r in b.records()]
    vertices = list(b.of(VertexRecord))
    assert vertices == list(a.of(VertexRecord))
    assert [v.id for v in vertices] == [VertexId(robot, n) for robot in ("blue", "red") for n in range(3)]
    assert [m.vertex for m in b.of(MapRecord)] == [VertexId("red", 0)]


def test_a_robot_keeps_of_its_own_map_what_others_will_receive() -> None:
    mine = store_of(room_map())
    theirs = Store()
    exchange(mine, theirs)
    (a,), (b,) = mine.of(MapRecord), theirs.of(MapRecord)
    assert a.grid.log_odds.tobytes() == b.grid.log_odds.tobytes()
    assert a.cloud.tobytes() == b.cloud.tobytes()
    assert a.normals.tobytes() == b.normals.tobytes()


def test_of_two_contents_of_one_version_everybody_keeps_the_same() -> None:
    one, two = record_of(Kind.EDGE, value=0.1), record_of(Kind.EDGE, value=0.2)
    winner = max(item_of(pack(one)).hash, item_of(pack(two)).hash)
    for order in ((one, two), (two, one), (one, two, one, two)):
        assert store_of(*order).digest()[Part("red", Kind.EDGE, 0)][3] == (0, winner)
    a, b = store_of(one), store_of(two)
    exchange(a, b)
    assert same(a, b)
    assert same(a, store_of(one, two))


def test_a_summary_tells_any_two_stores_apart() -> None:
    records = [
        record_of(Kind.EDGE),
        record_of(Kind.EDGE, number=4),
        record_of(Kind.EDGE, version=1),
        record_of(Kind.EDGE, value=0.6),
        record_of(Kind.EDGE, "blue"),
        record_of(Kind.ANCHOR),
    ]
    stores = [Store(), *map(store_of, records), store_of(*records), store_of(*records[:-1])]
    assert len({store.summary() for store in stores}) == len(stores)


# What a meeting costs.


def test_a_meeting_brings_both_all_that_either_knows() -> None:
    a = store_of(*everything_of("amber"), *everything_of("coral", 20), room_map("amber"))
    b = store_of(*everything_of("blue"), *everything_of("coral", 30)[40:], room_map("blue"))
    whole = store_of(*a.records(), *b.records())
    before = len(a), len(b)
    traffic = exchange(a, b)
    assert same(a, b)
    assert same(a, whole)
    assert [len(set(keys)) for keys in traffic.learned] == [len(whole) - n for n in before]
    assert traffic.refused == []
    assert set(traffic.sent) == {"digest", *Kind}
    assert traffic.total == sum(traffic.sent.values())
    assert exchange(a, b).learned == ([], [])


def test_only_the_news_are_sent() -> None:
    a, b = store_of(*everything_of("red"), room_map()), Store()
    exchange(a, b)
    a.put(record_of(Kind.EDGE, "red", 7, 9))
    second = exchange(b, a)
    assert second.learned == ([Key(Kind.EDGE, "red", 7)], [])
    assert second.sent[Kind.EDGE] < 150
    assert set(second.sent) == {"digest", Kind.EDGE}
    assert second.sent["digest"] < 5 * len(a) + 100


def test_nothing_new_takes_less_than_200_bytes_whatever_both_know() -> None:
    a = store_of(*(r for robot in ROBOTS for r in everything_of(robot, 100)))
    b = Store()
    exchange(a, b)
    assert len(b) == 2000
    for first, second in ((a, b), (b, a)):
        traffic = exchange(first, second)
        assert traffic.messages == 1
        assert traffic.total < 50


def test_a_large_meeting_goes_in_messages_of_bounded_size() -> None:
    a, b = store_of(*(r for robot in ROBOTS for r in everything_of(robot, 200))), Store()
    for index in range(10):
        room = room_map()
        a.put(replace(room, vertex=VertexId("red", index)))
    sizes: list[int] = []

    def link(message: bytes) -> Iterable[bytes]:
        sizes.append(len(message))
        return (message,)

    traffic = exchange(a, b, link)
    assert same(a, b)
    assert traffic.messages == len(sizes) > 10
    assert max(sizes) < CHUNK + 1000
    assert traffic.total == sum(sizes)


def test_keys_of_many_writers_go_in_several_messages() -> None:
    a, b = Store(), Store()
    for n in range(3):
        for number in range(MOST_KEYS // 2):
            a.put(record_of(Kind.VERTEX, f"robot{n}", number))
        b.put(record_of(Kind.VERTEX, f"robot{n}", 0))
    asked = receive(a, seal(Stage.PARTS, pack_parts(b.parts()))).replies
    told = [unpack_keys(open_message(message)[1]) for _, message in asked]
    assert [sum(map(len, digest.values())) <= MOST_KEYS for digest in told] == [True, True]
    assert set(told[0]) | set(told[1]) == set(a.parts())
    exchange(a, b)
    assert same(a, b)


def test_little_is_told_of_what_both_know() -> None:
    a = store_of(*(r for robot in ROBOTS for r in everything_of(robot, 400)))
    b = store_of(*a.records())
    for robot in ROBOTS:
        a.put(record_of(Kind.EDGE, robot, 400))
    traffic = exchange(b, a)
    assert [len(keys) for keys in traffic.learned] == [len(ROBOTS), 0]
    assert traffic.sent["digest"] < 0.5 * len(a)


# What goes wrong.


def damaged(message: bytes, rng: Random) -> bytes:
    """A part of the message, or some bits of it flipped."""
    if rng.random() < 0.3:
        return message[: rng.randrange(len(message))]
    raw = bytearray(message)
    for place in rng.sample(range(len(raw)), rng.randint(1, min(3, len(raw)))):
        raw[place] ^= 1 << rng.randrange(8)
    return bytes(raw)


class BadLink:
    """Loses, doubles, damages and holds back messages; those held back come later, last first.

    Attributes:
        harmed: messages that have arrived damaged.
    """

    def __init__(self, seed: int, loss: float = 0.3) -> None:
        self._rng = Random(seed)
        self._loss = loss
        self._late: list[bytes] = []
        self.harmed = 0

    def __call__(self, message: bytes) -> Iterator[bytes]:
        fate = self._rng.random()
        if fate < self._loss:
            return
        if fate < self._loss + 0.15:
            self._late.append(message)
            return
        if fate < self._loss + 0.25:
            self.harmed += 1
            yield damaged(message, self._rng)
            return
        yield from [message] * self._rng.choice((1, 1, 1, 2, 3))
        if self._late and self._rng.random() < 0.5:
            yield self._late.pop()


contents = st.tuples(st.sampled_from(list(Kind)), st.integers(0, 3), st.integers(0, 3), st.integers(0, 1))


@given(st.lists(contents), st.data())
def test_the_merge_is_a_join(rows: list[tuple[Kind, int, int, int]], data: st.DataObject) -> None:
    """Commutative, associative, idempotent; also where two contents claim one version."""
    records = [record_of(kind, "red", number, version, value / 4) for kind, number, version, value in rows]
    parts = [[r for r in records if data.draw(st.booleans())] for _ in range(3)]
    a, b, c = (store_of(*part) for part in parts)
    left = store_of(*store_of(*a.records(), *b.records()).records(), *c.records())
    right = store_of(*a.records(), *store_of(*c.records(), *b.records()).records())
    assert left.digest() == right.digest() == store_of(*left.records(), *right.records()).digest()
    exchange(a, b)
    assert same(a, b)
    assert same(a, store_of(*parts[1], *parts[0]))


@settings(max_examples=60)
@given(
    st.integers(0, 2**32), st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4), st.integers(0, 12)), max_size=40)
)
def test_five_robots_over_bad_links_end_alike_once_links_return(seed: int, story: list[tuple[int, int, int]]) -> None:
    """Robots write, meet over bad links and relay; some forget and count anew. Then neighbours meet."""
    rng = Random(seed)
    robots = [Store() for _ in ROBOTS]
    told, written = Store(), set[bytes]()  # the highest versions, and everything, that was ever written
    for who, whom, deed in story:
        if deed < 5 or who == whom:
            kind, number = list(Kind)[deed % 5], rng.randrange(4)
            old = robots[who]
            key = Key(kind, ROBOTS[who], number)
            version = old[key].version + 1 if key in old and deed % 3 else rng.randrange(3)
            record = record_of(kind, ROBOTS[who], number, version, rng.randrange(3) / 4)
            robots[who].put(record)
            told.put(record)
            written.add(item_of(pack(record)).hash)
        else:
            link = BadLink(rng.randrange(2**32), loss=deed / 12 - 0.35)
            before = robots[who].digest(), robots[whom].digest()
            traffic = exchange(robots[who], robots[whom], link)
            assert len(traffic.refused) == link.harmed
            for store, old_digest in zip((robots[who], robots[whom]), before, strict=True):
                assert {item.hash for item in store.missing({})} <= written
                now = store.digest()
                assert all(
                    now[p][number] >= stamp for p, known in old_digest.items() for number, stamp in known.items()
                )
    line = list(pairwise(robots))
    for a, b in [*line, *line[::-1]]:  # everything to the right end, and back
        exchange(a, b)
    assert all(same(robot, told) for robot in robots)


def test_over_a_bad_link_the_rest_comes_with_the_next_meetings() -> None:
    a, b = store_of(*everything_of("red", 40), room_map()), store_of(*everything_of("blue", 40))
    link = BadLink(3, loss=0.2)
    meetings = 0
    while not same(a, b):
        exchange(a, b, link)
        meetings += 1
        assert meetings < 200
    assert meetings > 1


@given(st.binary(max_size=300), st.integers(0, 2**32))
def test_any_bytes_are_survived(noise: bytes, seed: int) -> None:
    a, b = store_of(*everything_of("red", 2)), store_of(*everything_of("blue", 2))
    before = a.digest()
    good = [opening(b)[1], seal(Stage.PARTS, pack_parts(b.parts())), seal(Stage.KEYS, pack_keys(b.digest()))]
    rng = Random(seed)
    for message in (noise, *(damaged(m, rng) for m in good)):
        outcome = receive(a, message)
        assert len(outcome.refused) == 1
        assert not outcome.replies
        assert not outcome.learned
    assert a.digest() == before


plain = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 2**40) | st.floats() | st.text(max_size=5) | st.binary(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=3) | st.just("red"), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=300)
@given(st.sampled_from(list(Stage)), plain)
def test_any_content_under_a_good_checksum_is_survived(stage: Stage, content: Any) -> None:
    store = store_of(*everything_of("red", 2))
    before = store.digest()
    outcome = receive(store, seal(stage, content))
    assert all(len(line) < 300 and "\n" not in line for line in outcome.refused)
    for _, reply in outcome.replies:
        open_message(reply)
    assert store.digest() == before


def test_a_bad_record_is_refused_by_name_and_the_others_are_learned() -> None:
    good = [pack(record_of(kind, "blue")) for kind in Kind]
    bad = msgpack.unpackb(pack(record_of(Kind.EDGE, "blue", 8)))
    bad[4] = float("nan")
    store = Store()
    outcome = receive(store, seal(Stage.RECORDS, [*good[:2], msgpack.packb(bad), b"junk", *good[2:]]))
    assert [key.kind for key in outcome.learned] == list(Kind)
    assert len(store) == len(Kind)
    assert len(outcome.refused) == 2
    assert outcome.refused[0].startswith("edge blue:8 version 0: time is nan")


@settings(max_examples=200)
@given(st.data())
def test_records_changed_by_somebody_who_speaks_the_protocol_are_records_or_refused(data: st.DataObject) -> None:
    packed = [bytearray(pack(record_of(kind, "blue"))) for kind in Kind]
    for _ in range(data.draw(st.integers(1, 6))):
        record = data.draw(st.sampled_from(packed))
        record[data.draw(st.integers(0, len(record) - 1))] = data.draw(st.integers(0, 255))
    store = store_of(*everything_of("red", 1))
    outcome = receive(store, seal(Stage.RECORDS, [bytes(record) for record in packed]))
    assert len(outcome.learned) + len(outcome.refused) <= len(packed)
    again = Store()
    exchange(store, again)
    assert same(store, again)


@pytest.mark.parametrize("stage", [0, 4])
def test_a_message_that_unpacks_to_gigabytes_is_refused_at_once(stage: int) -> None:
    body = zstandard.ZstdCompressor().compress(bytes(200 * 2**20))
    assert len(body) < 10 * CHUNK
    outcome = receive(Store(), with_body(stage, body))
    assert outcome.refused == [f"message claims {200 * 2**20} bytes unpacked; must be at most {LARGEST_MESSAGE}"]


def test_a_frame_that_hides_its_size_is_refused() -> None:
    body = zstandard.ZstdCompressor(write_content_size=False).compress(msgpack.packb([]))
    assert "claims" in receive(Store(), with_body(4, body)).refused[0]


def test_lists_that_claim_to_be_long_are_refused() -> None:
    claims = b"\xdd\x7f\xff\xff\xff" * 1000
    assert "unpacked" in receive(Store(), with_body(4, zstandard.ZstdCompressor().compress(claims))).refused[0]


@pytest.mark.parametrize("head", [0x00, 0x11, 0x25, 0xFF])
def test_another_protocol_is_refused_by_name(head: int) -> None:
    body = zstandard.ZstdCompressor().compress(msgpack.packb([]))
    message = bytes([head]) + messages._checksum(head, body) + body
    assert f"protocol {head >> 4} stage {head & 15}" in receive(Store(), message).refused[0]


def with_body(stage: int, body: bytes) -> bytes:
    head = messages.PROTOCOL << 4 | stage
    return bytes([head]) + messages._checksum(head, body) + body


def test_keys_come_back_with_the_beginnings_of_hashes() -> None:
    store = store_of(*everything_of("red", 5), record_of(Kind.VERTEX, "blue", 2**31 - 1, 2**31 - 1))
    nothing = Part("nobody", Kind.EDGE, 2**20)
    digest = store.digest([*store.parts(), nothing])
    again = unpack_keys(msgpack.unpackb(msgpack.packb(pack_keys(digest))))
    assert again == {
        part: {number: (version, whole[:4]) for number, (version, whole) in known.items()}
        for part, known in digest.items()
    }
    assert again[nothing] == {}
    assert not store.missing(again)
    assert not store.wants(again)
    red = {part: known for part, known in again.items() if part.robot == "red"}
    assert {item.key.robot for item in store.missing(red)} == {"blue"}


@pytest.mark.parametrize(
    "columns",
    [
        None,
        [],
        [1, 2, 3, 4, 5, 6],
        [b"", b"", b"", b"", b""],
        [b"\5", b"0000", b"\1", b"\0", b"0000", b"0000"],  # no such kind
        [b"\0", b"", b"\1", b"\0", b"0000", b"0000"],  # no block
        [b"\0", b"0000", b"\2", b"\0", b"0000", b"0000"],  # two are told, one is there
        [b"\0", b"0000", b"\1", b"\0", b"00000", b"0000"],  # a version too long
        [b"\0", b"0000", b"\1", b"\x40", b"0000", b"0000"],  # beyond the part
    ],
)
def test_keys_that_are_not_columns_of_one_length_are_refused(columns: Any) -> None:
    with pytest.raises(MessageError, match="red"):
        unpack_keys({"red": columns})


def test_robots_in_one_process_share_what_they_hold() -> None:
    a, b = store_of(room_map()), Store()
    exchange(a, b)
    (one,), (two,) = a.missing({}), b.missing({})
    assert one is two


def test_traffic_starts_empty() -> None:
    assert Traffic().total == Traffic().messages == 0
