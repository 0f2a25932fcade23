"""The paper's figures 3 to 6, for the session at hand."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from scipy.ndimage import uniform_filter

from factors import EdgeKind, VertexId
from frontend.local_map import LocalMap
from frontend.records import FloatArray
from mrtm.joint.alignment.agreement import Lookup, overlap
from mrtm.joint.crispness import opinions
from mrtm.joint.graph import JointGraph
from mrtm.moving import moved
from mrtm.output.figures import draw_map
from mrtm.output.raster import View, find_view, paint, rgb
from mrtm.output.sheet import Panel, Pixels, draw_sheet
from mrtm.output.style import BACKGROUND, FREE, INK, robot_colours
from mrtm.result import RunResult

PANEL = 900
"""Pixels across or up of a picture on a sheet, at most."""

DETAIL = 8.0
"""Metres across and up that Fig. 4 magnifies."""

PLACE = 20.0
"""Metres across and up that Fig. 5 shows: the width of the paper's local maps."""

CANDIDATES = 30
"""Pairs of near vertices among which Fig. 5 looks for the two maps that share most."""

Maps = list[tuple[gtsam.Pose2, LocalMap]]


def draw_paper_figures(result: RunResult, ways: Sequence[tuple[str, RunResult]], out: Path) -> None:
    """Draw ``fig3-ROBOT.png``, ``fig4.png``, ``fig5.png`` and ``fig6.png`` into the directory ``out``.

    Figures 4 to 6 show the component of most vertices. There is no Fig. 5 where no two local maps overlap.

    Args:
        result: the run, with its on-line optimum.
        ways: the joint map made one way each, by name, in the order they are shown in (Fig. 4).
    """
    component = max(result.components, key=len)
    for robot in result.trajectories:
        draw_own_map(result, robot, out / f"fig3-{robot}.png")
    draw_before_and_after(ways, component, out / "fig4.png")
    draw_same_place(result, component, out / "fig5.png")
    draw_team(result, component, out / "fig6.png")


def draw_own_map(result: RunResult, robot: str, path: Path) -> None:
    """Fig. 3: the topological/metric map that a robot makes of its own edges alone, in the frame of its vertex 0."""
    own = sorted(vertex for vertex in result.vertex_poses if vertex.robot == robot)
    accepted = [f for f in result.edges if f.fate == "accepted" and {f.edge.tail.robot, f.edge.head.robot} == {robot}]
    graph = JointGraph(own[0])
    graph.update(add=[fate.edge for fate in accepted])
    graph.optimize_fully()
    alone = replace(
        moved(result, graph.estimates()),
        vertex_covariances={vertex: graph.marginal(vertex) for vertex in own},
        components=[own],
        edges=accepted,
    )
    draw_map(alone, own, path)


def draw_before_and_after(ways: Sequence[tuple[str, RunResult]], component: list[VertexId], path: Path) -> None:
    """Fig. 4: the fused map each way, and below the part where the first and the last way differ most."""
    first, last = ways[0][1], ways[-1][1]
    positions = np.concatenate([_positions(way, component) for _, way in ways])
    whole = _fitted(find_view(last.placed_maps(component), positions))
    detail = _square(whole, _worst_place(first, last, component), DETAIL)
    rows = []
    for view, graph in ((whole, True), (detail, False)):
        row = []
        for name, way in ways:

            def draw(axes: Axes, way: RunResult = way, view: View = view, graph: bool = graph) -> None:
                if graph:
                    _draw_graph(axes, way, component, view)
                    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * (detail.high - detail.low)
                    axes.plot(*(detail.low + corners).T, color="#e8590c", linewidth=2.0, zorder=5)

            title = name if graph else f"{name}, detail"
            row.append(Panel(title, view, paint(way.placed_maps(component), view), draw))
        rows.append(row)
    draw_sheet("fused map before and after optimisation", rows, path)


def draw_same_place(result: RunResult, component: list[VertexId], path: Path) -> None:
    """Fig. 5: two local maps of the same place, by two robots where there are two, and one drawn over the other."""
    pair = _most_overlapping(result, component)
    if pair is None:
        path.unlink(missing_ok=True)
        return
    angle = find_view(result.placed_maps(component), _positions(result, component)).angle
    turned = View(angle, np.zeros(2), np.zeros(2), 1.0)
    centre = turned.turn(_positions(result, list(pair))).mean(axis=0)
    view = _square(View(angle, centre, centre, 1.0), centre, PLACE)
    colours = robot_colours(list(result.trajectories))
    one, other = (colours[v.robot] for v in pair)
    if one == other:
        other = next(c for c in robot_colours(["blue", "red"]).values() if c != one)
    panels = [Panel(f"{v.robot}, vertex {v.number}", view, paint(result.placed_maps([v]), view)) for v in pair]
    both = _tinted([(result.placed_maps([v]), colour) for v, colour in zip(pair, (one, other), strict=True)], view)
    panels.append(Panel("both, at the joint estimate", view, both))
    draw_sheet("two local maps of the same place", [panels], path)


