"""The files of a run, read back the way others read them."""

import errno
import io
import json
import math
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import numpy.typing as npt
import pytest
import yaml
from PIL import Image
from rich.console import Console

from factors import Edge, VertexId, factor_of, without_kernel
from mrtm.output.export import export
from mrtm.output.files import replacing, to_json
from mrtm.output.local_maps import read_local_map
from mrtm.output.report import run_report
from mrtm.result import SightingFate, TeamStory
from tests.mrtm.sample_run import inside, sample_run


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run") / "out"
    export(sample_run(), directory)
    return directory


def test_everything_is_there_and_nothing_else(out: Path) -> None:
    names = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    maps = {f"{stem}.{suffix}" for stem in ("map", "map-1") for suffix in ("pgm", "yaml", "png")}
    vertices = {f"local_maps/{name}.npz" for name in ("red-0", "red-1", "blue-0", "blue-1", "green-0")}
    tum = {f"trajectory/{robot}.tum" for robot in ("red", "blue", "green")}
    assert names == {"run.json", "graph.g2o"} | maps | vertices | tum


def test_run_json_tells_the_whole_story(out: Path) -> None:
    run = json.loads((out / "run.json").read_text())
    result = sample_run()
    assert run["seed"] == result.seed
    assert run["config"] == result.config
    assert run["counts"] == result.counts
    assert run["blemishes"] == result.blemishes
    assert set(run["versions"]) == {"python", "mrtm", "gtsam", "numpy", "numba"}
    assert run["timings"]["output"] > 0
    assert run["components"][0] == [["red", 0], ["red", 1], ["blue", 0], ["blue", 1]]  # the largest first
    assert run["robots"]["green"] == {"scans": 10, "duration": pytest.approx(1.8), "component": 1}
    assert [(e["fate"], e["version"]) for e in run["edges"]] == [(f.fate, f.edge.version) for f in result.edges]
    assert run["edges"][4]["reason"] == "chi2 40 beyond 11.3"
    assert run["edges"][0]["chi2"] is None  # JSON has no NaN
    for entry, fate in zip(run["edges"], result.edges, strict=True):
        edge = Edge.from_dict({k: v for k, v in entry.items() if k not in ("fate", "reason", "chi2")})
        assert fate.edge.estimate is not None
        assert edge.measurement.equals(fate.edge.estimate.pose, 1e-12)
        np.testing.assert_array_equal(edge.covariance, fate.edge.covariance)
    vertex = run["vertices"][0]
    assert vertex["first_scan"]["time"] == 100.0
    np.testing.assert_allclose(vertex["first_scan"]["pose"], 0, atol=1e-12)


def test_maps_are_drawn_where_they_lie_as_a_whole(out: Path, tmp_path: Path) -> None:
    """And vertices where the graph has them: their local maps may lie a little aside."""
    result = sample_run()
    aside = gtsam.Pose2(10.0, -5.0, 0.0)
    export(replace(result, map_poses={v: aside.compose(pose) for v, pose in result.map_poses.items()}), tmp_path)
    assert (tmp_path / "map.pgm").read_bytes() == (out / "map.pgm").read_bytes()
    origins = [yaml.safe_load((path / "map.yaml").read_text())["origin"] for path in (out, tmp_path)]
    np.testing.assert_allclose(np.subtract(*origins[::-1]), [10.0, -5.0, 0.0], atol=1e-6)
    before, after = (json.loads((path / "run.json").read_text())["vertices"] for path in (out, tmp_path))
    for old, new in zip(before, after, strict=True):
        assert new["pose"] == old["pose"]
        np.testing.assert_allclose(np.subtract(new["map_pose"], old["map_pose"]), [10.0, -5.0, 0.0], atol=1e-9)
    assert (tmp_path / "graph.g2o").read_bytes() == (out / "graph.g2o").read_bytes()


