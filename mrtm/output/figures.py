"""The picture people look at: the joint grid, the paths, the vertices, the edges by type."""

import math
from collections import Counter
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.path import Path as Curve
from PIL import Image

from factors import GraphEdge, VertexId
from frontend.records import FloatArray
from mrtm.output.files import replacing
from mrtm.output.margins import DPI, FOOTER, HEADER, SIDE, draw_legend, draw_scale, write_header
from mrtm.output.raster import View, find_view, paint, rgb
from mrtm.output.style import BACKGROUND, EDGE_STYLES, OTHER_EDGE, robot_colours
from mrtm.result import RunResult


def draw_map(result: RunResult, component: list[VertexId], path: Path) -> None:
    """Draw one connected component of a run into a PNG about 2000 pixels wide.

    The picture is turned so that walls run along its borders, the long way across; the small cross beside the scale
    bar shows where x and y of the joint frame point.
    """
    maps = result.placed_maps(component)
    view = find_view(maps, _positions(result, component))
    width, height = max(view.width, 1500) + 2 * SIDE, view.height + HEADER + FOOTER
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    figure.patch.set_visible(False)
    canvas = FigureCanvasAgg(figure)
    left = (width - view.width) // 2
    axes = figure.add_axes((left / width, FOOTER / height, view.width / width, view.height / height))
    axes.set_axis_off()
    axes.set_xlim(view.low[0], view.high[0])
    axes.set_ylim(view.low[1], view.high[1])
    colours = robot_colours(list(result.trajectories))
    robots = [robot for robot in result.trajectories if any(v.robot == robot for v in component)]
    for robot in robots:
        path_poses = result.trajectories[robot].poses
        if len(path_poses):
            x, y = view.turn(path_poses[:, :2]).T
            axes.plot(x, y, color=colours[robot], linewidth=1.5, alpha=0.6, solid_joinstyle="round", zorder=2)
    poses = {v: view.turn_pose(result.vertex_poses[v]) for v in component}
    edges = [fate.edge for fate in result.edges if fate.fate == "accepted" and fate.edge.tail in poses]
    _draw_edges(axes, edges, poses)
    _draw_vertices(axes, result, poses, view, colours)
    write_header(figure, result, component, robots, len(edges))
    draw_scale(figure, view)
    draw_legend(figure, edges, robots, colours)
    # The grid goes into the renderer's own buffer, under what is drawn: an image artist would take half a second.
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    pixels[...] = (*rgb(BACKGROUND), 255)
    pixels[HEADER : HEADER + view.height, left : left + view.width, :3] = paint(maps, view)
    figure.draw(canvas.get_renderer())  # type: ignore[no-untyped-call]
    image = Image.fromarray(pixels[..., :3])
    with replacing(path) as temporary:
        image.save(temporary, format="PNG", compress_level=4)


def _positions(result: RunResult, component: list[VertexId]) -> FloatArray:
    """Joint positions (n, 2) of the vertices of a component and of the paths of its robots."""
    robots = {vertex.robot for vertex in component}
    paths = [trajectory.poses[:, :2] for robot, trajectory in result.trajectories.items() if robot in robots]
    vertices = [[result.vertex_poses[v].x(), result.vertex_poses[v].y()] for v in component]
    return np.concatenate([*paths, np.reshape(vertices, (-1, 2))])


def _draw_edges(axes: Axes, edges: list[GraphEdge], poses: dict[VertexId, FloatArray]) -> None:
    """One curve an edge; edges between the same two vertices fan out."""
    drawn: Counter[tuple[VertexId, VertexId]] = Counter()
    curves: dict[str, list[Curve]] = {}
    for edge in edges:
        ends = min(edge.tail, edge.head), max(edge.tail, edge.head)
        a, b = poses[ends[0]][:2], poses[ends[1]][:2]
        turn = (drawn[ends] + 1) // 2 * (-1) ** drawn[ends]  # 0, -1, 1, -2, 2 ...
        drawn[ends] += 1
        bow = (a + b) / 2 + 0.12 * turn * np.array([a[1] - b[1], b[0] - a[0]])
        curves.setdefault(str(edge.kind), []).append(Curve([a, bow, b], [Curve.MOVETO, Curve.CURVE3, Curve.CURVE3]))
    for kind, paths in curves.items():
        style = EDGE_STYLES.get(kind, OTHER_EDGE)
        halo = PathCollection(paths, facecolors="none", edgecolors="white", linewidths=style.width + 2.2, alpha=0.6)
        line = PathCollection(
            paths, facecolors="none", edgecolors=style.colour, linewidths=style.width, linestyles=[style.dashes]
        )
        for order, collection in ((3.0, halo), (3.1, line)):
            collection.set_zorder(order)
            axes.add_collection(collection, autolim=False)


def _draw_vertices(
    axes: Axes, result: RunResult, poses: dict[VertexId, FloatArray], view: View, colours: dict[str, str]
) -> None:
    """Discs with the vertex index, and the ellipse that holds the vertex with 3 sigma."""
    points = np.array([pose[:2] for pose in poses.values()])
    faces = [colours[vertex.robot] for vertex in poses]
    size = _label_size(points * view.scale)
    widths, heights, angles = np.array([_ellipse(result.vertex_covariances.get(v), poses[v][2]) for v in poses]).T
    ellipses = EllipseCollection(
        widths, heights, angles, units="xy", offsets=points, offset_transform=axes.transData,
        facecolors=faces, edgecolors=faces, linewidths=1.0, alpha=0.25, zorder=2.5,
    )  # fmt: skip
    axes.add_collection(ellipses, autolim=False)
    diameter = 1.9 * size
    axes.scatter(points[:, 0], points[:, 1], s=diameter**2, c=faces, edgecolors="white", linewidths=1.4, zorder=4)
    for vertex, (x, y) in zip(poses, points, strict=True):
        digits = len(str(vertex.number))
        axes.text(
            x, y, str(vertex.number), fontsize=size * (1.0 if digits < 3 else 0.75), color="white",
            fontweight="bold", ha="center", va="center_baseline", zorder=5,
        )  # fmt: skip


def _label_size(pixels: FloatArray) -> float:
    """Points of text so that the discs of most vertices do not touch."""
    if len(pixels) < 2:
        return 11.0
    distance = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    near = float(np.quantile(distance.min(axis=1), 0.25)) * 72 / DPI
    return min(11.0, max(5.5, near / 2.2))


def _ellipse(covariance: FloatArray | None, heading: float) -> tuple[float, float, float]:
    """Axes in metres and angle in degrees of the 3-sigma ellipse of a covariance in the frame of the vertex."""
    if covariance is None:
        return 0.0, 0.0, 0.0
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    minor, major = 6 * np.sqrt(np.maximum(values, 0.0))
    return float(major), float(minor), math.degrees(heading + math.atan2(vectors[1, 1], vectors[0, 1]))
