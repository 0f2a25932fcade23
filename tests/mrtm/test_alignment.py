"""Two maps of a made-up room: alignment must find how they lie, say how sure it is, and refuse what is wrong."""

import ctypes
import subprocess
import sys
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from factors import UncertainPose
from frontend import se2
from frontend.local_map import Bends
from frontend.records import FloatArray
from mrtm.joint.alignment.align import Alignment, align
from mrtm.joint.alignment.buckets import Buckets
from mrtm.joint.alignment.correlative import hypotheses
from mrtm.joint.alignment.fit import FLOOR, fit
from mrtm.joint.alignment.icp import COARSE, FINE, SCALE, icp
from mrtm.joint.alignment.surface import Surface, partners, rotation
from mrtm.robot.poses import array_of, pose_of
from tests.mrtm.wall_maps import Wall, seen, unknown

# A room of 12 m x 8 m that looks alike from nowhere; free space is to the left of each wall.
ROOM: list[Wall] = [
    (0, 0, 12, 0), (12, 0, 12, 8), (12, 8, 7, 8), (7, 8, 7, 6), (7, 6, 5.5, 6), (5.5, 6, 5.5, 8), (5.5, 8, 0, 8),
    (0, 8, 0, 0), (2, 2, 2, 3), (2, 3, 3.2, 3), (3.2, 3, 3.2, 2), (3.2, 2, 2, 2),
]  # fmt: skip
CORRIDOR: list[Wall] = [(0, 0, 30, 0), (30, 2, 0, 2)]
TRUE = np.array([1.5, -2.0, 0.8])


A = np.array([4.0, 4.0, 0.3])
B = se2.compose(A, TRUE)
ROUNDS = *COARSE, FINE


@pytest.fixture(scope="module")
def room() -> tuple[Surface, Surface]:
    """Two maps of most of ROOM, b at TRUE in a."""
    return seen(ROOM, A, -1.0, 10.0, 1), seen(ROOM, B, 1.0, 13.0, 2)


