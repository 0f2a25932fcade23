"""Coming back: the candidates of M6, and the verdicts on a trial."""

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import kstest

from factors import UncertainPose, VertexId
from frontend import se2
from frontend.grid import Maps
from frontend.local_slam import LocalSlam
from frontend.parameters import FilterParameters
from frontend.points import Points
from frontend.records import FloatArray
from frontend.tracking import Step
from mrtm.config import TopologyParameters
from mrtm.robot import reentry
from mrtm.robot.poses import array_of, exactly, innovation, pose_of
from mrtm.robot.reentry import Candidate, Trial, candidates
from mrtm.robot.topology import Vertex

HALF = 5.0
NOTHING = Points(np.empty((0, 4), np.float32), np.empty((0, 2), np.float32), np.zeros(2))
SURE = 1e-6 * np.eye(3)
P = TopologyParameters(
    trial_scans=4, trial_distance=2.0, trial_fit=0.7, trial_known=0.55, trial_spread=0.15, trial_lead=0.05
)


def found(
    robot: gtsam.Pose2, places: dict[int, UncertainPose], reach: float = 0.0, covariance: FloatArray = SURE
) -> list[Candidate]:
    """``places``: here_T_vertex by the vertex's index."""
    vertices = [Vertex(VertexId("red", index)) for index in places]
    seen = {vertex.id: places[vertex.id.number] for vertex in vertices}
    return candidates(UncertainPose(robot, covariance), vertices, seen, HALF, reach)


def indices(chosen: list[Candidate]) -> list[int]:
    return [candidate.vertex.id.number for candidate in chosen]


@pytest.mark.parametrize(
    ("x", "y", "inside"), [(0, 0, True), (4.9, 0, True), (4.9, -4.9, True), (5.1, 0, False), (0, -5.1, False)]
)
def test_a_vertex_is_a_candidate_if_the_robot_is_inside_its_square(x: float, y: float, inside: bool) -> None:
    """The square stands in the vertex's frame: corners count, and its heading matters."""
    vertex_T_robot = gtsam.Pose2(x, y, 0.7)
    robot = gtsam.Pose2(6.0, 1.0, -2.0)
    here_T_vertex = robot.compose(vertex_T_robot.inverse())
    chosen = found(robot, {3: UncertainPose(here_T_vertex, SURE)})
    assert indices(chosen) == ([3] if inside else [])
    assert all(candidate.estimate.pose.equals(vertex_T_robot, 1e-9) for candidate in chosen)


def test_the_square_turns_with_the_vertex() -> None:
    robot = gtsam.Pose2(6.0, 0.0, 0.0)
    straight = UncertainPose(gtsam.Pose2(0, 0, 0), SURE)
    turned = UncertainPose(gtsam.Pose2(0, 0, np.pi / 4), SURE)  # the robot is on its diagonal, 7.07 m long
    assert indices(found(robot, {1: straight, 2: turned})) == [2]


def test_no_vertices_no_candidates() -> None:
    assert found(gtsam.Pose2(), {}) == []


def test_an_uncertain_pose_may_lie_outside_by_reach_deviations_but_not_by_more_than_a_quarter_of_the_square() -> None:
    wide, wider = np.diag([0.5**2, 0.1**2, 1e-6]), np.diag([9.0**2, 0.1**2, 1e-6])
    for distance, covariance, reach, inside in (
        (5.9, wide, 2.0, True),
        (6.1, wide, 2.0, False),
        (5.9, wide, 0.0, False),
        (7.4, wider, 2.0, True),
        (7.6, wider, 2.0, False),
    ):
        place = {1: UncertainPose(gtsam.Pose2(-distance, 0, 0), covariance)}
        assert bool(found(gtsam.Pose2(), place, reach)) is inside, (distance, reach)


def test_the_covariance_is_projected_by_hand() -> None:
    """vertex_T_robot from both uncertain poses, in the robot's frame, against Monte Carlo."""
    rng = np.random.default_rng(8)
    here_T_vertex = UncertainPose(gtsam.Pose2(2.0, -1.0, 2.5), np.diag([0.03, 0.01, 0.02]) ** 2)
    robot = UncertainPose(gtsam.Pose2(4.0, 1.0, -0.5), np.diag([0.02, 0.04, 0.01]) ** 2)
    vertex = Vertex(VertexId("red", 0))
    (candidate,) = candidates(robot, [vertex], {vertex.id: here_T_vertex}, HALF, 0.0)
    noise = [rng.multivariate_normal(np.zeros(3), uncertain.covariance, 5000) for uncertain in (here_T_vertex, robot)]
    tangents = []
    for x, y in zip(*noise, strict=True):
        moved = here_T_vertex.pose.compose(gtsam.Pose2.Expmap(x))
        there = moved.between(robot.pose.compose(gtsam.Pose2.Expmap(y)))
        tangents.append(gtsam.Pose2.Logmap(candidate.estimate.pose.between(there)))
    whitened = np.linalg.solve(
        np.linalg.cholesky(candidate.estimate.covariance), np.linalg.cholesky(np.cov(np.array(tangents).T))
    )
    np.testing.assert_allclose(whitened @ whitened.T, np.eye(3), atol=0.12)


