import json
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from PIL import Image

from factors import AnchoredSighting, EdgeId, EdgeKind, Sighting, SightingEdge, UncertainPose, VertexId
from frontend.local_map import LocalMap
from mrtm.compare import Score, compare, rows, table, three_ways
from mrtm.compare.table import Row, markdown
from mrtm.joint.crispness import Crispness
from mrtm.moving import moved
from mrtm.output.paper_figures import draw_own_map, draw_same_place
from mrtm.result import EdgeFate, Latency, RunResult, TeamStory
from tests.mrtm.sample_run import inside, sample_run
from tests.mrtm.surface_world import distance

RED, BLUE = VertexId("red", 0), VertexId("blue", 0)
TEAM = [VertexId(robot, index) for robot in ("red", "blue") for index in (0, 1)]


def with_normals(pose: gtsam.Pose2, local_map: LocalMap) -> LocalMap:
    """The map with normals that point away from its walls into the rooms."""
    x, y = (pose.matrix()[:2, :2] @ local_map.cloud.T) + pose.translation()[:, None]
    step = 0.04
    slope = (
        np.column_stack([inside(x + step, y) - inside(x - step, y), inside(x, y + step) - inside(x, y - step)])
        @ pose.matrix()[:2, :2]
    )
    length = np.hypot(*slope.T)[:, None]
    return replace(local_map, normals=np.where(length > 1e-6, slope / np.maximum(length, 1e-6), 0.0))


@pytest.fixture
def result() -> RunResult:
    """The sample run, red and blue in one map; its joint poses are the truth, its edges are off by some centimetres."""
    run = sample_run()
    rng = np.random.default_rng(7)
    edges = []
    for fate in run.edges:
        edge = fate.edge
        if edge.kind is EdgeKind.LOOP:
            edge = replace(edge, kind=EdgeKind.FUSING)  # type: ignore[type-var]
        wrong = gtsam.Pose2(*rng.normal(0.0, [0.06, 0.06, 0.02]))
        measured = run.vertex_poses[edge.tail].between(run.vertex_poses[edge.head]).compose(wrong)
        edges.append(replace(fate, edge=replace(edge, measurement=measured)))  # type: ignore[type-var]
    return replace(
        run,
        edges=edges,
        components=[TEAM, [VertexId("green", 0)]],
        local_maps={v: with_normals(run.vertex_poses[v], m) for v, m in run.local_maps.items()},
        timings={"filter": 10.0, "joint map": 0.25},
        longest={"joint map": 0.01},
        latencies=[
            Latency(3.0, "red", 2, {"exchange": 1.0, "joint map": 0.01}),
            Latency(4.0, "blue", len(TEAM), {"joint map": 0.02, "alignment": 0.03, "judging": 9.0}),
            Latency(5.0, None, len(TEAM) + 1, {"joint map": 0.05, "alignment": 0.2, "judging": 9.0}),
        ],
        team=TeamStory([], [], 3.0, 42.0, {}),
    )


@pytest.fixture
def relations(tmp_path: Path, result: RunResult) -> Path:
    """True relations between scans of red and blue: the run's own poses."""
    lines = []
    scans = [(t, p) for r in ("red", "blue") for t, p in zip(*_trajectory(result, r), strict=True)]
    for t1, p1 in scans[::3]:
        for t2, p2 in scans[1::4]:
            off = gtsam.Pose2(*p1).between(gtsam.Pose2(*p2))
            lines.append(f"{t1} {t2} {off.x()} {off.y()} 0 0 0 {off.theta()}")
    path = tmp_path / "true.relations"
    path.write_text("\n".join(lines))
    return path


def _trajectory(result: RunResult, robot: str) -> tuple[list[float], list[list[float]]]:
    return result.trajectories[robot].times.tolist(), result.trajectories[robot].poses.tolist()


def test_em_mends_what_the_tree_gets_wrong(result: RunResult) -> None:
    tree, em, on_line = three_ways(result, lambda fraction, doing: None)
    worst = {
        way.name: max(distance(result.vertex_poses[v], way.result.vertex_poses[v])[0] for v in TEAM)
        for way in (tree, em, on_line)
    }
    assert worst["tree only"] > 0.05
    assert worst["off-line EM"] < 0.015
    assert worst["on line"] == 0.0
    assert on_line.seconds == 0.25
    assert on_line.updates == em.updates == 2
    assert on_line.over_run == pytest.approx(0.06)
    assert on_line.longest == 0.05
    assert em.over_run == pytest.approx(em.seconds * (2 + len(TEAM)) / (len(TEAM) + 1))
    assert "42 s" in on_line.available


