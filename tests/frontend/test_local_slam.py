"""Whole visits: accurate, the same whatever the number of threads, and not upset by bad scans or the map's border."""

import math
from collections.abc import Iterator

import numba
import numpy as np
import pytest

from frontend import se2
from frontend.grid import Maps, in_rows
from frontend.local_slam import SOFTNESS, SPREAD, LocalSlam, Visit
from frontend.parameters import FilterParameters
from frontend.points import Points, points_of
from frontend.records import FloatArray
from tests.frontend.simulated import PARAMETERS, ROOM, drawn, drive, insert, look, room, scan_of
from tools.simulation import LaserModel

STILL = np.zeros((PARAMETERS.particles, 3))


def visited(
    scans: slice, seed: int = 0, parameters: FilterParameters = PARAMETERS
) -> tuple[LocalSlam, Visit, FloatArray]:
    """The filter after a part of the drive, what it leaves, and the true poses seen from the first."""
    log, points, increments = drive()
    slam = LocalSlam(parameters, seed)
    slam.begin(points[scans][0], np.zeros((parameters.particles, 3)))
    for scan, increment in zip(points[scans][1:], increments[scans][1:], strict=True):
        slam.add(scan, increment)
    return slam, slam.finish(), se2.between(log.poses[scans][0], log.poses[scans])


def same_bits(a: Visit, b: Visit) -> bool:
    arrays = [(v.poses, v.covariances, v.maps.log_odds, v.maps.index, v.maps.surfels, v.maps.counts) for v in (a, b)]
    return all(x.tobytes() == y.tobytes() for x, y in zip(*arrays, strict=True))


@pytest.fixture
def threads() -> Iterator[int]:
    """The largest number of threads, 2 at least; put back afterwards."""
    most = numba.get_num_threads()
    if most < 2:
        pytest.skip("numba has one thread only")
    yield most
    numba.set_num_threads(most)


def test_a_seed_gives_one_result_for_any_number_of_threads(threads: int) -> None:
    results = []
    for count in (1, 2, threads):
        numba.set_num_threads(count)
        slam, visit, _ = visited(slice(0, 60), seed=11)
        results.append((slam.filter.paths().tobytes(), slam.filter.maps.log_odds.tobytes(), visit))
    for paths, maps, visit in results[1:]:
        assert paths == results[0][0]
        assert maps == results[0][1]
        assert same_bits(visit, results[0][2])
    assert not same_bits(results[0][2], visited(slice(0, 60), seed=12)[1])


def test_a_visit_is_accurate_and_knows_how_much() -> None:
    slam, visit, true = visited(slice(0, 110))
    off = se2.between(true, visit.poses)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.04
    assert np.abs(off[:, 2]).max() < math.radians(1.0)
    last = se2.log(off[-1])
    assert last @ np.linalg.inv(visit.covariances[-1]) @ last < 16.3  # 0.999 of chi2, 3 degrees of freedom
    assert np.sqrt(visit.covariances[-1, 0, 0]) < 0.1
    np.testing.assert_array_equal(visit.poses[0], 0.0)
    assert len(visit.poses) == 110
    assert 0 < visit.since_resampling < slam.filter.paths().shape[0]


def test_localising_first_and_mapping_later() -> None:
    """Re-entry on trial: the known map stays as it is until the visit is settled, then holds the whole of it."""
    known = room()[2]
    log, points, increments = drive()
    slam = LocalSlam(PARAMETERS, 0)
    slam.begin(points[0], np.tile(log.poses[0], (PARAMETERS.particles, 1)), known, mapping=False)
    for scan, increment in zip(points[1:40], increments[1:40], strict=True):
        slam.add(scan, increment)
    for p in range(PARAMETERS.particles):
        np.testing.assert_array_equal(slam.filter.maps.log_odds[p], known.log_odds[0])
    off = se2.between(log.poses[:40], slam.path())
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.05
    slam.settle()
    expected, leader = Maps.empty(1, PARAMETERS.map_width, PARAMETERS.resolution), slam.filter.leader
    expected.copy_from(known, np.zeros(1, np.int64))
    for pose in slam.filter.paths()[:, leader]:
        (key_scan,) = np.flatnonzero((slam.path() == pose).all(axis=1))
        insert(expected, points[key_scan], pose)
    np.testing.assert_array_equal(slam.filter.maps.log_odds[leader], expected.log_odds[0])
    visit = slam.finish()
    assert np.hypot(*se2.between(log.poses[:40], visit.poses)[:, :2].T).max() < 0.04


