"""A team played by one clock: robots drive, meet, exchange what they know, and solve their joint maps (M9 to M13)."""

import heapq
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from factors import GraphEdge, VertexId
from mrtm.config import Config
from mrtm.joint.alignment.warm_up import warm_up
from mrtm.joint.bending import BentMap
from mrtm.joint.graph import JointGraph
from mrtm.joint.sightings.consistency import Verdict
from mrtm.result import EdgeFate, Latency, Meeting, RunResult, SightingFate, TeamStory
from mrtm.team.codec import pack
from mrtm.team.exchange import exchange
from mrtm.team.member import MemberRun
from mrtm.team.reading_out import bent_maps, map_poses, trajectory
from mrtm.team.records import SightingRecord
from mrtm.team.sightings_file import TimedSighting, sighting_times
from mrtm.team.store import item_of
from mrtm.team.teammate import Peers, Teammate
from mrtm.timing import Stages, uninterrupted

LINGER = 0.5  # seconds that robots stay in contact after a sighting, so that they know where they were


def play(
    runs: Sequence[MemberRun],
    sightings: Sequence[TimedSighting],
    config: Config,
    report: Callable[[float], None] = lambda fraction: None,
) -> RunResult:
    """Let robots that have been mapped by themselves meet as their sightings say.

    Every robot makes its own joint map of what it has heard. The result is that of somebody who in the end hears all
    (M13): the best there is.

    Args:
        runs: of the front ends, one a robot.
        sightings: between them, by team time.
        report: told now and then which fraction of the meetings has passed.
    """
    playback = Playback(runs, sightings, config)
    playback.play(report)
    return playback.result(config)


class Playback:
    """See ``play``.

    Attributes:
        team: the robots, by name.
        listener: somebody who in the end hears all.
    """

    def __init__(self, runs: Sequence[MemberRun], sightings: Sequence[TimedSighting], config: Config) -> None:
        self._runs = runs
        self._config = config
        self._stages = Stages()
        peers = Peers()
        self.team = {run.robot: Teammate(run.robot, config, self._stages, peers) for run in runs}
        self.listener = Teammate(None, config, self._stages, peers)
        self._sightings = _numbered(sightings)
        self._meetings: list[Meeting] = []
        self._latencies: list[Latency] = []
        self._frames: list[tuple[float, frozenset[str]]] = []  # team time and robots of every new component
        self._bent: dict[VertexId, BentMap] = {}

    def play(self, report: Callable[[float], None]) -> None:
        """All meetings, and what the listener makes of it all in the end."""
        meetings = _meetings(self._sightings, self._config.team.exchange_interval)
        seen = [(s.time, pack(s)) for s in self._sightings]
        warm_up()
        told = deque(heapq.merge(*(run.told for run in self._runs), seen, key=lambda item: item[0]))
        for number, (time, robots) in enumerate(meetings):
            while told and told[0][0] <= time:
                self._write_down(told.popleft()[1])
            with uninterrupted():
                self.meet(time, robots)
            report(number / len(meetings))
        for _, data in told:
            self._write_down(data)
        for teammate in self.team.values():
            teammate.learn()
        before = dict(self._stages.seconds)
        self.listener.settle()
        with self._stages("joint map"):
            self._bent = bent_maps(self.listener.joint.components(), self.listener.aligner, self._runs)
        self._note(meetings[-1][0] if meetings else 0.0, self.listener, self._stages.since(before))

    def agree(self) -> bool:
        """Let all robots meet once more, and tell whether every joint map is then the listener's, pose by pose."""
        for _ in range(2):  # to the first and back
            first, *others = self.team.values()
            for other in others:
                exchange(first.store, other.store)
        poses = [c.graph.estimates() for c in self.listener.joint.components()]
        for teammate in self.team.values():
            teammate.settle()
            found = [c.graph.estimates() for c in teammate.joint.components()]
            if [set(c) for c in found] != [set(c) for c in poses]:
                return False
            if any(not p.equals(b[v], 1e-9) for a, b in zip(found, poses, strict=True) for v, p in a.items()):
                return False
        return True

    def _write_down(self, data: bytes) -> None:
        with self._stages("exchange"):
            item = item_of(data)
            for teammate in (self.team[item.key.robot], self.listener):
                teammate.store.add(item)

    def meet(self, time: float, robots: tuple[str, str]) -> None:
        """Two robots tell each other what they know, and think about it where it is due (M10, M11, M13)."""
        one, other = (self.team[robot] for robot in robots)
        before = dict(self._stages.seconds)
        with self._stages("exchange"):
            traffic = exchange(one.store, other.store)
        exchanged = self._stages.since(before)
        for teammate in (one, other):
            if teammate.is_due():
                before = dict(self._stages.seconds)
                teammate.think()
                teammate.align()
                self._note(time, teammate, exchanged | self._stages.since(before))
            for robot in teammate.joint.robots.keys() & {teammate.name}:  # none if it has not taken a scan yet
                self._frames.append((time, frozenset(teammate.joint.component(robot).robots)))
        verdict, reason = _verdict(one, robots)
        self._meetings.append(Meeting(time, robots, dict(traffic.sent), verdict, reason))

    def _note(self, time: float, teammate: Teammate, seconds: dict[str, float]) -> None:
        vertices = sum(len(c.graph.vertices()) for c in teammate.joint.components())
        self._latencies.append(Latency(time, teammate.name, vertices, seconds))

    def result(self, config: Config) -> RunResult:
        """What is known at the end of ``play``, in the joint maps of the listener."""
        joint = self.listener.joint
        components = joint.components()
        poses = {v: pose for c in components for v, pose in c.graph.estimates().items()}
        edges = [fate for run in self._runs for fate in run.past]
        graphs = [component.graph for component in components]
        local_maps = {vertex: local_map for run in self._runs for vertex, local_map in run.local_maps.items()}
        edges += [_edge_fate(graph, edge) for graph in graphs for edge in graph.edges()]
        stages = [*((run.seconds, run.longest) for run in self._runs), (self._stages.seconds, self._stages.longest)]
        names = list(dict.fromkeys(name for seconds, _ in stages for name in seconds))
        return RunResult(
            config=config.model_dump(mode="json"),
            seed=config.seed,
            trajectories={run.robot: trajectory(run, self._bent) for run in self._runs},
            local_maps=local_maps,
            map_poses=map_poses(self._bent, local_maps),
            vertex_poses=poses,
            vertex_covariances={v: c.graph.marginal(v) for c in components for v in c.graph.vertices()},
            components=[c.graph.vertices() for c in components],
            edges=edges,
            events=[event for run in self._runs for event in run.events],
            timings={name: sum(seconds.get(name, 0.0) for seconds, _ in stages) for name in names},
            longest={name: max(longest.get(name, 0.0) for _, longest in stages) for name in names},
            counts={
                "scans": sum(len(run.times) for run in self._runs),
                "vertices": len(poses),
                "edges": sum(len(graph.edges()) - len(graph.doubted()) for graph in graphs),
            },
            blemishes=list(dict.fromkeys(blemish for run in self._runs for blemish in run.blemishes))
            + list(joint.refused.values()),
            team=self._story() if len(self._runs) > 1 else None,
            latencies=self._latencies,
        )

    def _story(self) -> TeamStory:
        largest = max((frozenset(c.robots) for c in self.listener.joint.components()), key=len)
        together = [time for time, robots in self._frames if robots >= largest]
        return TeamStory(
            meetings=self._meetings,
            sightings=[self._fate(sighting) for sighting in self._sightings],
            first_meeting=self._meetings[0].time if self._meetings else None,
            common_frame=together[0] if together and len(largest) > 1 else None,
            known={name: _known(teammate) for name, teammate in self.team.items()},
        )

    def _fate(self, sighting: SightingRecord) -> SightingFate:
        ends = sighting.time, sighting.observer, sighting.observed
        judgement = self.listener.judgements.get((sighting.observer, sighting.number))
        if judgement is None:
            return SightingFate(*ends, "refused", "no scan at that time: where the robots were is not known")
        numbers = {"support": float(judgement.support), "rival": float(judgement.rival)}
        if judgement.chi2 is not None:
            numbers["chi2"] = judgement.chi2
        return SightingFate(*ends, str(judgement.verdict), judgement.reason, numbers)


