"""What is left of a local map after it has travelled: a picture as crisp, a cloud that aligns as well, few bytes."""

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial import cKDTree

from frontend.local_map import Grid, LocalMap
from frontend.records import FloatArray
from mrtm.joint.fusion import fuse
from mrtm.team import map_codec
from mrtm.team.checks import RecordError
from mrtm.team.map_codec import ANGLES, STEPS, VALUES, PackedMap, pack_map, unpack_map
from tests.mrtm.record_examples import grid_of, room_map

NOTHING = np.zeros((0, 2))
WALL, FREE = 0.62, -0.62  # what a picture shows as occupied, as free


def packed_room() -> PackedMap:
    room = room_map()
    return pack_map(room.grid, room.cloud, room.normals)


def travelled() -> tuple[Grid, FloatArray, FloatArray]:
    return unpack_map(packed_room(), "room")


def picture(maps: list[tuple[gtsam.Pose2, Grid]]) -> npt.NDArray[np.int64]:
    """1 occupied, -1 free, 0 unknown, of all maps fused; always the same box."""
    none = np.empty((0, 3))
    local = [(p, LocalMap(g, np.empty(0, np.int64), np.empty(0), none, NOTHING, NOTHING)) for p, g in maps]
    fused = fuse(local, box=np.array([[-7.0, -7.0], [7.0, 7.0]])).log_odds
    return (fused > WALL).astype(np.int64) - (fused < FREE)


def test_a_room_takes_few_bytes() -> None:
    """63 square metres in 5 cm cells: 35 kB of int8 log-odds, and 20 kB of float32 points and normals."""
    assert sum(len(column) for column in packed_room()[5:]) < 2500


@pytest.mark.parametrize("second", [False, True])
def test_a_fused_picture_stays_as_crisp(second: bool) -> None:
    """Alone, and with a second map of the room a cell and a degree off: the same walls, none thicker."""
    poses = [gtsam.Pose2(), gtsam.Pose2(0.04, -0.03, 0.02)][: 1 + second]
    before = picture([(pose, room_map().grid) for pose in poses])
    after = picture([(pose, travelled()[0]) for pose in poses])
    walls = np.count_nonzero(before == 1)
    assert walls > 700
    assert np.count_nonzero((before == 1) & (after != 1)) < 0.02 * walls
    assert np.count_nonzero((before != 1) & (after == 1)) < 0.03 * walls
    # What one beam crossed in each of two maps adds up to free; one beam alone is not worth its bytes.
    assert np.count_nonzero((before == -1) != (after == -1)) < 0.04 * np.count_nonzero(before == -1)


def test_log_odds_become_the_nearest_vote() -> None:
    log_odds = np.array([[-5.0, -1.5, -0.8, -0.5, 0.0, 0.1], [0.3, 0.85, 1.3, 1.7, 2.5, 5.0]])
    grid, _, _ = unpack_map(pack_map(grid_of(log_odds), NOTHING, NOTHING), "map")
    np.testing.assert_array_equal(
        grid.log_odds, np.array([[-1.5, -1.5, -1.5, 0, 0, 0], [0.85, 0.85, 0.85, 2, 2, 4]], np.float32)
    )
    assert grid.log_odds.dtype == np.float32


def test_unknown_margins_are_cut_off_and_the_rest_stays_in_place() -> None:
    log_odds = np.zeros((9, 30))
    log_odds[3:5, 10:17] = -2.0
    log_odds[4, 16] = 4.0
    grid, cloud, normals = unpack_map(pack_map(grid_of(log_odds, (-1.0, 2.0)), NOTHING, NOTHING), "map")
    assert grid.log_odds.shape == (2, 7)
    np.testing.assert_allclose(grid.origin, [-1.0 + 10 * 0.05, 2.0 + 3 * 0.05], atol=1e-12)
    np.testing.assert_allclose(cloud, [[-1.0 + 16.5 * 0.05, 2.0 + 4.5 * 0.05]], atol=1e-12)
    np.testing.assert_array_equal(normals, [[0.0, 0.0]])


def test_an_empty_map_is_one_unknown_cell() -> None:
    grid, cloud, normals = unpack_map(pack_map(grid_of(np.zeros((4, 7))), NOTHING, NOTHING), "map")
    assert grid.log_odds.tolist() == [[0.0]]
    assert len(cloud) == len(normals) == 0


