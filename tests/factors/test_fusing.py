from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import chi2, kstest

from factors import (
    AnchoredSighting,
    EdgeId,
    EdgeKind,
    FactorError,
    Sighting,
    UncertainPose,
    VertexId,
    adjoint_transport,
    fuse_sightings,
    fusing_edge,
    fusing_factor,
    has_kernel,
    without_kernel,
)

FloatArray = npt.NDArray[np.float64]

BLUE, RED = VertexId("blue", 3), VertexId("red", 1)  # blue is the lesser: the tail
TRUTH = gtsam.Pose2(5.0, -3.0, 2.8)  # blue_T_red


def world(
    rng: np.random.Generator, count: int, both_ways: bool, shift: FloatArray, sensor: bool, heading: bool
) -> list[AnchoredSighting]:
    """Two robots on the move that see each other, their vertices displaced by N(0, shift), noise on every sighting.

    The anchors' covariances are those of the displacement, as each robot would state it in its own frame.
    """
    displaced = [gtsam.Pose2.Expmap(rng.multivariate_normal(np.zeros(3), shift)) for _ in range(2)]
    sightings = []
    for i in range(count):
        in_blue = gtsam.Pose2(4.0 + 0.6 * i, 1.0 + 0.3 * i, 0.2 * i)
        in_red = gtsam.Pose2(-1.0 - 0.2 * i, 2.0 - 0.5 * i, 1.0 - 0.1 * i)
        blue_T_red_robots = in_blue.between(TRUTH.compose(in_red))
        # What the robots think: their maps hold them at poses that the displacement takes to the true ones.
        anchors = []
        for pose, off in ((in_blue, displaced[0]), (in_red, displaced[1])):
            believed = off.inverse().compose(pose)
            anchors.append(UncertainPose(believed, adjoint_transport(believed.inverse(), shift)))
        swapped = both_ways and i % 2 == 1
        relative = blue_T_red_robots.inverse() if swapped else blue_T_red_robots
        exact = np.array(
            [np.hypot(relative.x(), relative.y()), np.arctan2(relative.y(), relative.x()), relative.theta()]
        )
        r, b, h = rng.normal(exact, [0.05, 0.02, 0.05]) if sensor else exact
        sighting = Sighting(r, b, h if heading else None, 0.05, 0.02, 0.05 if heading else None)
        vertices, at = ((RED, BLUE), anchors[::-1]) if swapped else ((BLUE, RED), anchors)
        sightings.append(AnchoredSighting(sighting, *vertices, *at))
    return sightings


SHIFT = np.diag([0.04, 0.03, 0.01]) ** 2 + 1e-5
NOTHING = np.zeros((3, 3))


def test_error_and_derivatives(checks: Any) -> None:
    checks.error_and_derivatives(EdgeKind.FUSING, fusing_factor)


def test_covariance_frame(checks: Any) -> None:
    checks.covariance_is_in_the_frame_of_the_child(EdgeKind.FUSING, fusing_factor)


def test_factor_is_robust(checks: Any) -> None:
    factor = fusing_factor(checks.edge(EdgeKind.FUSING, 0.1), 0, 1)
    assert has_kernel(factor)
    assert not has_kernel(without_kernel(factor))


@pytest.mark.parametrize("heading", [True, False])
@pytest.mark.parametrize("both_ways", [True, False])
def test_exact_sightings_give_the_exact_pose(rng: np.random.Generator, heading: bool, both_ways: bool) -> None:
    found = fuse_sightings(world(rng, 6, both_ways, NOTHING, sensor=False, heading=heading))
    assert found is not None
    assert found.pose.equals(TRUTH, 1e-8)


def test_one_sighting_with_a_heading_is_the_composition(rng: np.random.Generator) -> None:
    """blue_T_robot * sighting * robot_T_red; its covariance the sum of three, each carried to red's frame."""
    (one,) = world(rng, 1, False, SHIFT, sensor=True, heading=True)
    found, seen = fuse_sightings([one]), one.sighting.relative_pose()
    assert found is not None
    assert seen is not None
    assert found.pose.equals(one.observer.pose.compose(seen.pose).compose(one.observed.pose.inverse()), 1e-9)
    head_T_observed = one.observed.pose
    head_T_observer = head_T_observed.compose(seen.pose.inverse())
    expected = (
        adjoint_transport(head_T_observer, one.observer.covariance)
        + adjoint_transport(head_T_observed, seen.covariance)
        + adjoint_transport(head_T_observed, one.observed.covariance)
    )
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "both_ways", "heading"),
    [(1, False, True), (5, True, True), (2, True, False), (6, False, False), (10, True, False)],
)
def test_covariance_is_honest(rng: np.random.Generator, count: int, both_ways: bool, heading: bool) -> None:
    """Worlds with displaced vertices and noisy sensors: chi2 of the truth has 3 degrees of freedom."""
    values = []
    for _ in range(400):
        found = fuse_sightings(world(rng, count, both_ways, SHIFT, sensor=True, heading=heading))
        assert found is not None
        error = gtsam.Pose2.Logmap(found.pose.between(TRUTH))
        values.append(float(error @ np.linalg.solve(found.covariance, error)))
    assert np.mean(values) / 3.0 == pytest.approx(1.0, abs=0.15)
    assert kstest(values, chi2(3).cdf).pvalue > 1e-3


