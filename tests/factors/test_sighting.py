import json
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import chi2, kstest

from factors import (
    AnchoredSighting,
    EdgeId,
    FactorError,
    Sighting,
    SightingEdge,
    UncertainPose,
    VertexId,
    edge_from_dict,
    factor_of,
    has_kernel,
    without_kernel,
)

FloatArray = npt.NDArray[np.float64]

RED, BLUE = VertexId("red", 0), VertexId("blue", 0)
EXACT = UncertainPose(gtsam.Pose2(), np.zeros((3, 3)))


def seen(relative: gtsam.Pose2, sigmas: tuple[float, float], heading: float | None = None) -> Sighting:
    """What a perfect sensor sees of a robot at ``relative``."""
    sigma = None if heading is None else 0.05
    return Sighting(
        np.hypot(relative.x(), relative.y()), np.arctan2(relative.y(), relative.x()), heading, *sigmas, sigma
    )


def anchored(sighting: Sighting, observer: UncertainPose = EXACT, observed: UncertainPose = EXACT) -> AnchoredSighting:
    return AnchoredSighting(sighting, RED, BLUE, observer, observed)


def random_anchor(rng: np.random.Generator, sigma: float) -> UncertainPose:
    pose = gtsam.Pose2(*rng.uniform([-8.0, -8.0, -np.pi], [8.0, 8.0, np.pi]))
    root = rng.normal(0.0, sigma, (3, 3))
    return UncertainPose(pose, root @ root.T)


def test_angles_wrap() -> None:
    sighting = Sighting(1.0, 3.0 * np.pi, -np.pi, 0.1, 0.1, 0.1)
    assert sighting.bearing == pytest.approx(np.pi)
    assert sighting.heading == pytest.approx(np.pi)
    error, _ = Sighting(1.0, 0.0, np.pi - 0.01, 0.1, 0.1, 0.1).residual(gtsam.Pose2(1.0, 0.0, 0.01 - np.pi))
    np.testing.assert_allclose(error, [0.0, 0.0, 0.02], atol=1e-12)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((np.nan, 0.0, 0.0, 0.1, 0.1, 0.1), "range nan is not finite"),
        ((1.0, np.inf, 0.0, 0.1, 0.1, 0.1), "bearing inf is not finite"),
        ((1.0, 0.0, np.nan, 0.1, 0.1, 0.1), "heading nan is not finite"),
        ((0.0, 0.0, 0.0, 0.1, 0.1, 0.1), "range 0.0 is not positive"),
        ((1.0, 0.0, 0.0, -0.1, 0.1, 0.1), "sigma_range -0.1 is not positive"),
        ((1.0, 0.0, 0.0, 0.1, 0.0, 0.1), "sigma_bearing 0.0 is not positive"),
        ((1.0, 0.0, None, 0.1, 0.1, 0.1), "heading None and its sigma 0.1 go together"),
        ((1.0, 0.0, 0.0, 0.1, 0.1, None), "heading 0.0 and its sigma None go together"),
    ],
)
def test_bad_numbers_are_refused(values: Any, message: str) -> None:
    with pytest.raises(FactorError, match=message):
        Sighting(*values)


def test_bad_anchors_and_edges_are_refused() -> None:
    sighting = seen(gtsam.Pose2(2.0, 1.0, 0.0), (0.1, 0.02))
    with pytest.raises(FactorError, match="observed: pose is not finite"):
        anchored(sighting, EXACT, UncertainPose(gtsam.Pose2(np.nan, 0.0, 0.0), np.eye(3)))
    for covariance in (np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan), np.eye(2)):
        with pytest.raises(FactorError, match="sighting, observer: covariance"):
            anchored(sighting, UncertainPose(gtsam.Pose2(), covariance))
    with pytest.raises(FactorError, match="same vertex"):
        SightingEdge(EdgeId("red", 0), 0, AnchoredSighting(sighting, RED, RED, EXACT, EXACT))
    with pytest.raises(FactorError, match="version -1"):
        SightingEdge(EdgeId("red", 0), -1, anchored(sighting))
    with pytest.raises(FactorError, match="has a heading"):
        SightingEdge(EdgeId("red", 0), 0, anchored(seen(gtsam.Pose2(2.0, 1.0, 0.3), (0.1, 0.02), 0.3)))


