"""The picture: what its pixels show, and that no run is too odd for it."""

from pathlib import Path

import gtsam
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from factors import VertexId
from mrtm.output.figures import draw_map
from mrtm.output.margins import FOOTER, HEADER
from mrtm.output.raster import COARSEST, View, find_view, paint, rgb
from mrtm.output.style import BACKGROUND, FREE, WALL, robot_colours
from mrtm.result import RunResult, Trajectory
from tests.mrtm.sample_run import inside, sample_run

TEAM = [VertexId(robot, index) for robot in ("red", "blue") for index in (0, 1)]


def draw(result: RunResult, component: list[VertexId], path: Path) -> npt.NDArray[np.uint8]:
    draw_map(result, component, path)
    return np.asarray(Image.open(path))


def near(image: npt.NDArray[np.uint8], colour: str, tolerance: int = 12) -> npt.NDArray[np.bool_]:
    return np.asarray((np.abs(image.astype(int) - rgb(colour)) <= tolerance).all(axis=-1))


def test_paint_puts_walls_free_and_unknown_where_they_are() -> None:
    result = sample_run()
    maps = [(result.vertex_poses[v], result.local_maps[v]) for v in TEAM]
    view = find_view(maps, np.array([[1.0, 2.0]]))
    image = paint(maps, view)
    assert image.shape == (view.height, view.width, 3)
    row, column = np.indices(image.shape[:2])
    u = view.low[0] + (column + 0.5) / view.scale
    v = view.high[1] - (row + 0.5) / view.scale
    x, y = np.moveaxis(View(-view.angle, view.low, view.high, 1.0).turn(np.stack([u, v], axis=-1)), -1, 0)
    depth = inside(x, y)
    assert near(image[depth > 0.15], FREE).all()
    assert near(image[depth < -0.15], BACKGROUND).all()
    assert near(image[np.abs(depth) < 0.003], WALL).mean() > 0.9


@pytest.mark.parametrize("degrees", [-60, -20, 10, 44, 80])
def test_the_view_levels_the_walls_the_long_way_across(degrees: float) -> None:
    result = sample_run()
    turn = gtsam.Pose2(3.0, -5.0, np.radians(degrees))
    maps = [(turn.compose(result.vertex_poses[v]), result.local_maps[v]) for v in TEAM]
    view = find_view(maps, np.array([[turn.x(), turn.y()]]))
    level = np.degrees(view.angle) + degrees
    assert abs(level - 180 * round(level / 180)) < 1.0
    assert view.width > 1.8 * view.height
    assert view.high[0] - view.low[0] == pytest.approx(11.2, abs=0.3)


def test_a_large_building_keeps_its_walls() -> None:
    result = sample_run()
    maps = [(result.vertex_poses[v], result.local_maps[v]) for v in TEAM]
    view = find_view(maps, np.array([[-200.0, 2.0], [210.0, 2.0]]))  # 5 pixels a metre: a wall is a quarter of a pixel
    assert 1 / view.scale > 3 * COARSEST
    image = paint(maps, view)
    rows = near(image, WALL, 90)[:, round((2.0 - view.low[0]) * view.scale)] if abs(view.angle) < 0.1 else None
    assert rows is not None
    assert rows.sum() >= 2  # the walls below and above x = 2 m


def test_the_picture_has_map_paths_vertices_and_margins(tmp_path: Path) -> None:
    image = draw(sample_run(), TEAM, tmp_path / "map.png")
    height, width, _ = image.shape
    assert 1500 <= width <= 2200
    inner = image[HEADER : height - FOOTER]
    colours = robot_colours(["red", "blue", "green"])
    assert near(inner, FREE).mean() > 0.3
    assert near(inner, WALL).sum() > 2000
    assert near(inner, colours["red"]).sum() > 500
    assert near(inner, colours["blue"]).sum() > 500
    assert near(inner, colours["green"]).sum() == 0  # in a component of its own
    assert not near(image[:HEADER], BACKGROUND).all()
    assert not near(image[height - FOOTER :], BACKGROUND).all()


def test_edges_are_drawn_by_type_and_only_if_accepted(tmp_path: Path) -> None:
    result = sample_run()
    with_edges = draw(result, TEAM, tmp_path / "a.png")
    result.edges = [fate for fate in result.edges if fate.fate != "accepted"]
    without = draw(result, TEAM, tmp_path / "b.png")
    changed = (with_edges != without).any(axis=-1)[HEADER:-FOOTER]
    assert changed.sum() > 1000
    result.edges = []
    bare = draw(result, TEAM, tmp_path / "c.png")
    np.testing.assert_array_equal(without[HEADER:-FOOTER], bare[HEADER:-FOOTER])


def test_odd_runs_can_be_drawn(tmp_path: Path) -> None:
    result = sample_run()
    green = VertexId("green", 0)
    draw(result, [green], tmp_path / "one-vertex.png")
    result.vertex_covariances = {}
    result.local_maps = {}
    result.trajectories["green"] = Trajectory(np.empty(0), np.empty((0, 3)), np.empty(0, np.int64))
    image = draw(result, [green], tmp_path / "nothing.png")
    assert near(image, BACKGROUND).mean() > 0.9


def test_robots_have_distinct_colours() -> None:
    names = ["red", "anna", "blue", "bert", "carl"]
    colours = robot_colours(names)
    assert list(colours) != []
    assert len(set(colours.values())) == len(names)
    assert colours["red"] == robot_colours(["red"])["red"]