def test_points_keep_their_lines_to_half_a_step_and_their_normals_to_half_an_angle() -> None:
    """Of every point in an occupied cell; those in other cells are left out, nothing is invented."""
    room, (grid, cloud, normals) = room_map(), travelled()
    size = grid.resolution
    cells = {tuple(cell) for cell in np.floor((cloud - grid.origin) / size).astype(int).tolist()}
    rows, columns = np.nonzero(grid.log_odds > 0)
    assert cells == set(zip(columns.tolist(), rows.tolist(), strict=True))
    assert len(cells) == len(cloud)

    known = normals.any(axis=1)
    by_cell: dict[tuple[int, ...], list[int]] = {}
    for i, cell in enumerate(np.floor((room.cloud - grid.origin) / size).astype(int).tolist()):
        by_cell.setdefault(tuple(cell), []).append(i)
    assert known.sum() > 500
    for point, normal in zip(cloud[known], normals[known], strict=True):
        # One cell may hold two points of the original; one of them is what has travelled.
        here = by_cell[tuple(np.floor((point - grid.origin) / size).astype(int).tolist())]
        across = np.abs((room.cloud[here] - point) @ normal)
        turned = np.arccos(np.minimum(room.normals[here] @ normal, 1.0))
        assert np.any((across <= 0.5 * size / STEPS + 1e-3 * size) & (turned <= np.pi / ANGLES + 1e-9))


def test_an_alignment_to_the_travelled_cloud_finds_the_same_place() -> None:
    """Point-to-line Gauss-Newton from the original's points to the travelled cloud: within a millimetre of zero."""
    room, (_, cloud, normals) = room_map(), travelled()
    surface = normals.any(axis=1)
    tree = cKDTree(cloud[surface])
    source = room.cloud[room.normals.any(axis=1)]
    pose = np.array([0.06, -0.05, 0.02])
    for _ in range(30):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turned = source @ np.array([[c, s], [-s, c]])
        distance, nearest = np.array(tree.query(turned + pose[:2], distance_upper_bound=0.15))
        near = np.isfinite(distance)
        partner = nearest[near].astype(int)
        n, q, p = normals[surface][partner], cloud[surface][partner], turned[near]
        residual = np.einsum("ij,ij->i", n, p + pose[:2] - q)
        jacobian = np.column_stack([n, n[:, 1] * p[:, 0] - n[:, 0] * p[:, 1]])
        weight = 1.0 / (1.0 + (residual / 0.02) ** 2)
        pose -= np.linalg.solve((jacobian.T * weight) @ jacobian, (jacobian.T * weight) @ residual)
    assert np.abs(pose[:2]).max() < 1e-3
    assert abs(pose[2]) < 5e-4


grids = hnp.arrays(
    np.float32, hnp.array_shapes(min_dims=2, max_dims=2, max_side=13), elements=st.floats(-6, 6, width=32)
)


@settings(max_examples=200)
@given(grids, st.data())
def test_what_has_travelled_once_travels_unchanged(log_odds: npt.NDArray[np.float32], data: st.DataObject) -> None:
    """Whatever the map; a robot that passes it on, or packs what it unpacked, sends the same bytes."""
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    count = data.draw(st.integers(0, 40))
    grid = Grid(log_odds, 0.05, rng.normal(0.0, 3.0, 2))
    cloud = grid.origin + rng.uniform(-0.05, 0.7, (count, 2))
    angle = rng.uniform(-np.pi, np.pi, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle)]) * (rng.random(count) < 0.7)[:, None]
    packed = pack_map(grid, cloud, normals)
    again, points, directions = unpack_map(packed, "map")
    np.testing.assert_array_equal(again.log_odds, VALUES[np.digitize(again.log_odds, map_codec.CUTS)])
    repeated = pack_map(again, points, directions)
    assert repeated == packed


def zipped(data: bytes) -> bytes:
    return zstandard.ZstdCompressor().compress(data)


def streamed(data: bytes) -> bytes:
    """A frame that does not say how long it is."""
    return zstandard.ZstdCompressor(write_content_size=False).compress(data)


def columns(name: str, data: bytes) -> PackedMap:
    changed: dict[str, Any] = {name: data}
    return packed_room()._replace(**changed)