def test_trajectories_keep_the_order_of_the_log_and_the_microseconds(tmp_path: Path) -> None:
    result = sample_run()
    red = result.trajectories["red"]
    red.times[:] = 976052905.167303 + 0.2 * np.arange(len(red.times))
    red.times[5] -= 3.0  # the clock steps back
    export(result, tmp_path)
    rows = np.loadtxt(tmp_path / "trajectory" / "red.tum")
    np.testing.assert_allclose(rows[:, 0], red.times, atol=1e-6, rtol=0)
    np.testing.assert_allclose(rows[:, 1:3], red.poses[:, :2], atol=1e-8)
    np.testing.assert_allclose(2 * np.arctan2(rows[:, 6], rows[:, 7]), red.poses[:, 2], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1.0, atol=1e-9)
    assert (tmp_path / "trajectory" / "red.tum").read_text().startswith("976052905.167303 ")


def test_gtsam_reads_the_graph_and_keeps_its_errors(out: Path) -> None:
    graph, values = gtsam.readG2o(str(out / "graph.g2o"), False)
    result = sample_run()
    accepted = [fate.edge for fate in result.edges if fate.fate == "accepted"]
    assert values.size() == 5
    assert graph.size() == len(accepted)
    order = [VertexId(*v) for c in json.loads((out / "run.json").read_text())["components"] for v in c]
    for key, vertex in enumerate(order):
        assert values.atPose2(key).equals(result.vertex_poses[vertex], 1e-7)
    for i, edge in enumerate(accepted):
        assert edge.estimate is not None
        factor = without_kernel(factor_of(edge, order.index(edge.tail), order.index(edge.head)))
        assert graph.at(i).error(values) == pytest.approx(factor.error(values), rel=1e-4)


def map_server(stem: Path) -> tuple[npt.NDArray[np.int8], float, list[float]]:
    """What ROS map_server makes of the files in trinary mode: 100 occupied, 0 free, -1 unknown; row 0 the lowest."""
    about = yaml.safe_load(stem.with_suffix(".yaml").read_text())
    assert about["mode"] == "trinary"
    image = np.asarray(Image.open(stem.parent / about["image"]), dtype=np.float64)[::-1]
    occupancy = image / 255 if about["negate"] else (255 - image) / 255
    cells = np.full(image.shape, -1, np.int8)
    cells[occupancy > about["occupied_thresh"]] = 100
    cells[occupancy < about["free_thresh"]] = 0
    return cells, about["resolution"], about["origin"]


def test_map_server_sees_walls_free_and_unknown_where_they_are(out: Path) -> None:
    cells, resolution, origin = map_server(out / "map")
    assert origin[2] == 0.0
    centres = [start + resolution * (np.arange(n) + 0.5) for start, n in zip(origin, cells.shape[::-1], strict=False)]
    x, y = np.meshgrid(*centres)
    depth = inside(x, y)
    assert (cells[depth > 0.15] == 0).all()
    assert (cells[depth < -0.15] == -1).all()
    wall = np.abs(depth) < 0.03
    assert wall.sum() > 100
    assert (cells[wall] == 100).mean() > 0.97
    assert set(np.unique(cells)) == {-1, 0, 100}


def test_local_maps_come_back(out: Path) -> None:
    vertex = VertexId("blue", 1)
    wrote, read = sample_run().local_maps[vertex], read_local_map(out / "local_maps" / "blue-1.npz")
    np.testing.assert_allclose(read.grid.log_odds, wrote.grid.log_odds, atol=0.025)
    assert read.grid.resolution == wrote.grid.resolution
    np.testing.assert_array_equal(read.grid.origin, wrote.grid.origin)
    for name in ("scans", "times", "poses"):
        np.testing.assert_array_equal(getattr(read, name), getattr(wrote, name))
    np.testing.assert_allclose(read.cloud, wrote.cloud, atol=1e-6)
    np.testing.assert_allclose(read.normals, wrote.normals, atol=1e-6)


def test_the_same_run_gives_the_same_bytes(out: Path, tmp_path: Path) -> None:
    export(sample_run(), tmp_path)
    for path in (path for path in out.rglob("*") if path.is_file()):
        first, second = path.read_bytes(), (tmp_path / path.relative_to(out)).read_bytes()
        if path.name == "run.json":
            one, two = json.loads(first), json.loads(second)
            assert one.pop("timings") != {}
            two.pop("timings")
            assert one == two
        else:
            assert first == second, path.name


