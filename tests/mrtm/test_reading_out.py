"""Trajectories and drawn maps that follow from a joint graph: a robot goes through two maps."""

import gtsam
import numpy as np
import pytest

from factors import Edge, EdgeId, EdgeKind, VertexId, adjoint_transport
from factors.noise import FloatArray
from frontend import se2
from frontend.local_map import Bends, Grid, LocalMap
from mrtm.joint.alignment.aligner import Aligner
from mrtm.joint.graph import JointGraph
from mrtm.joint.joint_map import Component
from mrtm.robot.poses import array_of
from mrtm.team.member import MemberRun
from mrtm.team.reading_out import bent_maps, map_poses, trajectory

RED, NEXT, BLUE = VertexId("red", 0), VertexId("red", 1), VertexId("blue", 0)
WAY = np.column_stack([np.arange(13.0), np.zeros((13, 2))])
AHEAD = gtsam.Pose2(12.0, 0.0, 0.0)
DRIFT = np.diag([4e-4, 9e-4, 4e-6])  # covariance of the motion at the origin that gathers in a metre
ASIDE = 0.12  # metres that the second vertex turns out to lie to the left


def local_map(first: int) -> LocalMap:
    """A scan a metre; the last of the first map is the second's first."""
    none = np.empty((0, 2))
    bends = Bends(WAY[::2, :2], WAY[::2, :1, None] * DRIFT)
    scans = first + np.arange(len(WAY), dtype=np.int64)
    return LocalMap(
        Grid(np.zeros((1, 1), np.float32), 0.05, np.zeros(2)), scans, scans.astype(np.float64), WAY, none, none, bends
    )


@pytest.fixture
def run() -> MemberRun:
    vertices = np.repeat([0, 1], [12, 13])
    poses = np.concatenate([WAY[:-1], WAY])
    maps = {RED: local_map(0), NEXT: local_map(12)}
    return MemberRun("red", [], np.arange(25.0), vertices, poses, maps, [], [], {}, {})


def component(aside: float) -> Component:
    """Red's and blue's graph; blue has seen red in both, and knows better where the second is, if it is believed."""
    graph = JointGraph(RED)
    covariance = adjoint_transport(AHEAD.inverse(), 12.0 * DRIFT)
    seen = AHEAD.compose(gtsam.Pose2(0.0, aside, 0.0))
    graph.update(
        add=[
            Edge(EdgeId("red", 0), 0, EdgeKind.INTER_VERTEX, RED, NEXT, AHEAD, covariance),
            Edge(EdgeId("blue", 0), 0, EdgeKind.FUSING, RED, BLUE, gtsam.Pose2(), 1e-6 * np.eye(3)),
            Edge(EdgeId("blue", 1), 0, EdgeKind.FUSING, BLUE, NEXT, seen, 1e-6 * np.eye(3)),
        ]
    )
    graph.optimize_fully()
    return Component(("blue", "red"), graph)


def steps(poses: FloatArray) -> FloatArray:
    return se2.between(poses[:-1], poses[1:])


def test_a_trajectory_gives_way_all_along(run: MemberRun) -> None:
    one = component(ASIDE)
    maps = bent_maps([one], Aligner(), [run])
    found = trajectory(run, maps)
    np.testing.assert_array_equal(found.times, run.times)
    np.testing.assert_array_equal(found.vertices, run.vertices)
    assert found.poses[12, 1] == pytest.approx(ASIDE, abs=1e-3)
    assert (np.diff(found.poses[:13, 1]) > 0.0).all()
    # A rigid map would have the whole of it in one step.
    assert np.abs(steps(found.poses)[:, 1]).max() < 0.6 * ASIDE
    placed = map_poses(maps, run.local_maps)
    assert 0.2 * ASIDE < placed[RED].y() < 0.8 * ASIDE
    assert placed[NEXT].equals(one.graph.estimate(NEXT), 1e-3)


def test_what_the_graph_doubts_bends_nothing(run: MemberRun) -> None:
    one = component(100.0 * ASIDE)
    assert len(one.graph.doubted()) == 1
    maps = bent_maps([one], Aligner(), [run])
    np.testing.assert_allclose(trajectory(run, maps).poses, np.concatenate([WAY, WAY[1:] + WAY[-1]]), atol=1e-6)
    for vertex, pose in map_poses(maps, run.local_maps).items():
        np.testing.assert_allclose(array_of(pose), array_of(one.graph.estimate(vertex)), atol=1e-6)