def unzipped(name: str) -> bytes:
    return zstandard.ZstdDecompressor().decompress(getattr(packed_room(), name))


def test_every_column_must_fit_the_grid_and_the_columns_before() -> None:
    for name in PackedMap._fields[5:]:
        good = unzipped(name)
        assert unpack_map(columns(name, zipped(good)), "room")[0].log_odds.any()
        for bad in (good[:-1], good + b"\0", b""):
            with pytest.raises(RecordError, match=f"room: {name} claims {len(bad)} bytes; must be {len(good)}"):
                unpack_map(columns(name, zipped(bad)), "room")
        for frame in (b"", zipped(good)[:-1], zipped(good) + b"x", zipped(good) * 2, good):
            with pytest.raises(RecordError, match=f"room: {name}"):
                unpack_map(columns(name, frame), "room")
        with pytest.raises(RecordError, match=f"room: {name}"):
            unpack_map(columns(name, streamed(good)), "room")


@pytest.mark.parametrize(
    ("field", "value"),
    [("height", 0), ("height", 4001), ("width", -1), ("resolution", 0.0), ("resolution", np.nan), ("x", np.inf)],
)
def test_a_frame_out_of_bounds_is_refused(field: str, value: Any) -> None:
    with pytest.raises(RecordError, match=f"room: (shape|{field}|origin)"):
        unpack_map(packed_room()._replace(**{field: value}), "room")


def test_hostile_numbers_are_refused() -> None:
    with pytest.raises(RecordError, match="byte of 81"):
        unpack_map(columns("cells", zipped(b"\x51" * len(unzipped("cells")))), "room")
    with pytest.raises(RecordError, match="byte of 255"):
        unpack_map(columns("levels", zipped(b"\xff" * len(unzipped("levels")))), "room")
    for step in (0, 20, 255):
        with pytest.raises(RecordError, match="outside of its cell"):
            unpack_map(columns("offsets", zipped(bytes([step]) * len(unzipped("offsets")))), "room")


def test_a_frame_that_claims_a_terabyte_is_refused_at_once() -> None:
    for size in (2**30, 2**40):
        # Magic number; one segment and 8 bytes of content size; the size; an empty last block.
        bomb = b"\x28\xb5\x2f\xfd" + b"\xe0" + size.to_bytes(8, "little") + b"\x01\x00\x00"
        with pytest.raises(RecordError, match=f"room: cells claims {size} bytes"):
            unpack_map(columns("cells", bomb), "room")


def test_a_grid_all_of_wall_is_refused_before_its_points_are_made() -> None:
    side = 4000
    wall = zipped(b"\x50" * (side * side // 4))  # 2 + 3 * 2 + 9 * 2 + 27 * 2
    assert len(wall) < 1000
    with pytest.raises(RecordError, match=f"{side * side} occupied"):
        unpack_map(PackedMap(side, side, 0.05, 0.0, 0.0, wall, b"", b"", b"", b""), "map")


def test_a_grid_of_many_cells_comes_back() -> None:
    """Larger than what 8 and 12 bits count, not square, and not a multiple of four."""
    rng = np.random.default_rng(0)
    log_odds = np.zeros((4000, 301), np.float32)
    log_odds[rng.integers(0, 4000, 500), rng.integers(0, 301, 500)] = 4.0
    log_odds[0, 0] = log_odds[-1, -1] = -2.0
    grid, cloud, _ = unpack_map(pack_map(grid_of(log_odds), NOTHING, NOTHING), "map")
    np.testing.assert_array_equal(grid.log_odds, log_odds.clip(-1.5, 4.0))
    assert len(cloud) == np.count_nonzero(log_odds == 4.0)


def test_the_values_are_the_votes_of_the_fusion() -> None:
    """So that a cell weighs in a joint map what it would have weighed at home."""
    grid = grid_of(np.array([[-9.0, 9.0]]))
    sent, _, _ = unpack_map(pack_map(grid, NOTHING, NOTHING), "map")
    none = LocalMap(grid, np.empty(0, np.int64), np.empty(0), np.empty((0, 3)), NOTHING, NOTHING)
    fused = fuse([(gtsam.Pose2(), none)])
    np.testing.assert_array_equal(fused.log_odds, fuse([(gtsam.Pose2(), replace(none, grid=sent))]).log_odds)
