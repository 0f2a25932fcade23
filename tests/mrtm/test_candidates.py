"""Which pairs of maps are worth aligning."""

import gtsam
import numpy as np

from factors import UncertainPose, VertexId
from mrtm.joint.alignment.candidates import pairs
from mrtm.joint.alignment.surface import Surface
from mrtm.robot.poses import array_of
from tests.mrtm.wall_maps import Wall, seen, unknown

ROOM: list[Wall] = [(0, 0, 10, 0), (10, 0, 10, 6), (10, 6, 0, 6), (0, 6, 0, 0)]
MAP = seen(ROOM, np.array([5.0, 3.0, 0.0]), 0.0, 10.0, 0)


class World:
    """Maps of 10 m x 6 m in a row, their origins ``step`` metres apart, known to ``sigma`` metres."""

    def __init__(self, count: int, step: float, sigma: float) -> None:
        self.maps: dict[VertexId, Surface] = {VertexId("red", i): MAP for i in range(count)}
        self.poses = {v: gtsam.Pose2(step * v.number, 0.0, 0.0) for v in self.maps}
        self.covariance = np.diag([sigma**2, sigma**2, 0.01**2])
        self.asked: list[tuple[int, int]] = []

    def relatives(self, pairs: list[tuple[VertexId, VertexId]]) -> list[UncertainPose]:
        self.asked += [(a.number, b.number) for a, b in pairs]
        return [UncertainPose(self.poses[a].between(self.poses[b]), self.covariance) for a, b in pairs]

    def found(self, changed: set[int] | None = None, most: int = 99) -> list[tuple[int, int]]:
        def wanted(a: VertexId, b: VertexId) -> bool:
            return changed is None or bool({a.number, b.number} & changed)

        return [(c.a.number, c.b.number) for c in pairs(self.maps, self.poses, self.relatives, wanted, most)]


def test_neighbours_that_overlap_the_largest_overlap_first() -> None:
    world = World(6, 4.0, 0.05)
    found = world.found()
    assert set(found) == {(i, i + 1) for i in range(5)} | {(i, i + 2) for i in range(4)}  # 36 m^2 and 12 m^2
    assert set(found[:5]) == {(i, i + 1) for i in range(5)}


def test_the_guess_comes_along() -> None:
    world = World(2, 4.0, 0.05)
    (candidate,) = pairs(world.maps, world.poses, world.relatives)
    np.testing.assert_allclose(array_of(candidate.guess.pose), (4.0, 0.0, 0.0))
    np.testing.assert_array_equal(candidate.guess.covariance, world.covariance)


def test_only_pairs_of_what_changed_and_few_are_asked_about() -> None:
    world = World(40, 4.0, 0.05)
    assert set(world.found({7})) == {(5, 7), (6, 7), (7, 8), (7, 9)}
    assert len(world.asked) < 14  # of 39: the rest is too far away whatever the covariance


def test_a_bound_keeps_the_best() -> None:
    assert set(World(6, 4.0, 0.05).found(most=3)) < {(i, i + 1) for i in range(5)}


def test_maps_that_may_overlap_by_their_covariance() -> None:
    assert World(2, 9.0, 0.05).found() == []  # 1 m x 6 m
    assert World(2, 9.0, 1.0).found() == [(0, 1)]
    assert World(2, 25.0, 1.0).found() == []


def test_a_map_of_nothing_has_no_pairs() -> None:
    world = World(2, 4.0, 0.05)
    world.maps[VertexId("red", 1)] = unknown()
    assert world.found() == []