def test_a_submap_is_what_several_scans_saw() -> None:
    log, points, increments = drive()
    slam = LocalSlam(PARAMETERS, 0)
    slam.begin(points[0], STILL)
    for scan, increment in zip(points[1:50], increments[1:50], strict=True):
        slam.add(scan, increment)
    submap = slam.submap(5)
    assert len(submap.hits) == sum(len(points[i].hits) for i in (0, 12, 24, 36, 49))
    # Seen from the present pose: the walls of the room.
    walls = drawn(look(ROOM, log.poses[:50]), se2.between(log.poses[49], log.poses[:50]))
    index = in_rows(walls.index[0])
    cells = (submap.hits[:, :2] / walls.resolution + len(index) / 2).astype(int)
    assert (index[cells[:, 1], cells[:, 0]] > 0).mean() > 0.97
    scans = slam.take_back()
    assert [scan for scan, _ in scans] == points[:50]
    np.testing.assert_array_equal([increment for _, increment in scans[1:]], increments[1:50])


def test_where_odometry_has_the_wrong_sign_the_path_is_right_from_the_first_such_scan_on() -> None:
    log, points, increments = drive()
    wrong = increments.copy()
    wrong[30:60, :2] *= -1.0
    slam = LocalSlam(PARAMETERS, 0)
    slam.begin(points[0], STILL)
    steps = [slam.add(scan, increment) for scan, increment in zip(points[1:60], wrong[1:60], strict=True)]
    (found,) = np.flatnonzero([step.reversed for step in steps])
    assert 30 < found + 1 < 45
    assert len(steps[found].retraced) >= 3
    off = se2.between(se2.between(log.poses[0], log.poses[:60]), slam.path())
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.05
    assert not slam.filter.tracker.forward
    taken_back = slam.take_back()
    np.testing.assert_array_equal([increment for _, increment in taken_back[1:]], wrong[1:60])
    assert slam.filter.tracker.forward  # as at the beginning


MANY = FilterParameters(particles=4000, map_width=1.0)


def test_particles_spread_over_hypotheses_by_their_score() -> None:
    places = np.array([[0.0, 0.0, 0.0], [3.0, 1.0, np.pi], [-3.0, 0.0, 1.0]])
    scores = np.array([0.9, 0.9 - SOFTNESS, 0.9 - 5 * SOFTNESS])
    particles = LocalSlam(MANY, 1).spread(places, scores)
    np.testing.assert_allclose(particles[0], places[0], atol=1e-12)
    offsets = se2.between(places[:, None], particles)
    nearest = np.argmin(np.hypot(offsets[..., 0], offsets[..., 1]), axis=0)
    weights = np.exp([0.0, -1.0, -5.0])
    np.testing.assert_allclose(np.bincount(nearest, minlength=3) / 4000, weights / weights.sum(), atol=0.03)
    around = offsets[nearest, np.arange(4000)]
    np.testing.assert_allclose(around.mean(axis=0), 0.0, atol=0.003)
    np.testing.assert_allclose(np.cov(around.T) / SPREAD.max(), SPREAD / SPREAD.max(), atol=0.1)