@pytest.mark.slow
def test_compare_scores_and_draws(result: RunResult, relations: Path, tmp_path: Path) -> None:
    truth = tmp_path / "red.tum"
    times, poses = _trajectory(result, "red")
    lines = [f"{t} {x} {y} 0 0 0 {np.sin(a / 2)} {np.cos(a / 2)}" for t, (x, y, a) in zip(times, poses, strict=True)]
    truth.write_text("\n".join(lines))
    told: list[float] = []
    out = tmp_path / "out"
    scores = compare(result, out, relations, {"red": truth}, lambda fraction, doing: told.append(fraction))
    tree, em, on_line = scores
    assert on_line.relations is not None
    assert on_line.relations.translation.mean < 1e-6
    assert tree.relations is not None
    assert em.relations is not None
    assert em.relations.translation.mean < 0.3 * tree.relations.translation.mean
    assert tree.relations_across is not None
    assert tree.relations_across.count > 0
    assert tree.ate is not None
    assert on_line.ate == pytest.approx(0.0, abs=1e-6)
    assert tree.crispness.entropy > em.crispness.entropy
    assert tree.crispness.disagreement > 1.3 * on_line.crispness.disagreement
    assert told == sorted(told)
    assert told[-1] == 1.0
    written = json.loads((out / "comparison.json").read_text())
    assert [way["name"] for way in written["ways"]] == ["tree only", "off-line EM", "on line"]
    assert written["ways"][0]["relations"]["count"] == tree.relations.count
    assert (out / "comparison.md").read_text() == markdown(rows(scores))
    figures = {path.name for path in out.glob("*.png")}
    assert figures == {"fig3-red.png", "fig3-blue.png", "fig3-green.png", "fig4.png", "fig5.png", "fig6.png"}
    for name in figures:
        pixels = np.asarray(Image.open(out / name).convert("L"))
        assert (pixels < 60).mean() > 0.001  # there are walls


def test_what_was_not_measured_has_no_row() -> None:
    score = Score("tree only", None, None, None, Crispness(0.2, 0.1, 30.0), 1.0, 3, 2.0, 0.5, "always")
    names = [row.name for row in rows((score, score))]
    assert not any("relations" in name or "ATE" in name for name in names)
    assert any("entropy" in name for name in names)


def test_alignments_are_not_for_the_tree(result: RunResult, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "mrtm.compare.ways.PAPER_EDGES", frozenset({EdgeKind.INTER_VERTEX, EdgeKind.COVARIANCE_INTERSECTION})
    )
    # The fusing edge is no longer one of the paper's: its transformation is lent from the joint estimate.
    tree, _, _ = three_ways(result, lambda fraction, doing: None)
    off = [distance(result.vertex_poses[v], tree.result.vertex_poses[v])[0] for v in (TEAM[1], TEAM[3])]
    bridge = tree.result.vertex_poses[TEAM[1]].between(tree.result.vertex_poses[TEAM[3]])
    assert min(off) > 0.01
    assert distance(bridge, result.vertex_poses[TEAM[1]].between(result.vertex_poses[TEAM[3]]))[0] < 1e-9


def test_robots_that_only_have_sightings_without_a_heading_are_joined_too(result: RunResult) -> None:
    anchor = UncertainPose(gtsam.Pose2(), 1e-4 * np.eye(3))
    sighting = Sighting(1.0, 0.0, None, 0.1, 0.1, None)
    seen = SightingEdge(EdgeId("red", 9), 0, AnchoredSighting(sighting, RED, BLUE, anchor, anchor))
    edges = [fate for fate in result.edges if fate.edge.kind is not EdgeKind.FUSING]
    tree, em, _ = three_ways(replace(result, edges=[*edges, EdgeFate(seen, "accepted")]), lambda fraction, doing: None)
    assert distance(tree.result.vertex_poses[BLUE], result.vertex_poses[BLUE])[0] < 1e-9
    assert all(distance(em.result.vertex_poses[v], result.vertex_poses[v])[0] < 0.015 for v in TEAM)


def test_moving_a_vertex_takes_its_scans_along(result: RunResult) -> None:
    to = gtsam.Pose2(5.0, -3.0, 1.0)
    after = moved(result, {TEAM[1]: to})
    before, now = result.trajectories["red"], after.trajectories["red"]
    there = before.vertices == 1
    assert (now.poses[~there] == before.poses[~there]).all()
    for old, new in zip(before.poses[there], now.poses[there], strict=True):
        seen = result.vertex_poses[TEAM[1]].between(gtsam.Pose2(*old))
        assert distance(to.compose(seen), gtsam.Pose2(*new))[0] < 1e-9
    assert after.vertex_poses[TEAM[0]] is result.vertex_poses[TEAM[0]]


def test_fig_3_shows_a_robot_by_its_own_edges(result: RunResult, tmp_path: Path) -> None:
    elsewhere = moved(result, {v: gtsam.Pose2(30.0, 1.0, 0.4).compose(result.vertex_poses[v]) for v in TEAM[:2]})
    pictures = []
    for number, run in enumerate((result, elsewhere)):
        path = tmp_path / f"{number}.png"
        draw_own_map(run, "red", path)
        pictures.append(np.asarray(Image.open(path).convert("L")).astype(int))
    assert pictures[0].shape == pictures[1].shape
    assert (np.abs(pictures[0] - pictures[1]) > 20).mean() < 1e-3


def test_no_fig_5_where_there_is_no_second_map(result: RunResult, tmp_path: Path) -> None:
    path = tmp_path / "fig5.png"
    path.write_bytes(b"of an earlier run")
    draw_same_place(result, [VertexId("green", 0)], path)
    assert not path.exists()


def test_markdown_and_terminal_show_the_same_rows() -> None:
    some = [Row("", ("a", "bb")), Row("metres", ("0.1", "0.25"))]
    assert markdown(some) == "|        | a   | bb   |\n| ------ | --: | ---: |\n| metres | 0.1 | 0.25 |\n"
    drawn = table(some)
    assert [column.header for column in drawn.columns] == ["", "a", "bb"]
    assert drawn.row_count == 1
