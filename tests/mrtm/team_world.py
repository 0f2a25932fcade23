"""Made-up teams as records, without a front end: what five robots would tell of a walk, and runs to play."""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from factors import Edge, EdgeId, EdgeKind, UncertainPose, VertexId
from factors.sighting import Sighting
from frontend.local_map import Grid, LocalMap
from mrtm.config import Config, load_config
from mrtm.joint.sightings.hypotheses import Hypothesis
from mrtm.team.codec import pack
from mrtm.team.member import MemberRun
from mrtm.team.records import AnchorRecord, EdgeRecord, Record, SightingRecord, VertexRecord
from mrtm.team.session_file import TimedSighting
from mrtm.team.teammate import Peers, Teammate
from mrtm.timing import Stages
from tests.mrtm.sighting_world import STEP, TeamWorld

BETWEEN = 10.0  # seconds between two vertices

NO_MAPS = load_config(options=["joint.alignments=0"])


def teammate(name: str | None, records: Iterable[Record] = (), config: Config = NO_MAPS) -> Teammate:
    """A robot that has recorded or heard ``records``, and has not thought about them yet."""
    one = Teammate(name, config, Stages(), Peers())
    one.store.merge(records)
    return one


def own_records(world: TeamWorld, name: str, loops: int = 0, false_loops: int = 0) -> list[Record]:
    """Vertices and edges of one robot: every second edge in two versions, and loops between any two vertices."""
    rng = np.random.default_rng((world.seed, len(name), loops))
    records: list[Record] = []
    for vertex in world.graphs[name].vertices():
        time = BETWEEN * vertex.number
        records += [VertexRecord(vertex, 0, time, 0), VertexRecord(vertex, 1, time + BETWEEN, 30)]
    for edge in world.graphs[name].edges():
        assert isinstance(edge, Edge)
        records.append(EdgeRecord(edge, BETWEEN * edge.head.number))
        if edge.id.number % 2:
            records.append(EdgeRecord(second_version(edge), BETWEEN * (edge.head.number + 1)))
    for number in range(loops + false_loops):
        i, k = sorted(rng.choice(world.vertices, 2, replace=False).tolist())
        tail, head = VertexId(name, i), VertexId(name, k)
        pose = world.truth[tail].between(world.truth[head])
        if number >= loops:
            pose = pose.compose(gtsam.Pose2(*rng.uniform([1, 1, -1], [4, 4, 1])))
        pose = pose.compose(gtsam.Pose2.Expmap(rng.multivariate_normal(np.zeros(3), STEP)))
        loop = Edge(EdgeId(name, 100 + number), 0, EdgeKind.LOOP, tail, head, pose, STEP)
        records.append(EdgeRecord(loop, BETWEEN * k + 5.0))
    return records


def second_version(edge: Edge) -> Edge:
    """What M5 makes of an edge."""
    pose = edge.measurement.compose(gtsam.Pose2(0.02, -0.01, 0.003))
    return Edge(edge.id, 1, EdgeKind.COVARIANCE_INTERSECTION, edge.tail, edge.head, pose, 0.7 * edge.covariance)


def met(hypotheses: Sequence[Hypothesis]) -> list[list[Record]]:
    """For each sighting its records: what was seen, and where both robots were, first roughly and then for good."""
    found = []
    for place, h in enumerate(hypotheses):
        (observer, number), time = h.id, BETWEEN * (1 + max(h.observer.number, h.observed.number))
        ends = ((h.observer, h.tail_T_observer), (h.observed, h.head_T_observed))
        seen = SightingRecord(
            observer, number, 0, time, h.observed.robot, h.sighting, (observer, place), (h.observed.robot, place)
        )
        anchors: list[Record] = []
        for vertex, where in ends:
            rough = UncertainPose(where.pose.compose(gtsam.Pose2(0.01, 0.01, 0.002)), 1.2 * where.covariance)
            anchors.append(AnchorRecord(vertex.robot, place, 0, time, vertex, rough))
            anchors.append(AnchorRecord(vertex.robot, place, 1, time + BETWEEN, vertex, where))
        found.append([seen, *anchors])
    return found


def everything(world: TeamWorld, loops: int = 2, false_loops: int = 1) -> list[Record]:
    """All that all robots have to tell."""
    own = [record for name in world.names for record in own_records(world, name, loops, false_loops)]
    return own + [record for records in met(world.hypotheses) for record in records]


def chain(seed: int, robots: int = 5, sightings: int = 7, false: float = 0.0, headings: bool = True) -> TeamWorld:
    """Robots of which each has seen the next."""
    world = TeamWorld(seed, robots, headings=headings)
    for a, b in zip(world.names, world.names[1:], strict=False):
        world.sight(a, b, sightings, false)
    return world


def apart(a: dict[VertexId, gtsam.Pose2], b: dict[VertexId, gtsam.Pose2], origin: VertexId) -> float:
    """The largest difference of two maps of the same vertices seen from ``origin``, metres or radians."""
    assert a.keys() == b.keys()
    offsets = [a[origin].between(a[v]).between(b[origin].between(b[v])) for v in a]
    return max(float(np.abs([o.x(), o.y(), o.theta()]).max()) for o in offsets)


def partition(one: Teammate) -> list[tuple[str, ...]]:
    """The robots of each component."""
    return [component.robots for component in one.joint.components()]


def estimates(one: Teammate) -> dict[VertexId, gtsam.Pose2]:
    """joint_T_vertex of all it knows, each in the frame of its component."""
    return {v: pose for component in one.joint.components() for v, pose in component.graph.estimates().items()}


def run_of(
    world: TeamWorld, name: str, moments: Sequence[tuple[float, Hypothesis]] = (), start: float = 0.0
) -> MemberRun:
    """What a front end would leave of a robot's walk: a scan a second, each at its vertex.

    ``moments``: times of sightings that the robot takes part in.
    """
    records = own_records(world, name)
    for number, (time, h) in enumerate(sorted(moments, key=lambda moment: moment[0])):
        vertex, where = (h.observer, h.tail_T_observer) if h.observer.robot == name else (h.observed, h.head_T_observed)
        records.append(AnchorRecord(name, number, 0, time, vertex, where))
    records.sort(key=lambda r: r.time)
    times = start + np.arange(world.vertices * BETWEEN)
    vertices = (np.arange(len(times)) // BETWEEN).astype(np.int64)
    maps = {}
    for index in range(world.vertices):
        inside = np.flatnonzero(vertices == index)
        grid = Grid(np.zeros((2, 2), np.float32), 0.05, np.zeros(2))
        none = np.empty((0, 2))
        maps[VertexId(name, index)] = LocalMap(grid, inside, times[inside], np.zeros((len(inside), 3)), none, none)
    return MemberRun(name, told(records), times, vertices, np.zeros((len(times), 3)), maps, [], [], {}, {})


def told(records: Iterable[Record]) -> list[tuple[float, bytes]]:
    """As a run holds them."""
    return [(record.time, pack(record)) for record in records]


def timed(moments: Sequence[tuple[float, Hypothesis]]) -> list[TimedSighting]:
    """The sightings of a session."""
    return [TimedSighting(time, h.observer.robot, h.observed.robot, h.sighting) for time, h in moments]


def shifted(sighting: Sighting, range_: float) -> Sighting:
    """The same direction, farther or nearer by ``range_``."""
    return Sighting(
        sighting.range + range_,
        sighting.bearing,
        sighting.heading,
        sighting.sigma_range,
        sighting.sigma_bearing,
        sighting.sigma_heading,
    )