def test_particles_have_the_mean_and_covariance_they_were_drawn_from() -> None:
    pose, root = np.array([1.0, -2.0, 3.1]), np.array([[0.2, 0.0, 0.0], [0.1, 0.1, 0.0], [-0.02, 0.01, 0.03]])
    particles = LocalSlam(MANY, 1).particles(pose, root @ root.T)
    np.testing.assert_array_equal(particles[0], pose)
    mean, covariance = se2.mean_and_covariance(particles, np.full(4000, 1 / 4000))
    np.testing.assert_allclose(se2.between(pose, mean), 0.0, atol=0.01)
    np.testing.assert_allclose(covariance, root @ root.T, atol=0.003)
    np.testing.assert_array_equal(particles, LocalSlam(MANY, 1).particles(pose, root @ root.T))


def bad_scan(kind: str, good: Points) -> Points:
    if kind == "one point":
        return Points(good.hits[:1], good.clear[:0], good.sensor)
    if kind == "noise":
        return points_of(scan_of(np.random.default_rng(1).uniform(0.1, 20.0, 180)), 25.0, 181)
    return points_of(scan_of(np.full(180, float(kind))), 25.0, 181)


@pytest.mark.parametrize("kind", ["nan", "inf", "-1", "one point", "noise"])
@pytest.mark.parametrize("first", [0, 15], ids=["from the first scan", "on the way"])
def test_bad_scans_are_survived(kind: str, first: int) -> None:
    log, points, increments = drive()
    scans = [bad_scan(kind, p) if first <= i < first + 4 else p for i, p in enumerate(points[:40])]
    slam = LocalSlam(PARAMETERS, 0)
    slam.begin(scans[0], STILL)
    for scan, increment in zip(scans[1:], increments[1:40], strict=True):
        step = slam.add(scan, increment)
        assert np.isfinite(step.pose).all()
    visit = slam.finish()
    # Seen from a good scan: before the first of them there is odometry only.
    off = se2.between(se2.between(log.poses[10], log.poses[:40]), se2.between(visit.poses[10], visit.poses))
    distances = np.hypot(off[:, 0], off[:, 1])
    assert distances.max() < (0.8 if kind == "noise" else 0.1)
    assert distances[-1] < 0.03
    assert np.linalg.eigvalsh(visit.covariances[-1]).min() > 0


@pytest.mark.parametrize("hits", [0, 1, 180])
def test_a_visit_of_one_scan(hits: int) -> None:
    (points,) = drive()[1][:1]
    slam = LocalSlam(PARAMETERS, 0)
    slam.begin(Points(points.hits[:hits], points.clear, points.sensor), STILL)
    visit = slam.finish()
    np.testing.assert_allclose(visit.poses, np.zeros((1, 3)), atol=1e-12)
    assert np.isfinite(visit.covariances[-1]).all()


@pytest.mark.parametrize("beams", [361, 1080])
def test_other_scanners(beams: int) -> None:
    laser = LaserModel.spanning(math.radians(180 if beams == 361 else 270), beams, 30.0)
    log = drive()[0]
    poses = se2.between(log.poses[0], log.poses[:40])
    points = look(ROOM, log.poses[:40], laser)
    slam = LocalSlam(PARAMETERS, 0)
    slam.begin(points[0], STILL)
    for i in range(1, 40):
        slam.add(points[i], se2.between(poses[i - 1], poses[i]))
    off = se2.between(poses, slam.finish().poses)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.03


def test_a_robot_may_leave_its_map() -> None:
    """Six metres wide: the room's far walls are outside from the start, and in the end so is the robot."""
    slam, visit, true = visited(slice(0, 90), parameters=FilterParameters(particles=4, map_width=6.0))
    assert np.abs(true[:, :2]).max() > 3.2
    assert np.isfinite(visit.poses).all()
    inside = np.abs(true[:, :2]).max(axis=1) < 2.0
    off = se2.between(true, visit.poses)[inside]
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.1
    assert len(slam.path()) == 90
