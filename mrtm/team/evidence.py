"""What local maps say of an offset between two robots, asked as seldom as possible: it takes a tenth of a second."""

from collections.abc import Mapping

import gtsam
import numpy as np

from factors import UncertainPose, VertexId
from mrtm.joint.agreement import Decision
from mrtm.joint.aligner import Aligner
from mrtm.joint.graph import JointGraph
from mrtm.joint.joint_map import JointMap
from mrtm.joint.map_evidence import MapEvidence
from mrtm.joint.surface import Surface
from mrtm.robot.poses import innovation

SAME = np.array([0.1, 0.1, 0.02])  # metres and radians within which a question is that of before
EXPECTED = 16.27  # chi2 of 3 degrees of freedom, 99.9 %


class Evidence:
    """The word of the maps on where ``head`` lies, as ``judge`` asks for it.

    Where maps of the two robots have been aligned and the offset is the one they are aligned at, they agree. Else they
    are compared, unless that has been asked before and no map has changed.
    """

    def __init__(self, maps: Mapping[VertexId, Surface], joint: JointMap, aligner: Aligner) -> None:
        self._maps, self._joint, self._aligner = maps, joint, aligner
        self._answers: dict[tuple[VertexId, VertexId], list[tuple[tuple[Surface, ...], gtsam.Pose2, Decision]]] = {}

    def __call__(self, tail: VertexId, head: VertexId, tail_T_head: UncertainPose) -> Decision:
        """See ``MapEvidence``."""
        if self._aligned(tail, head, tail_T_head):
            return Decision.AGREES
        # A map may be heard of before the edge that leads to its vertex.
        known = {v for end in (tail, head) for v in self._joint.robots[end.robot].vertices()}
        maps = {vertex: self._maps[vertex] for vertex in self._maps if vertex in known}
        state = tuple(maps.values())
        answers = self._answers.setdefault((tail, head), [])
        for before, pose, answer in answers:
            if before == state and (np.abs(gtsam.Pose2.Logmap(pose.between(tail_T_head.pose))) < SAME).all():
                return answer
        lookups = {vertex: surface.lookup for vertex, surface in maps.items()}
        found = MapEvidence(lookups, self._joint.robots)(tail, head, tail_T_head)
        answers[:] = [answer for answer in answers if answer[0] == state]
        answers.append((state, tail_T_head.pose, found))
        return found

    def _aligned(self, tail: VertexId, head: VertexId, tail_T_head: UncertainPose) -> bool:
        component = self._joint.component(tail.robot)
        if head.robot not in component.robots or not self._aligner.joins(tail.robot, head.robot):
            return False
        graph: JointGraph = component.graph
        _, chi2 = innovation(graph.relative(tail, head), tail_T_head)
        return chi2 < EXPECTED
