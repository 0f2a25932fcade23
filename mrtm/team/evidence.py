"""What local maps say of an offset between two robots, asked as seldom as possible: it takes a tenth of a second."""

import gtsam
import numpy as np

from factors import UncertainPose, VertexId
from mrtm.joint.alignment.agreement import Decision
from mrtm.joint.joint_map import JointMap
from mrtm.joint.sightings.map_evidence import MapEvidence
from mrtm.team.surfaces import Surfaces

SAME = np.array([0.1, 0.1, 0.02])  # metres and radians within which a question is that of before

Answers = dict[tuple[VertexId, VertexId], list[tuple[tuple[bytes, ...], gtsam.Pose2, Decision]]]
"""For two vertices the maps as they were, the offset asked about, and the answer."""


class Evidence:
    """The word of the maps on where ``head`` lies, as ``judge`` asks for it.

    Maps are compared unless that has been asked before, by anybody who shares the ``answers``, and no map has changed.
    """

    def __init__(self, maps: Surfaces, joint: JointMap, answers: Answers) -> None:
        self._maps, self._joint, self._answers = maps, joint, answers

    def __call__(self, tail: VertexId, head: VertexId, tail_T_head: UncertainPose) -> Decision:
        """See ``MapEvidence``."""
        state = self._maps.state(tail.robot) + self._maps.state(head.robot)
        answers = self._answers.setdefault((tail, head), [])
        for before, pose, answer in answers:
            if before == state and (np.abs(gtsam.Pose2.Logmap(pose.between(tail_T_head.pose))) < SAME).all():
                return answer
        maps = self._maps.of(tail.robot) | self._maps.of(head.robot)
        # A map may be heard of before the edge that leads to its vertex.
        known = {v for end in (tail, head) for v in self._joint.robots[end.robot].vertices()}
        lookups = {vertex: surface.lookup for vertex, surface in maps.items() if vertex in known}
        found = MapEvidence(lookups, self._joint.robots)(tail, head, tail_T_head)
        answers.append((state, tail_T_head.pose, found))
        del answers[:-KEPT]
        return found


KEPT = 16  # answers about two vertices