def draw_team(result: RunResult, component: list[VertexId], path: Path) -> None:
    """Fig. 6: the joint map with walls, vertices and edges in the colour of the robot they come from."""
    view = find_view(result.placed_maps(component), _positions(result, component))
    colours = robot_colours(list(result.trajectories))
    robots = [robot for robot in result.trajectories if any(v.robot == robot for v in component)]
    layers = [(result.placed_maps([v for v in component if v.robot == robot]), colours[robot]) for robot in robots]

    def draw(axes: Axes) -> None:
        _draw_graph(axes, result, component, view)
        for k, robot in enumerate(reversed(robots)):
            axes.text(
                1 - 170 * k / view.width, 1 + 24 / view.height, robot, transform=axes.transAxes, color=colours[robot],
                fontsize=17, fontweight="bold", ha="right", va="center_baseline",
            )  # fmt: skip

    panel = Panel("in the colours of the robots", view, _tinted(layers, view), draw)
    draw_sheet("joint map", [[panel]], path)


def _positions(result: RunResult, vertices: Sequence[VertexId]) -> FloatArray:
    return np.array([[result.vertex_poses[v].x(), result.vertex_poses[v].y()] for v in vertices])


def _array(pose: gtsam.Pose2) -> FloatArray:
    return np.array([pose.x(), pose.y(), pose.theta()])


def _fitted(view: View) -> View:
    """The same window, small enough for a panel."""
    scale = min(view.scale, PANEL / float((view.high - view.low).max()))
    return View(view.angle, np.floor(view.low * scale) / scale, np.ceil(view.high * scale) / scale, scale)


def _square(view: View, centre: FloatArray, size: float) -> View:
    """A square of ``size`` metres around a point of the turned frame."""
    scale = PANEL / size
    low = np.floor((centre - size / 2) * scale) / scale
    return View(view.angle, low, low + size, scale)


def _worst_place(before: RunResult, after: RunResult, component: list[VertexId]) -> FloatArray:
    """The middle, in the frame turned as Fig. 4 is, of the square that lost most disagreement on the way."""
    view = find_view(after.placed_maps(component), _positions(after, component))
    box, cell = np.array([view.low, view.high]), 0.1
    turn = gtsam.Pose2(0.0, 0.0, view.angle)

    def disagreement(result: RunResult) -> FloatArray:
        _, bits = opinions([(turn.compose(pose), m) for pose, m in result.placed_maps(component)], box, cell)
        return np.nan_to_num(bits)

    gain = uniform_filter(disagreement(before) - disagreement(after), round(DETAIL / cell), mode="constant")
    row, column = np.unravel_index(int(gain.argmax()), gain.shape)
    return np.asarray(view.low + cell * (np.array([column, row]) + 0.5))


def _most_overlapping(result: RunResult, component: list[VertexId]) -> tuple[VertexId, VertexId] | None:
    """Of the nearest pairs of vertices, of different robots where there are any, those whose maps share most."""
    vertices = sorted(v for v in component if v in result.local_maps)
    across = len({v.robot for v in vertices}) > 1
    pairs = [(a, b) for a in vertices for b in vertices if a < b and (a.robot != b.robot or not across)]
    places = dict(zip(vertices, _positions(result, vertices), strict=True))
    pairs.sort(key=lambda pair: float(np.hypot(*(places[pair[1]] - places[pair[0]]))))
    lookups: dict[VertexId, Lookup] = {}
    best, shared = None, 0.0
    for a, b in pairs[:CANDIDATES]:
        for v in (a, b):
            lookups.setdefault(v, Lookup.of(result.local_maps[v]))
        area = overlap(lookups[a], lookups[b], _array(result.map_poses[a].between(result.map_poses[b])))
        if area > shared:
            best, shared = (a, b), area
    return best


def _draw_graph(axes: Axes, result: RunResult, component: list[VertexId], view: View) -> None:
    """Vertices as numbered discs, and edges, in the colour of the robot that made them; alignments, so many, thin."""
    colours = robot_colours(list(result.trajectories))
    places = dict(zip(component, view.turn(_positions(result, component)), strict=True))
    edges = [f.edge for f in result.edges if f.fate == "accepted" and f.edge.tail in places and f.edge.head in places]
    edges.sort(key=lambda edge: edge.kind is not EdgeKind.ALIGNMENT)
    lines = [(places[e.tail], places[e.head]) for e in edges]
    shades = [colours[e.tail.robot] if e.tail.robot == e.head.robot else INK for e in edges]
    wide = np.array([0.6 if e.kind is EdgeKind.ALIGNMENT else 1.8 for e in edges])
    for width, shade, order in ((2.0 * wide, ["#ffffff"] * len(lines), 3.0), (wide, shades, 3.1)):
        axes.add_collection(LineCollection(lines, colors=shade, linewidths=width, zorder=order), autolim=False)
    size = 11.0 if len(component) < 40 else 7.0
    faces = [colours[v.robot] for v in component]
    x, y = np.array(list(places.values())).T
    axes.scatter(x, y, s=(1.8 * size) ** 2, c=faces, edgecolors="white", zorder=4)
    for vertex, (u, v) in places.items():
        axes.text(u, v, str(vertex.number), fontsize=size, color="white", ha="center", va="center_baseline", zorder=5)


def _tinted(layers: Sequence[tuple[Maps, str]], view: View) -> Pixels:
    """Maps over each other, the walls of each layer in its colour; where two lie on each other they multiply."""
    floor = np.maximum(paint([m for maps, _ in layers for m in maps], view), rgb(BACKGROUND)).astype(np.float64)
    light, dark = float(np.mean(rgb(BACKGROUND))), 20.0
    for maps, colour in layers:
        ink = ((light - paint(maps, view).mean(axis=2)) / (light - dark)).clip(0.0, 1.0)[..., None]
        floor *= 1.0 - ink * (1.0 - np.array(rgb(colour)) / np.array(rgb(FREE)))
    return (floor + 0.5).astype(np.uint8)