@pytest.mark.parametrize("distance", [0.05, 1.0, 8.0])
def test_relative_pose_covariance_is_that_of_the_noise(rng: np.random.Generator, distance: float) -> None:
    """Log of true against measured, over 20000 noisy sightings, has the stated covariance, also at next to no range."""
    truth = gtsam.Pose2(distance * np.cos(2.5), distance * np.sin(2.5), -2.0)
    sighting = Sighting(distance, 2.5, -2.0, 0.05, 0.03, 0.05)
    r, b, h = rng.normal([distance, 2.5, -2.0], [0.05, 0.03, 0.05], (20000, 3)).T
    measured = [gtsam.Pose2(*row) for row in np.column_stack([r * np.cos(b), r * np.sin(b), h])]
    logs = np.array([gtsam.Pose2.Logmap(pose.between(truth)) for pose in measured])
    estimate = sighting.relative_pose()
    assert estimate is not None
    assert estimate.pose.equals(truth, 1e-9)
    scale = np.sqrt(np.diag(estimate.covariance))
    np.testing.assert_allclose((np.cov(logs.T) - estimate.covariance) / np.outer(scale, scale), 0.0, atol=0.05)


@pytest.mark.parametrize("heading", [None, 1.1])
def test_residual_derivative_is_the_numerical_one(rng: np.random.Generator, heading: float | None) -> None:
    for _ in range(20):
        sighting = seen(random_anchor(rng, 1.0).pose, (0.1, 0.02), heading)
        one = anchored(sighting, random_anchor(rng, 0.1), random_anchor(rng, 0.1))
        pose = random_anchor(rng, 1.0).pose
        _, by = one.residual(pose)
        columns = []
        for step in 1e-6 * np.eye(3):
            ahead, behind = (one.residual(pose.compose(gtsam.Pose2.Expmap(h)))[0] for h in (step, -step))
            columns.append((ahead - behind) / 2e-6)
        numerical = np.column_stack(columns)
        np.testing.assert_allclose(by, numerical, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("heading", [None, -2.2])
def test_covariance_is_that_of_the_noise(rng: np.random.Generator, heading: float | None) -> None:
    """Noisy sensor and noisy anchors, 20000 times: the residual at the truth has the stated covariance.

    Without a heading the observed robot's position error is bounded by its longest axis: here it is round.
    """
    observer = random_anchor(rng, 0.02)
    observed = UncertainPose(gtsam.Pose2(3.0, -2.0, 1.0), np.diag([0.05, 0.05, 0.03]) ** 2)
    relative = gtsam.Pose2(-1.5, 2.5, -2.2)
    truth = observer.pose.compose(relative).compose(observed.pose.inverse())
    sighting = seen(relative, (0.05, 0.02), heading)
    stated = anchored(sighting, observer, observed).covariance
    errors = []
    for _ in range(6000):
        noisy = Sighting(
            rng.normal(sighting.range, 0.05),
            rng.normal(sighting.bearing, 0.02),
            None if heading is None else rng.normal(heading, 0.05),
            0.05,
            0.02,
            sighting.sigma_heading,
        )
        at = [
            UncertainPose(
                a.pose.compose(gtsam.Pose2.Expmap(rng.multivariate_normal(np.zeros(3), a.covariance))), a.covariance
            )
            for a in (observer, observed)
        ]
        errors.append(anchored(noisy, *at).residual(truth)[0])
    scale = np.sqrt(np.diag(stated))
    np.testing.assert_allclose((np.cov(np.transpose(errors)) - stated) / np.outer(scale, scale), 0.0, atol=0.06)


def test_factor_is_the_edge_and_its_jacobians(rng: np.random.Generator) -> None:
    for _ in range(10):
        sighting = seen(random_anchor(rng, 1.0).pose, (0.1, 0.02))
        edge = SightingEdge(EdgeId("red", 1), 0, anchored(sighting, random_anchor(rng, 0.1), random_anchor(rng, 0.1)))
        factor = without_kernel(factor_of(edge, 11, 7))
        assert list(factor.keys()) == [11, 7]
        values = gtsam.Values()
        values.insert(11, random_anchor(rng, 1.0).pose)
        values.insert(7, random_anchor(rng, 1.0).pose)
        expected, _ = edge.residual(values.atPose2(11).between(values.atPose2(7)))
        np.testing.assert_allclose(factor.unwhitenedError(values), expected, atol=1e-12)

        both = np.empty((2, 6))
        for column, (key, axis) in enumerate((key, axis) for key in (11, 7) for axis in 1e-6 * np.eye(3)):
            errors = []
            for step in (axis, -axis):
                moved = gtsam.Values(values)
                moved.update(key, values.atPose2(key).compose(gtsam.Pose2.Expmap(step)))
                errors.append(factor.unwhitenedError(moved))
            both[:, column] = (errors[0] - errors[1]) / 2e-6
        jacobian, _ = factor.linearize(values).jacobian()  # whitened; columns in the order of the keys
        np.testing.assert_allclose(
            jacobian.T @ jacobian, both.T @ np.linalg.solve(edge.covariance, both), rtol=1e-5, atol=1e-4
        )


def test_kernel_saturates_and_comes_off() -> None:
    edge = SightingEdge(EdgeId("red", 1), 0, anchored(Sighting(4.0, 0.3, None, 0.1, 0.02, None)))
    factor = factor_of(edge, 0, 1)
    assert has_kernel(factor)
    assert not has_kernel(without_kernel(factor))

    def cost(of: gtsam.NoiseModelFactor, sigmas: float) -> float:
        values = gtsam.Values()
        values.insert(0, gtsam.Pose2())
        x, y = ((4.0 + sigmas * 0.1) * np.array([np.cos(0.3), np.sin(0.3)])).tolist()
        values.insert(1, gtsam.Pose2(x, y, 2.0))  # whatever its heading
        return float(of.error(values))

    for sigmas in (0.5, 1.0, 2.4):
        assert cost(factor, sigmas) == pytest.approx(0.5 * sigmas**2, rel=1e-3)
    assert cost(factor, 200.0) < cost(factor, 20.0) * 1.05
    assert cost(without_kernel(factor), 20.0) == pytest.approx(200.0, rel=1e-3)


def test_chi2_of_honest_sightings_has_two_degrees_of_freedom(rng: np.random.Generator) -> None:
    relative = gtsam.Pose2(3.0, -1.0, 0.7)
    exact = seen(relative, (0.08, 0.02))
    values = []
    for r, b in rng.normal([exact.range, exact.bearing], [0.08, 0.02], (4000, 2)):
        edge = SightingEdge(EdgeId("red", 1), 0, anchored(Sighting(r, b, None, 0.08, 0.02, None)))
        error, _ = edge.residual(relative)
        values.append(error @ np.linalg.solve(edge.covariance, error))
    assert kstest(values, chi2(2).cdf).pvalue > 1e-3


def test_two_mutual_sightings_fix_the_pose() -> None:
    """Eq. 9: each of two robots sees the other at a range and bearing; gtsam finds the pose with its heading."""
    truth = gtsam.Pose2(3.0, 1.0, 2.4)
    there, back = (seen(pose, (0.05, 0.02)) for pose in (truth, truth.inverse()))
    edges = [
        SightingEdge(EdgeId("red", 0), 0, anchored(there)),
        SightingEdge(EdgeId("blue", 0), 0, AnchoredSighting(back, BLUE, RED, EXACT, EXACT)),
    ]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    keys = {RED: 0, BLUE: 1}
    graph.push_back(gtsam.PriorFactorPose2(0, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)))
    for edge in edges:
        graph.push_back(without_kernel(factor_of(edge, keys[edge.tail], keys[edge.head])))
    values.insert(0, gtsam.Pose2())
    values.insert(1, gtsam.Pose2(2.0, 2.0, 1.0))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert found.atPose2(1).equals(truth, 1e-4)


def test_edge_goes_through_json(rng: np.random.Generator) -> None:
    sighting = seen(gtsam.Pose2(2.0, 1.0, 0.0), (0.1, 0.02))
    edge = SightingEdge(EdgeId("red", 3), 2, anchored(sighting, random_anchor(rng, 0.1), random_anchor(rng, 0.1)))
    back = edge_from_dict(json.loads(json.dumps(edge.to_dict())))
    assert isinstance(back, SightingEdge)
    assert back.to_dict()["tail"] == ["red", 0]
    assert str(back) == str(edge) == "edge red#3 version 2 (sighting red:0 -> blue:0)"
    pose = gtsam.Pose2(1.0, 2.0, 0.5)
    np.testing.assert_allclose(back.residual(pose)[0], edge.residual(pose)[0], rtol=1e-12)
    np.testing.assert_allclose(back.covariance, edge.covariance, rtol=1e-9)
    faults: list[dict[str, Any]] = [
        {"anchors": []},
        {"sigmas": [0.1]},
        {"range_bearing": [np.nan, 0.0]},
        {"tail": None},
    ]
    for broken in faults:
        with pytest.raises(FactorError):
            edge_from_dict(edge.to_dict() | broken)