def test_the_best_candidate_has_the_least_determinant() -> None:
    """M6b: not the nearest, and not the first."""
    places = {
        1: UncertainPose(gtsam.Pose2(0.1, 0, 0), np.diag([0.3, 0.3, 0.1]) ** 2),
        2: UncertainPose(gtsam.Pose2(4.0, 0, 0), np.diag([0.05, 0.05, 0.02]) ** 2),
        3: UncertainPose(gtsam.Pose2(1.0, 0, 0), np.diag([0.1, 0.1, 0.05]) ** 2),
        4: UncertainPose(gtsam.Pose2(20.0, 0, 0), np.diag([0.01, 0.01, 0.01]) ** 2),
    }
    chosen = found(gtsam.Pose2(), places, covariance=1e-8 * np.eye(3))
    assert indices(chosen) == [2, 3, 1]
    determinants = [np.linalg.det(c.estimate.covariance) for c in chosen]
    assert determinants == sorted(determinants)


class Slam:
    """Stands for the filter that localises in the old map: it has driven 3 m straight on, as sure as it is told.

    Attributes:
        start: poses at which it was made to begin again.
    """

    parameters = FilterParameters(particles=1)

    def __init__(self, metres: float) -> None:
        self.sigma = metres
        self.start: list[FloatArray] = []

    def covariance(self) -> FloatArray:
        """Unsure along a direction that is no axis."""
        root = gtsam.Rot2(0.6).matrix() @ np.diag([self.sigma, 0.01])
        covariance = np.diag([0.0, 0.0, 1e-4])
        covariance[:2, :2] = root @ root.T
        return covariance

    def entrance(self) -> tuple[FloatArray, FloatArray]:
        return self.path()[0], self.covariance()

    def path(self) -> FloatArray:
        return np.column_stack([np.linspace(1.0, 4.0, 11), np.zeros((11, 2))])

    def submap(self, count: int) -> None:
        assert count > 1

    def take_back(self) -> list[tuple[None, FloatArray]]:
        return [(None, increment) for increment in np.vstack([np.zeros((1, 3)), np.tile([0.3, 0.0, 0.0], (10, 1))])]

    def particles(self, pose: FloatArray, covariance: FloatArray) -> FloatArray:
        assert covariance.shape == (3, 3)
        return pose[None]

    def begin(self, points: None, poses: FloatArray, known: Maps, *, mapping: bool) -> None:
        assert not mapping  # a map on trial stays as it is
        self.start.append(poses[0])

    def add(self, points: None, increment: FloatArray) -> Step:
        return Step(np.zeros(3), 0.9, 0.9, -10.0, np.eye(3), NOTHING)


def trial(fits: list[float], knowns: list[float] | float = 0.9, metres: float = 0.3) -> Trial:
    vertex = Vertex(VertexId("red", 0), Maps.empty(1, 2.0, 0.1))
    projected = UncertainPose(gtsam.Pose2(1.0, 0.0, 0.0), np.diag([0.1, 0.1, 0.05]) ** 2)
    result = Trial(Candidate(vertex, projected), UncertainPose(gtsam.Pose2(), SURE), 0, resume=False)
    for fit, known in zip(fits, knowns if isinstance(knowns, list) else [knowns] * len(fits), strict=True):
        result.add(Step(np.zeros(3), fit, known, -10.0, np.eye(3), NOTHING), np.array([metres, 0.0, 0.0]))
    return result


def verdict(
    t: Trial, sigma: float = 0.01, p: TopologyParameters = P, *, leaving: bool = False
) -> tuple[bool | None, str]:
    """The particles' standard deviation is ``sigma`` metres."""
    return t.verdict(cast(LocalSlam, Slam(sigma)), p, leaving)


