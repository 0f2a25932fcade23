"""What local maps say of an offset between two robots, from the maps in a store."""

from collections.abc import Iterator, Mapping

from factors import VertexId
from mrtm.joint.alignment.agreement import Lookup
from mrtm.joint.graph import JointGraph
from mrtm.joint.sightings.map_evidence import MapEvidence
from mrtm.team.surfaces import Surfaces


def evidence(maps: Surfaces, graphs: Mapping[str, JointGraph]) -> MapEvidence:
    """The word of the maps, as ``judge`` asks for it."""
    return MapEvidence(_Lookups(maps, graphs), graphs)


class _Lookups(Mapping[VertexId, Lookup]):
    """Those of the maps whose vertex is known: a map may be heard of before the edge that leads to it."""

    def __init__(self, maps: Surfaces, graphs: Mapping[str, JointGraph]) -> None:
        known = {vertex for graph in graphs.values() for vertex in graph.vertices()}
        self._maps, self._vertices = maps, [vertex for vertex in maps if vertex in known]

    def __getitem__(self, vertex: VertexId) -> Lookup:
        return self._maps[vertex].lookup

    def __iter__(self) -> Iterator[VertexId]:
        return iter(self._vertices)

    def __len__(self) -> int:
        return len(self._vertices)
