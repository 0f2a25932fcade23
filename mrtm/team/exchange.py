"""A meeting (M10): two robots find out what the other lacks, and send it.

    a -> b  SUMMARY  a hash of all a knows. The same as b's: the meeting is over.
    b -> a  PARTS    a hash for each part of what b knows: of one robot and kind, up to PART records.
    a -> b  KEYS     what a has of the parts whose hashes differ.
    b -> a  RECORDS  what a lacks;  WANTS  keys of what b lacks.
    a -> b  RECORDS  those.

Nobody remembers where a meeting stands: an answer depends on the message and the store alone. So a message may be lost,
doubled, late or damaged: the meeting tells less, and the next one the rest. Answers only go down the list, so a meeting
ends. What comes in is checked; what does not check is refused and named, and nothing else suffers. Nothing here
authenticates: damage is found, malice of somebody who speaks the protocol is not, nor two robots of one name.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from mrtm.team.checks import RecordError
from mrtm.team.messages import (
    CHUNK,
    MessageError,
    Stage,
    open_message,
    pack_keys,
    pack_parts,
    pack_wants,
    seal,
    unpack_keys,
    unpack_parts,
    unpack_wants,
)
from mrtm.team.records import Key, Kind
from mrtm.team.store import Digest, Item, Store, item_of

MOST_KEYS = 4096
"""Records that one message tells of, or a few more."""

__all__ = ["Link", "Outcome", "Store", "Traffic", "exchange", "opening", "perfect", "receive"]

Link = Callable[[bytes], Iterable[bytes]]
"""What becomes of a message on its way: what arrives now, in this order; nothing, itself, copies, earlier ones."""


@dataclass(slots=True)
class Traffic:
    """What meetings sent and told.

    Attributes:
        sent: bytes by kind of record, and "digest" for what finds out which to send; lost messages included.
        messages: their number.
        learned: keys of records new to the first robot, to the second; a key twice if a newer version came later.
        refused: what did not check, one line each.
    """

    sent: Counter[str] = field(default_factory=Counter)
    messages: int = 0
    learned: tuple[list[Key], list[Key]] = field(default_factory=lambda: ([], []))
    refused: list[str] = field(default_factory=list)

    @property
    def total(self) -> int:
        """Bytes of all that was sent."""
        return self.sent.total()


@dataclass(slots=True)
class Outcome:
    """What a message led to: ``replies`` (kind for the tally, message), ``learned`` keys, ``refused`` lines."""

    replies: list[tuple[str, bytes]] = field(default_factory=list)
    learned: list[Key] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


def perfect(message: bytes) -> Iterable[bytes]:
    """The link that delivers every message once, at once."""
    return (message,)


def exchange(a: Store, b: Store, link: Link = perfect) -> Traffic:
    """Let two robots meet, ``a`` speaking first; every message between them goes through ``link``."""
    stores, traffic = (a, b), Traffic()
    queue: deque[tuple[int, bytes]] = deque()

    def send(to: int, kind: str, message: bytes) -> None:
        traffic.sent[kind] += len(message)
        traffic.messages += 1
        queue.extend((to, arrived) for arrived in link(message))

    send(1, *opening(a))
    while queue:
        to, message = queue.popleft()
        outcome = receive(stores[to], message)
        traffic.learned[to].extend(outcome.learned)
        traffic.refused.extend(outcome.refused)
        for kind, reply in outcome.replies:
            send(1 - to, kind, reply)
    return traffic


def opening(store: Store) -> tuple[str, bytes]:
    """The first message of a meeting, with its kind for the tally."""
    return "digest", seal(Stage.SUMMARY, store.summary())


def receive(store: Store, message: bytes) -> Outcome:
    """Take in a message, whatever its bytes are; never raises."""
    outcome = Outcome()
    try:
        stage, content = open_message(message)
        match stage:
            case Stage.SUMMARY:
                if content != store.summary():
                    outcome.replies.append(("digest", seal(Stage.PARTS, pack_parts(store.parts()))))
            case Stage.PARTS:
                theirs, ours = unpack_parts(content), store.parts()
                differ = sorted(part for part in theirs | ours if theirs.get(part) != ours.get(part))
                outcome.replies.extend(_keys(store.digest(differ)))
            case Stage.KEYS:
                digest = unpack_keys(content)
                outcome.replies.extend(_records(store.missing(digest, digest)))
                wants = store.wants(digest)
                if wants:
                    outcome.replies.append(("digest", seal(Stage.WANTS, pack_wants(wants))))
            case Stage.WANTS:
                outcome.replies.extend(_records(store.items(unpack_wants(content))))
            case Stage.RECORDS:
                _learn(store, content, outcome)
    except MessageError as error:
        outcome.refused.append(str(error))
    return outcome


def _learn(store: Store, content: object, outcome: Outcome) -> None:
    if not isinstance(content, list) or not all(isinstance(data, bytes) for data in content):
        raise MessageError("message of records: must be a list of packed records")
    for data in content:
        try:
            item = item_of(data)
        except RecordError as error:
            outcome.refused.append(str(error))
            continue
        if store.add(item):
            outcome.learned.append(item.key)


def _keys(digest: Digest) -> Iterator[tuple[str, bytes]]:
    """Messages of about MOST_KEYS keys, those of one part in one message."""
    told: Digest = {}
    size = 0
    for part, known in digest.items():
        if told and size + len(known) > MOST_KEYS:
            yield "digest", seal(Stage.KEYS, pack_keys(told))
            told, size = {}, 0
        told[part] = known
        size += 1 + len(known)
    if told:
        yield "digest", seal(Stage.KEYS, pack_keys(told))


def _records(items: Iterable[Item]) -> Iterator[tuple[str, bytes]]:
    """Messages of about CHUNK bytes, or one record if that is larger; each of one kind."""
    part: list[bytes] = []
    size, kind = 0, Kind.VERTEX
    for item in items:
        if part and (item.key.kind != kind or size + len(item.data) > CHUNK):
            yield kind, seal(Stage.RECORDS, part)
            part, size = [], 0
        kind = item.key.kind
        part.append(item.data)
        size += len(item.data)
    if part:
        yield kind, seal(Stage.RECORDS, part)