@pytest.fixture(autouse=True)
def fits_at(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Where in the old map the stretch fits, and how well; unless told, where the particles are and nowhere else."""

    def fits(*places: tuple[float, float, float, float]) -> None:
        found = np.array([place[:3] for place in places]).reshape(-1, 3), np.array([place[3] for place in places])
        monkeypatch.setattr(reentry, "hypotheses", lambda *_: found)

    fits((4.0, 0.0, 0.0, 0.9))
    return fits


def test_a_trial_adds_up_what_it_saw() -> None:
    t = trial([0.9, 0.8], [0.7, 0.6], 0.5)
    assert (t.fits, t.knowns) == ([0.9, 0.8], [0.7, 0.6])
    assert t.distance == pytest.approx(1.0)
    before = t.distance
    t.add(Step(np.zeros(3), 0.9, 0.9, -10.0, np.eye(3), NOTHING), np.array([0.0, 0.0, -1.0]))
    assert t.distance > before  # turning on the spot shows a place, too


def test_a_trial_waits_for_scans_and_way() -> None:
    assert verdict(trial([]))[0] is None
    assert verdict(trial([0.95] * 3, metres=5.0))[0] is None  # far, but few scans
    assert verdict(trial([0.95] * 10, metres=0.1))[0] is None  # many, but not far
    assert verdict(trial([0.0] * 3))[0] is None  # too early to refuse as well


def test_a_good_stretch_is_accepted_with_its_numbers() -> None:
    for leaving in (False, True):
        accepted, reason = verdict(trial([0.95] * 10), 0.05, leaving=leaving)
        assert accepted is True
        assert "0.95" in reason
        assert "3.0 m" in reason


def test_a_clear_misfit_is_refused_at_once() -> None:
    accepted, reason = verdict(trial([0.3] * 5, metres=0.01))
    assert accepted is False
    assert "does not fit the old map" in reason
    assert "0.30" in reason


def waits_until_the_limit(t: Trial, sigma: float = 0.01) -> str:
    """Waits as long as it may, refuses when it must; the reason."""
    assert verdict(t, sigma)[0] is None
    assert verdict(t, sigma, leaving=True)[0] is False
    fit, known, driven = t.fits[-1], t.knowns[-1], 0.0
    while (outcome := verdict(t, sigma))[0] is None:
        t.add(Step(np.zeros(3), fit, known, -10.0, np.eye(3), NOTHING), np.array([0.4, 0.0, 0.0]))
        driven += 0.4
        assert driven < 10.0 * P.trial_distance, "never comes to a verdict"
    assert driven > 0.0
    assert outcome[0] is False
    return outcome[1]


@pytest.mark.parametrize("metres", [0.0, 0.25])
def test_a_mediocre_fit_waits_until_it_must_decide(metres: float) -> None:
    """Between the bar and clearly below it."""
    assert "0.60" in waits_until_the_limit(trial([0.6] * 12, metres=metres))


def test_particles_that_disagree_are_waited_for_and_then_refused() -> None:
    assert "0.50 m" in waits_until_the_limit(trial([0.95] * 10), sigma=0.5)


def test_a_stretch_mostly_beyond_the_old_map_is_not_enough() -> None:
    """What there is fits, but there is little of it."""
    assert "0.30" in waits_until_the_limit(trial([0.95] * 10, 0.3))


def test_the_end_counts_as_much_as_the_whole() -> None:
    """A robot that drifts off the old map fits well at first; one that fits badly at first was not there."""
    for t in (
        trial([0.95] * 26 + [0.2] * 4),
        trial([0.1] * 26 + [0.95] * 4),
        trial([0.95] * 30, [0.9] * 26 + [0.1] * 4),
    ):
        assert verdict(t, leaving=True)[0] is False


def test_leaving_before_there_is_enough_to_tell_is_refused_but_not_as_a_misfit() -> None:
    for t in (trial([0.99] * 3), trial([0.99] * 10, metres=0.1)):
        accepted, reason = verdict(t, leaving=True)
        assert accepted is False
        assert reason
        assert "does not fit" not in reason


def test_a_stretch_that_fits_two_places_is_not_accepted(fits_at: Callable[..., None]) -> None:
    fits_at((4.0, 0.0, 0.0, 0.9), (2.0, 0.0, 0.0, 0.88))
    assert verdict(trial([0.95] * 10))[0] is None
    accepted, reason = verdict(trial([0.95] * 10), leaving=True)
    assert accepted is False
    assert "elsewhere" in reason
    fits_at((4.0, 0.0, 0.0, 0.9), (2.0, 0.0, 0.0, 0.5))
    assert verdict(trial([0.95] * 10))[0] is True
    fits_at((4.0, 0.0, 0.0, 0.9), (4.1, 0.0, 0.0, 0.89))  # so near that it is the same place
    assert verdict(trial([0.95] * 10))[0] is True


def test_a_stretch_that_fits_nowhere_is_not_accepted(fits_at: Callable[..., None]) -> None:
    fits_at()
    assert verdict(trial([0.95] * 10))[0] is None
    assert verdict(trial([0.95] * 10), leaving=True)[0] is False


def test_a_stretch_that_clearly_fits_elsewhere_is_taken_again_from_there(fits_at: Callable[..., None]) -> None:
    fits_at((4.0, 2.0, 0.3, 0.9), (4.0, 0.0, 0.0, 0.5))
    t, slam = trial([0.95] * 20), Slam(0.01)
    assert t.verdict(cast(LocalSlam, slam), P, leaving=False)[0] is None
    (start,) = slam.start
    np.testing.assert_allclose(se2.compose(start, np.array([3.0, 0.0, 0.0])), [4.0, 2.0, 0.3], atol=1e-9)
    assert t.fits == [0.9] * 10  # what the new start saw, and only that
    assert t.distance == pytest.approx(3.0)


def test_a_reentry_that_contradicts_the_joint_map_is_refused(fits_at: Callable[..., None]) -> None:
    """It fits, but a metre from where the joint map, sure to 10 cm, has the robot: chi2 near 100."""
    fits_at((4.0, 0.0, 0.0, 0.9), (6.0, 2.0, 0.0, 0.8))
    t = trial([0.95] * 10)
    far = UncertainPose(gtsam.Pose2(1.0, 1.0, 0.0), np.diag([0.1, 0.1, 0.05]) ** 2)
    t.candidate = Candidate(t.candidate.vertex, far)
    accepted, reason = verdict(t)
    assert accepted is False
    assert "contradicts the joint map" in reason
    t.candidate = Candidate(t.candidate.vertex, UncertainPose(far.pose, np.diag([1.0, 1.0, 0.1]) ** 2))
    t.next_check = 0.0
    assert verdict(t)[0] is True  # the same place, less sure


def test_every_verdict_has_a_reason() -> None:
    for fit in (0.2, 0.6, 0.95):
        for sigma in (0.01, 0.5):
            for scans in (1, 4, 8, 40):
                for leaving in (False, True):
                    accepted, reason = verdict(trial([fit] * scans), sigma, leaving=leaving)
                    assert reason or accepted is None, (fit, sigma, scans, leaving)
                    assert not (leaving and accepted is None), (fit, sigma, scans)


def test_stricter_parameters_accept_less() -> None:
    assert verdict(trial([0.8] * 10, 0.6), 0.1, leaving=True)[0] is True
    for stricter in (
        replace(P, trial_fit=0.85),
        replace(P, trial_known=0.7),
        replace(P, trial_spread=0.05),
        replace(P, trial_distance=4.0),
        replace(P, trial_scans=20),
    ):
        assert verdict(trial([0.8] * 10, 0.6), 0.1, stricter, leaving=True)[0] is not True


def test_where_the_trial_began_is_where_the_robot_entered() -> None:
    entered = trial([0.9]).entered(cast(LocalSlam, Slam(0.2)))
    assert entered.pose.equals(gtsam.Pose2(1.0, 0.0, 0.0), 1e-12)
    np.testing.assert_allclose(entered.covariance, Slam(0.2).covariance())


def test_poses_go_to_arrays_and_back() -> None:
    assert pose_of(np.array([1.0, -2.0, 3.0 * np.pi])).equals(gtsam.Pose2(1, -2, np.pi), 1e-9)
    np.testing.assert_allclose(array_of(gtsam.Pose2(1.0, -2.0, 0.5)), [1.0, -2.0, 0.5])
    sure = exactly(np.array([1.0, -2.0, 0.5]))
    assert sure.pose.equals(gtsam.Pose2(1.0, -2.0, 0.5), 1e-12)
    assert not sure.covariance.any()


def test_the_innovation_of_honest_estimates_is_chi2_with_three_degrees_of_freedom() -> None:
    rng = np.random.default_rng(4)
    covariances = np.diag([0.05, 0.02, 0.01]) ** 2, np.diag([0.01, 0.04, 0.02]) ** 2
    true = gtsam.Pose2(3.0, -1.0, 2.0)
    values = []
    for _ in range(2000):
        a, b = (
            UncertainPose(true.compose(gtsam.Pose2.Expmap(rng.multivariate_normal(np.zeros(3), c))), c)
            for c in covariances
        )
        offset, chi2 = innovation(a, b)
        assert a.pose.compose(gtsam.Pose2.Expmap(offset)).equals(b.pose, 1e-9)
        values.append(chi2)
    assert kstest(values, chi2_distribution(3).cdf).pvalue > 1e-3


def test_a_place_where_odometry_would_have_to_lie_is_refused() -> None:
    t = trial([0.95] * 30)
    t.add(Step(np.zeros(3), 0.95, 0.9, -10.0, np.eye(3), NOTHING, reversed=True, forward=False), np.zeros(3))
    assert verdict(t, 0.01) == (False, "odometry would have to lie")
