import gtsam
import numpy as np
import pytest

from factors import AnchoredSighting, EdgeId, Sighting, SightingEdge, UncertainPose, VertexId
from mrtm.joint.tree import shortest_paths, tree_poses
from tests.mrtm.surface_world import distance, edge

A, B, C, D = (VertexId("red", k) for k in range(4))


def test_accumulates_along_the_shortest_path_and_against_edges() -> None:
    edges = [
        edge(0, A, B, gtsam.Pose2(4.0, 0.0, 0.5)),
        edge(1, C, B, gtsam.Pose2(-3.0, 0.0, 0.0)),
        edge(2, A, C, gtsam.Pose2(0.0, 9.0, 1.0)),  # longer than by way of B
    ]
    poses = tree_poses(edges, A)
    assert list(poses) == [A, B, C]
    expected = gtsam.Pose2(4.0, 0.0, 0.5).compose(gtsam.Pose2(3.0, 0.0, 0.0))
    assert distance(poses[C], expected)[0] < 1e-12
    assert distance(tree_poses(edges, C)[A], expected.inverse())[0] < 1e-12


def test_steps_and_parents_lead_back_to_the_root() -> None:
    edges = [edge(0, A, B, gtsam.Pose2(1.0, 0.0, 0.5)), edge(1, B, C, gtsam.Pose2(1.0, 1.0, 0.5))]
    tree = shortest_paths(edges, A)
    assert tree[A].parent is None
    assert [tree[v].parent for v in (B, C)] == [A, B]
    walked = gtsam.Pose2()
    for vertex in (B, C):
        walked = walked.compose(tree[vertex].step)
    assert distance(walked, tree[C].pose)[0] < 1e-12


def test_what_no_edge_reaches_is_left_out() -> None:
    assert list(tree_poses([edge(0, C, D, gtsam.Pose2(1.0, 0.0, 0.0))], A)) == [A]


def test_of_two_edges_between_the_same_vertices_the_shorter_counts() -> None:
    edges = [edge(0, A, B, gtsam.Pose2(2.0, 0.0, 0.0)), edge(1, A, B, gtsam.Pose2(1.9, 0.0, 0.0))]
    assert tree_poses(edges, A)[B].x() == pytest.approx(1.9)


def test_a_sighting_without_heading_is_no_step() -> None:
    anchor = UncertainPose(gtsam.Pose2(), np.eye(3) * 1e-4)
    sighting = Sighting(2.0, 0.1, None, 0.1, 0.1, None)
    seen = SightingEdge(EdgeId("red", 0), 0, AnchoredSighting(sighting, A, B, anchor, anchor))
    assert list(tree_poses([seen], A)) == [A]