def _edge_fate(graph: JointGraph, edge: GraphEdge) -> EdgeFate:
    chi2 = graph.chi2(edge.id)
    if edge.id in graph.doubted():
        return EdgeFate(edge, "refused", f"chi2 {chi2:.1f} from the joint estimate: without effect", chi2)
    return EdgeFate(edge, "accepted", chi2=chi2)


def _numbered(sightings: Sequence[TimedSighting]) -> list[SightingRecord]:
    """The sightings as records: running numbers by observer, and the moments at which either robot notes its place."""
    moments = {
        robot: {time: number for number, time in enumerate(sighting_times(sightings, robot))}
        for robot in {name for s in sightings for name in (s.observer, s.observed)}
    }
    count: Counter[str] = Counter()
    records = []
    for s in sorted(sightings, key=lambda s: s.time):
        records.append(
            SightingRecord(
                s.observer, count[s.observer], 0, s.time, s.observed, s.measurement,
                (s.observer, moments[s.observer][s.time]), (s.observed, moments[s.observed][s.time]),
            )
        )  # fmt: skip
        count[s.observer] += 1
    return records


def _meetings(sightings: Iterable[SightingRecord], interval: float) -> list[tuple[float, tuple[str, str]]]:
    """When which robots exchange: soon after they see each other, every ``interval`` while they do, and at its end."""
    contacts: dict[tuple[str, str], list[list[float]]] = {}
    for s in sightings:
        pair = min(s.observer, s.observed), max(s.observer, s.observed)
        runs = contacts.setdefault(pair, [])
        if runs and s.time - runs[-1][-1] <= interval:
            runs[-1].append(s.time)
        else:
            runs.append([s.time])
    meetings = []
    for pair, runs in contacts.items():
        for times in runs:
            due = -np.inf
            for time in times:
                if time >= due or time == times[-1]:
                    meetings.append((time + LINGER, pair))
                    due = time + interval
    return sorted(meetings)


def _verdict(teammate: Teammate, robots: tuple[str, str]) -> tuple[str, str]:
    """What the sightings between two robots come to: the best verdict on any, and the last reason for it."""
    found = [j for _, j in sorted(teammate.judgements_between(robots).items())]
    for verdict in (Verdict.ACCEPTED, Verdict.WAITING, Verdict.REFUSED):
        reasons = [j.reason for j in found if j.verdict is verdict]
        if reasons:
            return str(verdict), reasons[-1]
    return str(Verdict.WAITING), "where the robots were is not known yet"


def _known(teammate: Teammate) -> dict[str, int]:
    """Vertices in the frame of a robot, by the robot that made them."""
    assert teammate.name is not None
    return dict(Counter(v.robot for v in teammate.joint.component(teammate.name).graph.vertices()))