def test_what_an_earlier_run_left_is_cleared_away(tmp_path: Path) -> None:
    export(sample_run(), tmp_path)
    (tmp_path / "evaluation.json").write_text("{}")
    mine = ("map.clf", "map-notes.png", "map-7.png", "trajectory/truth.tum", "local_maps/mine.npz")
    for name in mine:
        (tmp_path / name).write_text("mine")
    result = sample_run()
    green = VertexId("green", 0)
    result.components.remove([green])
    del result.trajectories["green"], result.local_maps[green], result.vertex_poses[green]
    export(result, tmp_path)
    names = {path.name for path in tmp_path.rglob("*")}
    assert not names & {"map-1.pgm", "map-1.yaml", "map-1.png", "green.tum", "green-0.npz", "evaluation.json"}
    assert "map.pgm" in names
    assert all((tmp_path / name).read_text() == "mine" for name in mine)


def test_only_files_of_a_run_are_removed_whatever_the_earlier_one_is_said_to_have_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    listed = ["../notes.txt", "trajectory/../../notes.txt", str(tmp_path / "notes.txt"), "notes.txt", 7]
    for name in ("notes.txt", "out/notes.txt"):
        (tmp_path / name).write_text("mine")
    records: list[object] = [{"files": listed}, {"files": 7}, [], {}]
    for record in records:
        (out / "run.json").write_text(json.dumps(record))
        export(sample_run(), out)
        assert (tmp_path / "notes.txt").exists()
        assert (out / "notes.txt").exists()


def test_a_run_that_could_not_be_written_is_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(sample_run(), tmp_path)
    (tmp_path / "evaluation.json").write_text("{}")

    def full(*arguments: object, **options: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*map\.png'"):
        export(sample_run(), tmp_path)
    assert not list(tmp_path.glob("*.json"))


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half of the n")
            raise OSError(errno.ENOSPC, "disk full")

    with pytest.raises(OSError, match="disk full") as caught:
        fail()
    assert caught.value.filename == str(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_want_of_memory_names_the_file_too(tmp_path: Path) -> None:
    def fail() -> None:
        with replacing(tmp_path / "a.txt"):
            raise MemoryError

    with pytest.raises(OSError, match=r"memory: '.*a\.txt'"):
        fail()


def test_json_is_strict_and_takes_numpy() -> None:
    value = {"a": np.float64(1.5), "b": [math.nan, math.inf], "c": np.eye(2), "d": {}, "e": {"f": (1, {"g": None})}}
    assert json.loads(to_json(value)) == {
        "a": 1.5,
        "b": [None, None],
        "c": [[1, 0], [0, 1]],
        "d": {},
        "e": {"f": [1, {"g": None}]},
    }


def test_the_report_tells_for_each_pair_what_became_of_its_sightings_and_why() -> None:
    def fate(observer: str, observed: str, verdict: str, reason: str) -> SightingFate:
        return SightingFate(1.0, observer, observed, verdict, reason)

    sightings = [
        fate("red", "green", "refused", "no scan at that time"),
        fate("green", "red", "refused", "no scan at that time"),
        fate("red", "green", "waiting", "1 sightings of green and red agree"),
        fate("red", "blue", "accepted", "2 of 2 sightings of blue and red agree"),
        fate("red", "blue", "accepted", "2 of 2 sightings of blue and red agree"),
    ]
    console = Console(width=120, record=True, file=io.StringIO())
    for part in run_report(replace(sample_run(), team=TeamStory([], sightings, None, None, {}))):
        console.print(part)
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in console.export_text().splitlines()]
    worst = rows.index(["green and red", "", "1", "2", "no scan at that time"])
    assert rows[worst + 1] == ["blue and red", "2", "", "", "2 of 2 sightings agree"]
    alone = run_report(replace(sample_run(), team=TeamStory([], [], None, None, {})))
    assert any("there is no sighting" in str(part) for part in alone)


def test_the_report_names_speed_edges_components_and_blemishes() -> None:
    console = Console(width=100, record=True, file=io.StringIO())
    for part in run_report(sample_run()):
        console.print(part)
    text = console.export_text()
    for expected in ("50 scans over 9 s in 2.0 s, 5 times real time", "red.clf:12: unreadable", "2 maps", "front end"):
        assert expected in text
    row = next(line for line in text.splitlines() if "loop" in line)
    assert [cell.strip() for cell in row.split("│")[2:5]] == ["1", "", "1"]