def test_sensor_noise_averages_and_the_anchors_do_not(rng: np.random.Generator) -> None:
    (one,) = world(rng, 1, False, SHIFT, sensor=False, heading=True)
    bare = (UncertainPose(anchor.pose, NOTHING) for anchor in (one.observer, one.observed))
    single, many = fuse_sightings([one]), fuse_sightings([one] * 1000)
    sensor = fuse_sightings([AnchoredSighting(one.sighting, BLUE, RED, *bare)])
    assert single is not None
    assert many is not None
    assert sensor is not None
    np.testing.assert_allclose(single.covariance - many.covariance, 0.999 * sensor.covariance, rtol=1e-3, atol=1e-8)


def test_does_not_depend_on_who_saw_whom_first(rng: np.random.Generator) -> None:
    sightings = world(rng, 6, True, SHIFT, sensor=True, heading=False)
    first, last = fuse_sightings(sightings), fuse_sightings(sightings[::-1])
    assert first is not None
    assert last is not None
    assert first.pose.equals(last.pose, 1e-8)
    np.testing.assert_allclose(first.covariance, last.covariance, rtol=1e-6)


def test_exchanging_names_gives_the_inverse(rng: np.random.Generator) -> None:
    """With other names the other vertex is the tail: the same estimate seen from the other side."""
    name = {BLUE: VertexId("zoe", 0), RED: RED}
    for heading in (True, False):
        sightings = world(rng, 6, True, SHIFT, sensor=True, heading=heading)
        renamed = [
            AnchoredSighting(s.sighting, name[s.observer_vertex], name[s.observed_vertex], s.observer, s.observed)
            for s in sightings
        ]
        found, other = fuse_sightings(sightings), fuse_sightings(renamed)
        assert found is not None
        assert other is not None
        assert other.pose.equals(found.pose.inverse(), 1e-7)
        np.testing.assert_allclose(
            other.covariance, adjoint_transport(found.pose, found.covariance), rtol=1e-5, atol=1e-9
        )


def test_what_is_not_seen_gives_nothing(rng: np.random.Generator) -> None:
    sightings = world(rng, 4, False, SHIFT, sensor=True, heading=False)
    assert fuse_sightings(sightings[:1]) is None
    assert fuse_sightings(sightings[:1] * 5) is None
    # Two points 2 cm apart do not tell a heading either.
    near = world(rng, 1, False, NOTHING, sensor=False, heading=False)[0]
    moved = near.observed.pose.compose(gtsam.Pose2(0.02, 0.0, 0.0))
    again = AnchoredSighting(near.sighting, BLUE, RED, near.observer, UncertainPose(moved, NOTHING))
    assert fuse_sightings([near, again]) is None
    assert fusing_edge(EdgeId("blue", 0), 0, sightings[:1]) is None


def test_at_next_to_no_range(rng: np.random.Generator) -> None:
    """Bumper to bumper bearings say little, and the edge knows it."""
    exact = UncertainPose(gtsam.Pose2(), NOTHING)
    errors = []
    for _ in range(500):
        truth = gtsam.Pose2(0.02, 0.01, -3.1)
        r, b, h = rng.normal([np.hypot(0.02, 0.01), np.arctan2(0.01, 0.02), -3.1], [0.002, 0.02, 0.05])
        found = fuse_sightings(
            [AnchoredSighting(Sighting(max(r, 1e-6), b, h, 0.002, 0.02, 0.05), BLUE, RED, exact, exact)]
        )
        assert found is not None
        error = gtsam.Pose2.Logmap(found.pose.between(truth))
        errors.append(float(error @ np.linalg.solve(found.covariance, error)))
    assert np.mean(errors) / 3.0 == pytest.approx(1.0, abs=0.2)


def test_edge_and_refusals(rng: np.random.Generator) -> None:
    sightings = world(rng, 3, True, SHIFT, sensor=True, heading=True)
    edge, estimate = fusing_edge(EdgeId("blue", 7), 2, sightings), fuse_sightings(sightings)
    assert edge is not None
    assert estimate is not None
    assert str(edge) == "edge blue#7 version 2 (fusing blue:3 -> red:1)"
    assert edge.measurement.equals(estimate.pose, 0.0)
    with pytest.raises(FactorError, match="same two vertices, not no"):
        fuse_sightings([])
    s = sightings[0]
    stray = AnchoredSighting(s.sighting, BLUE, VertexId("red", 2), s.observer, s.observed)
    with pytest.raises(FactorError, match="not blue:3, red:1, red:2"):
        fuse_sightings([s, stray])
