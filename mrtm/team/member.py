"""One robot of a team: its log in, and out what it would tell the others, in the order of the team's clock (M1 to M8).

Nothing of another robot enters here. So the robots of a team can be mapped side by side, in any order, and the outcome
is the same.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from factors import Edge, UncertainPose, VertexId
from frontend import se2
from frontend.local_map import Bends, LocalMap, contents
from frontend.local_slam import Visit
from frontend.records import FloatArray, LaserScan
from mrtm.config import Config
from mrtm.joint.graph import JointGraph
from mrtm.result import EdgeFate, Event
from mrtm.robot.poses import pose_of
from mrtm.robot.robot import Robot
from mrtm.robot.topology import Vertex
from mrtm.team.checks import MOST_PLACES
from mrtm.team.codec import pack, unpack
from mrtm.team.records import AnchorRecord, EdgeRecord, MapRecord, Record, VertexRecord
from mrtm.timing import Stages

GAP = 5.0  # seconds between two scans: where the robot was in between cannot be told
EXACT = np.diag([1e-3, 1e-3, 1e-4]) ** 2  # covariance of a pose that defines its vertex, for others to divide by
SQUARE = 3.0  # metres: what a map tells of its sureness, once in each
LOST = 1e4  # m^2, the largest entry of a covariance that is told: beyond that nothing is known of a place anyway


@dataclass(slots=True)
class MemberRun:
    """What a robot leaves behind.

    Attributes:
        robot: name.
        told: what it can tell the others: team time, ascending, and the record, packed.
        times: (n,) of its scans, the log's own clock.
        vertices: (n,) index of the vertex in whose map each scan lies.
        poses: (n, 3) local_T_robot in that vertex.
        local_maps: of its vertices.
        past: edges that newer versions replaced.
        events: what happened on the way.
        seconds, longest: by stage, as in ``Stages``.
        blemishes: of its log.
    """

    robot: str
    told: list[tuple[float, bytes]]
    times: FloatArray
    vertices: npt.NDArray[np.int64]
    poses: FloatArray
    local_maps: dict[VertexId, LocalMap]
    past: list[EdgeFate]
    events: list[Event]
    seconds: dict[str, float]
    longest: dict[str, float]
    blemishes: list[str] = field(default_factory=list)

    @property
    def records(self) -> list[Record]:
        """What was told, as others will see it."""
        return [unpack(data) for _, data in self.told]


def map_member(
    name: str,
    scans: Iterable[tuple[float, LaserScan]],
    config: Config,
    moments: Sequence[float] = (),
    report: Callable[[int, int], None] = lambda scans, vertices: None,
) -> MemberRun:
    """Map one robot's scans.

    Args:
        scans: with the team time of each.
        moments: team times, ascending, at which the robot must know where it was (an anchor record each).
        report: told now and then how many scans have been taken and how many vertices there are.
    """
    stages = Stages()
    story = _Story(name, moments, stages)
    robot = Robot(name, config, story.make_joint, story.events.append, story.visited, stages)
    source = iter(scans)
    while True:
        with stages("reading"):
            found = next(source, None)
        if found is None:
            break
        time, scan = found
        story.begin_scan(time, scan.odometry)
        robot.process(scan)
        story.end_scan(robot)
        if len(robot.times) % 100 == 0:
            report(len(robot.times), len(robot.topology.vertices))
    story.end_log()
    robot.finish()
    return _run(robot, story, stages)


@dataclass(slots=True)
class _Anchor:
    """A moment at which the robot must know where it was: ``scan``'s pose, and ``offset`` from there by odometry."""

    number: int
    scan: int
    offset: FloatArray
    version: int = -1  # the last one told