def guess(sigma: tuple[float, float, float], off: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> UncertainPose:
    return UncertainPose(pose_of(se2.compose(TRUE, np.array(off))), np.diag(np.square(sigma)))


def error(alignment: Alignment) -> FloatArray:
    return se2.log(se2.between(TRUE, array_of(alignment.estimate.pose)))


def test_partners_face_alike() -> None:
    # Two sides of a wall 4 cm thick: the nearest point is on the back.
    front, back = (
        seen([(0, 0, 6, 0), (6, 3, 0, 3)], np.zeros(3), -1, 7, 1),
        seen([(6, -0.04, 0, -0.04), (0, -3, 6, -3)], np.zeros(3), -1, 7, 2),
    )
    assert len(partners(front, back, np.zeros(3), 0.3)[1]) == 0
    in_a, in_b = partners(front, front, np.array([0.02, 0.01, 0.0]), 0.3)
    assert len(in_b) > 200
    assert (np.einsum("ni,ni->n", front.normals[in_a], front.normals[in_b]) > 0.99).all()


@pytest.mark.parametrize("off", [(0.25, 0.2, 0.1), (-0.3, 0.1, -0.1)])
def test_icp_moves_a_map_onto_another(room: tuple[Surface, Surface], off: tuple[float, float, float]) -> None:
    pose = icp(*room, se2.compose(TRUE, np.array(off)), ROUNDS)
    assert pose is not None  # an Open3D that aligned nothing would return the guess
    assert (np.abs(se2.between(TRUE, pose)) < (0.005, 0.005, 0.001)).all()


def test_icp_comes_to_the_same_every_time() -> None:
    """Along a corridor too, where the order in which threads add up moved it by decimetres."""
    frames = np.array([10.0, 1.0, 0.1]), np.array([14.0, 1.0, -0.1])
    a, b = seen(CORRIDOR, frames[0], 0.0, 16.0, 1), seen(CORRIDOR, frames[1], 6.0, 22.0, 2)
    offsets = np.random.default_rng(0).uniform([-0.4, -0.4, -0.1], [0.4, 0.4, 0.1], (15, 3))
    for start in se2.compose(se2.between(*frames), offsets):
        assert len({str(icp(a, b, start, ROUNDS)) for _ in range(15)}) == 1


def test_icp_of_maps_that_do_not_meet(room: tuple[Surface, Surface]) -> None:
    assert icp(*room, np.array([100.0, 0.0, 0.0]), ROUNDS) is None


def test_search_finds_a_place_far_from_the_guess(room: tuple[Surface, Surface]) -> None:
    start = se2.compose(TRUE, np.array([2.0, -1.7, 0.25]))
    found = hypotheses(*room, start, np.diag([1.0, 1.0, 0.15**2]))
    off = np.abs(se2.between(TRUE, found[0]))
    assert np.hypot(*off[:2]) < 0.35
    assert off[2] < 0.08


@pytest.mark.parametrize(("sigma", "off"), [((0.1, 0.1, 0.02), (0.1, -0.1, 0.02)), ((1.0, 1.0, 0.2), (1.4, -1.2, 0.3))])
def test_overlapping_maps_are_aligned(
    room: tuple[Surface, Surface], sigma: tuple[float, float, float], off: tuple[float, float, float]
) -> None:
    alignment = align(*room, guess(sigma, off))
    assert alignment is not None
    assert alignment.refusal is None
    assert np.hypot(*error(alignment)[:2]) < 0.01
    assert alignment.residual < 0.02
    assert alignment.agreement.hits > 0.9
    assert (np.sqrt(np.diag(alignment.estimate.covariance)) < (0.03, 0.03, 0.005)).all()


def test_the_direction_along_a_corridor_stays_the_guess() -> None:
    a, b = seen(CORRIDOR, A, 0.0, 25.0, 1), seen(CORRIDOR, B, 5.0, 30.0, 2)
    given = guess((0.3, 0.3, 0.05), (0.2, 0.15, 0.03))
    alignment = align(a, b, given)
    assert alignment is not None
    c, s = np.cos(B[2]), np.sin(B[2])
    along, across = np.array([c, -s, 0.0]), np.array([s, c, 0.0])  # of the corridor, in the frame of b
    covariance = alignment.estimate.covariance
    assert along @ covariance @ along > 4.0 * (along @ given.covariance @ along)
    assert across @ covariance @ across < 0.03**2
    moved = gtsam.Pose2.Logmap(given.pose.between(alignment.estimate.pose))
    # Turning the guess back moves b's origin along as well, by the third part of what the turn carries.
    assert abs(along @ moved) < 0.06
    assert abs(across @ error(alignment)) < 0.02


def test_information_does_not_count_points_that_share_an_error(room: tuple[Surface, Surface]) -> None:
    a, b = room
    rng = np.random.default_rng(0)
    independent = fit(a, b, TRUE)
    # The same walls, but each stretch of a metre off by a centimetre as a whole.
    bent = b.points + 0.012 * rng.standard_normal(40)[np.abs(b.points.sum(axis=1)).astype(int)][:, None] * b.normals
    common = fit(a, Surface(Buckets.of(bent, b.normals), b.lookup), TRUE)
    assert common.residual < 2.0 * independent.residual
    assert np.trace(common.information) < 0.5 * np.trace(independent.information)


def test_a_map_that_is_unsure_of_its_parts_makes_the_alignment_so_there(room: tuple[Surface, Surface]) -> None:
    a, b = room
    firm = fit(a, b, TRUE)
    assert np.array_equal(firm.drift, np.diag([FLOOR, FLOOR, 0.0]) ** 2)
    here = b.points[partners(a, b, TRUE, 0.15)[1]].mean(axis=0)
    sure, slipped = np.diag([0.01, 0.01, 0.001]) ** 2, np.diag([0.2, 0.01, 0.001]) ** 2
    for near, far, expected in ((slipped, sure, slipped), (sure, slipped, sure)):
        bends = Bends(np.array([here, here + 40.0]), np.array([near, far]))
        found = fit(a, replace(b, bends=bends), TRUE)
        np.testing.assert_allclose(found.drift - firm.drift, expected, rtol=0.05, atol=1e-6)
        assert [len(shares) for shares in found.shares] == [0, 2]
        assert found.shares[1][0] > 0.95  # what was compared was drawn from about there
        turned = fit(replace(b, bends=bends), a, se2.inverse(TRUE))  # in the frame of the other
        back = pose_of(TRUE).AdjointMap()
        np.testing.assert_allclose(turned.drift - firm.drift, back @ expected @ back.T, rtol=0.1, atol=1e-5)


def test_rooms_that_look_alike_are_refused() -> None:
    # One bay out of five equal ones against all of them: nothing tells which.
    bays = [wall for i in range(5) for wall in
            ((3.0 * i, 0, 3.0 * i + 2, 0), (3.0 * i + 2, 0, 3.0 * i + 2, -1.5), (3.0 * i + 2, -1.5, 3.0 * i + 3, -1.5),
             (3.0 * i + 3, -1.5, 3.0 * i + 3, 0))]  # fmt: skip
    walls = [*bays, (15.0, 4.0, 0.0, 4.0)]
    a, b = seen(walls, A, 0.0, 15.0, 1), seen(walls, B, 4.0, 10.5, 2)
    wide = align(a, b, guess((1.2, 1.2, 0.05)))
    assert wide is not None
    assert "another place fits" in (wide.refusal or "")
    assert wide.rival > 0.85
    narrow = align(a, b, guess((0.1, 0.1, 0.02)))
    assert narrow is not None
    assert narrow.accepted  # who knows better where he is may use it


def test_another_room_is_refused(room: tuple[Surface, Surface]) -> None:
    other = [(x0 * 0.7, y0 * 1.2, x1 * 0.7, y1 * 1.2) for x0, y0, x1, y1 in ROOM[:8]]
    alignment = align(room[0], seen(other, B, 0.0, 9.0, 3), guess((0.3, 0.3, 0.05)))
    assert alignment is None or not alignment.accepted


def test_a_guess_that_is_wrong_is_not_followed(room: tuple[Surface, Surface]) -> None:
    alignment = align(*room, guess((0.02, 0.02, 0.005), (0.25, 0.0, 0.0)))
    assert alignment is not None
    assert "from the guess" in (alignment.refusal or "")


def test_empty_maps() -> None:
    assert align(unknown(), unknown(), guess((0.1, 0.1, 0.02))) is None


@pytest.mark.parametrize("off", [(0.1, -0.08, 0.02), (-0.05, 0.1, -0.03)])
def test_icp_comes_to_where_open3d_does(room: tuple[Surface, Surface], off: tuple[float, float, float]) -> None:
    """An independent one: the same least squares on the same points, but partners whichever way they face."""
    registration = open3d().pipelines.registration
    a, b = room
    start = se2.compose(TRUE, np.array(off))
    mine = icp(a, b, start, ROUNDS)
    assert mine is not None
    _, in_b = partners(a, b, start, 0.15)
    transform = np.eye(4)
    transform[:2, :2], transform[:2, 3] = rotation(start[2]), start[:2]
    estimation = registration.TransformationEstimationPointToPlane(registration.GMLoss(SCALE**2))
    done = registration.ICPConvergenceCriteria(1e-9, 1e-9, 50)
    clouds = cloud(b.points[in_b], b.normals[in_b]), cloud(a.points, a.normals)
    theirs = registration.registration_icp(*clouds, 0.15, transform, estimation, done).transformation
    found = np.array([theirs[0, 3], theirs[1, 3], np.arctan2(theirs[1, 0], theirs[0, 0])])
    assert np.abs(se2.between(start, mine)).max() > 0.05
    assert (np.abs(se2.between(found, mine)) < (0.001, 0.001, 0.0003)).all()


def open3d() -> Any:
    """Its wheel needs libusb (for cameras), which another wheel brings."""
    libusb = pytest.importorskip("libusb_package")
    ctypes.CDLL(str(libusb.get_library_path()), ctypes.RTLD_GLOBAL)
    return pytest.importorskip("open3d")


def cloud(points: FloatArray, normals: FloatArray) -> Any:
    """The normals are ours, in the plane: Open3D's own of a flat cloud point out of it, and align nothing."""
    found = open3d().geometry.PointCloud()
    flat = np.zeros(len(points))
    found.points = open3d().utility.Vector3dVector(np.column_stack([points, flat]))
    found.normals = open3d().utility.Vector3dVector(np.column_stack([normals, flat]))
    return found


KERNELS_OF_ALIGNMENT = """
from mrtm.joint.alignment import agreement, candidates, correlative, icp, surface, warm_up
kernels = [agreement._count, agreement._known, agreement._sort, candidates._near, correlative._draw, correlative._score,
           icp._round, surface._partners]
assert not any(kernel.signatures for kernel in kernels)
warm_up.warm_up()
assert all(kernel.signatures for kernel in kernels), [kernel for kernel in kernels if not kernel.signatures]
"""


@pytest.mark.slow
def test_after_warming_up_all_kernels_are_there() -> None:
    """In a process of their own: other tests have them read."""
    subprocess.run([sys.executable, "-c", KERNELS_OF_ALIGNMENT], check=True)
