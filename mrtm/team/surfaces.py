"""The local maps in a store, made ready for comparison one by one as they are asked for."""

from collections.abc import Iterator, Mapping
from weakref import WeakValueDictionary

from factors import VertexId
from mrtm.joint.alignment.surface import Surface
from mrtm.team.records import Key, Kind, MapRecord
from mrtm.team.store import Item, Store

# Robots that are played in one process share what they have made of a map; the key is the hash of the record.
_shared: WeakValueDictionary[bytes, Surface] = WeakValueDictionary()


class Surfaces(Mapping[VertexId, Surface]):
    """Every vertex of which a store has a map."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._kept: dict[VertexId, tuple[Item, Surface]] = {}  # else what nobody holds is forgotten

    def __getitem__(self, vertex: VertexId) -> Surface:
        item = self._store.item(Key(Kind.MAP, vertex.robot, vertex.number))
        kept = self._kept.get(vertex)
        if kept is None or kept[0] is not item:
            kept = self._kept[vertex] = item, _surface(item)
        return kept[1]

    def __iter__(self) -> Iterator[VertexId]:
        return (VertexId(key.robot, key.number) for key in self._store.keys(Kind.MAP))

    def __len__(self) -> int:
        return sum(1 for _ in self)


def _surface(item: Item) -> Surface:
    found = _shared.get(item.hash)
    if found is None:
        record = item.record
        assert isinstance(record, MapRecord)
        found = _shared[item.hash] = Surface.of(record)
    return found