class _Story:
    """Listens to a robot at work and writes down what it could tell the others, and when."""

    def __init__(self, robot: str, moments: Sequence[float], stages: Stages) -> None:
        self.told: list[tuple[float, bytes]] = []
        self.events: list[Event] = []
        self.times: list[float] = []  # team times of the scans
        self._robot = robot
        self._stages = stages
        self._odometry: list[FloatArray] = []
        self._moments = list(enumerate(moments))
        self._anchors: list[_Anchor] = []
        self._vertices = 0
        self._versions: dict[VertexId, int] = {}

    @property
    def now(self) -> float:
        """Team time; it never steps back."""
        return self.times[-1]

    def tell(self, record: Record) -> None:
        """Packed at once: a map takes a hundredth of its room then."""
        with self._stages("exchange"):
            self.told.append((record.time, pack(record)))

    def make_joint(self, root: VertexId) -> "_ToldGraph":
        """M1."""
        return _ToldGraph(root, self)

    def begin_scan(self, time: float, odometry: FloatArray) -> None:
        """The robot is about to take a scan; where was it at the moments since the one before?"""
        self.times.append(max(time, self.times[-1]) if self.times else time)
        self._odometry.append(odometry)
        while self._moments and self._moments[0][1] < self.now:
            number, moment = self._moments.pop(0)
            if len(self.times) < 2:
                continue
            start, end = self.times[-2:]
            if start <= moment and end - start <= GAP:
                part = (moment - start) / (end - start)
                offset = part * se2.between(self._odometry[-2], odometry)
                self._anchors.append(_Anchor(number, len(self.times) - 2, offset))

    def end_scan(self, robot: Robot) -> None:
        """The robot has taken the scan; tell of vertices and anchors that are new."""
        while self._vertices < len(robot.topology.vertices):
            vertex = robot.topology.vertices[self._vertices].id
            self.tell(VertexRecord(vertex, 0, self.now, 0))
            self._vertices += 1
        for anchor in self._anchors[::-1]:
            if anchor.version >= 0:
                break
            if (where := robot.whereabouts(anchor.scan)) is not None:
                self._tell_anchor(anchor, *where)

    def end_log(self) -> None:
        """There is no scan any more; was there a moment at that of the last?"""
        for number, moment in self._moments[:1]:
            if self.times and moment == self.now:
                self._anchors.append(_Anchor(number, len(self.times) - 1, np.zeros(3)))

    def visited(self, vertex: Vertex, first: int, visit: Visit) -> None:
        """A map has been closed: its scans' poses are what they will stay."""
        version = self._versions[vertex.id] = self._versions.get(vertex.id, 0) + 1
        local_map = local_map_of(vertex, np.array(self.times))
        self.tell(VertexRecord(vertex.id, version, self.now, len(local_map.scans)))
        drawn = local_map.grid, local_map.cloud, local_map.normals, local_map.bends
        self.tell(MapRecord(vertex.id, version, self.now, *drawn))
        for anchor in self._anchors:
            if first <= anchor.scan < first + len(visit.poses):
                anchor.version = max(anchor.version, 0)  # what comes is refined, even if nothing was told before
                near = int(np.argmin(np.abs(visit.chosen - (anchor.scan - first))))
                pose = UncertainPose(pose_of(visit.poses[anchor.scan - first]), visit.covariances[near])
                self._tell_anchor(anchor, vertex.id, pose)

    def _tell_anchor(self, anchor: _Anchor, vertex: VertexId, at_scan: UncertainPose) -> None:
        anchor.version += 1
        pose = UncertainPose(at_scan.pose.compose(pose_of(anchor.offset)), at_scan.covariance + EXACT)
        self.tell(AnchorRecord(self._robot, anchor.number, anchor.version, self.now, vertex, pose))


class _ToldGraph:
    """The robot's joint map of its own edges, every change of which is written down."""

    def __init__(self, root: VertexId, story: _Story) -> None:
        self._graph = JointGraph(root)
        self._story = story

    def update(self, *, add: Iterable[Edge] = (), replace: Iterable[Edge] = ()) -> None:
        """See ``JointGraph``."""
        add, replace = list(add), list(replace)
        self._graph.update(add=add, replace=replace)
        for edge in (*add, *replace):
            self._story.tell(EdgeRecord(edge, self._story.now))

    def relatives(self, pairs: Sequence[tuple[VertexId, VertexId]]) -> list[UncertainPose]:
        """See ``JointGraph``."""
        return self._graph.relatives(pairs)


def _run(robot: Robot, story: _Story, stages: Stages) -> MemberRun:
    n = len(robot.times)
    poses, inside = np.zeros((n, 3)), np.zeros(n, np.int64)
    times = np.array(robot.times)
    for vertex in robot.topology.vertices:
        scans = np.array(vertex.scans, np.int64)
        poses[scans] = np.array(vertex.poses).reshape(-1, 3)
        inside[scans] = vertex.id.number
    return MemberRun(
        robot=robot.name,
        told=story.told,
        times=times,
        vertices=inside,
        poses=poses,
        local_maps={v.id: local_map_of(v, times) for v in robot.topology.vertices if v.maps is not None},
        past=robot.topology.past,
        events=story.events,
        seconds=stages.seconds,
        longest=stages.longest,
    )


def local_map_of(vertex: Vertex, times: FloatArray) -> LocalMap:
    """The local map of a vertex that is closed; ``times`` (n,) of the robot's scans."""
    assert vertex.maps is not None
    grid, cloud, normals = contents(vertex.maps)
    # A visit that was resumed has the scan of the seam twice; the later pose is the one that had the whole map.
    scans, order = np.unique(np.array(vertex.scans, np.int64)[::-1], return_index=True)
    order = len(vertex.scans) - 1 - order
    poses = np.array(vertex.poses)[order]
    return LocalMap(grid, scans, times[scans], poses, cloud, normals, _bends(vertex))


def _bends(vertex: Vertex) -> Bends:
    """What a vertex tells of how sure the parts of its map are: the means over squares."""
    covariances, places = vertex.bends.covariances, vertex.bends.places
    covariances = covariances / np.maximum(np.abs(covariances).max(axis=(1, 2), keepdims=True) / LOST, 1.0)
    side, count = SQUARE, MOST_PLACES + 1
    while count > MOST_PLACES:
        squares, which = np.unique(np.floor(places / side), axis=0, return_inverse=True)
        count, side = len(squares), 2.0 * side
    members = which.ravel() == np.arange(count)[:, None]
    share = members / members.sum(axis=1, keepdims=True)
    return Bends(share @ places, np.einsum("sk,kij->sij", share, covariances))
