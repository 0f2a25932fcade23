"""What made-up buildings are put together from."""

from itertools import pairwise

import numpy as np

from frontend.records import FloatArray
from tools.simulation.plan import FloorPlan, box_outline
from tools.simulation.raycast import clearances

THICKNESS = 0.12  # of a wall
DOOR = 0.9
FREE = 0.6  # metres that furniture keeps from routes

Segments = list[tuple[float, ...]]
Points = list[tuple[float, ...]]


def wall(a: tuple[float, float], b: tuple[float, float], doors: Points | None = None) -> Segments:
    """A thick wall from a to b as outlines of its solid pieces.

    Args:
        a: x, y of one end, metres.
        b: x, y of the other end.
        doors: centre of each opening (metres from a) and, if it is no ordinary door, its width.
    """
    start, end = np.array(a), np.array(b)
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    gaps = sorted((door[0] - width / 2, door[0] + width / 2) for door in doors or [] for width in (*door, DOOR)[1:2])
    cuts = [-THICKNESS / 2, *(edge for gap in gaps for edge in gap), length + THICKNESS / 2]
    segments: Segments = []
    for begin, stop in zip(cuts[::2], cuts[1::2], strict=True):
        if stop - begin > 1e-6:
            x, y = start + along * (begin + stop) / 2
            corners = box_outline(x, y, stop - begin, THICKNESS, float(np.arctan2(along[1], along[0])))
            segments += [(*corners[i], *corners[(i + 1) % 4]) for i in range(4)]
    return segments


def shell(width: float, depth: float) -> Segments:
    corners = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]
    return [side for i in range(4) for side in wall(corners[i], corners[(i + 1) % 4])]


def splits(length: float, smallest: float, largest: float, rng: np.random.Generator) -> FloatArray:
    """Borders from 0 to length, at random distances of about smallest to largest."""
    parts = rng.uniform(smallest, largest, size=max(1, round(2 * length / (smallest + largest))))
    return np.concatenate(([0.0], np.cumsum(parts) * length / parts.sum()))


def furnish(plan: FloorPlan, boxes: int, circles: int, area: tuple[float, ...], rng: np.random.Generator) -> None:
    """Adds furniture at random places of the area x1, y1, x2, y2, clear of all routes; half lines up."""
    legs = np.array([(*p[:2], *q[:2]) for points in plan.routes.values() for p, q in pairwise(points)])
    walls = np.array(plan.walls)
    for _ in range(boxes):
        x, y = rng.uniform(area[:2], area[2:])
        width, depth = rng.uniform((0.4, 0.3), (1.6, 0.9))
        angle = rng.choice([0.0, np.pi / 2]) if rng.random() < 0.5 else rng.uniform(0, np.pi)
        outline = box_outline(x, y, width, depth, angle)
        edges = np.vstack([np.linspace(outline[i - 1], outline[i], 20) for i in range(4)])
        if clearances(legs, edges).min() > FREE and clearances(walls, edges).min() > 0.02:
            plan.boxes.append((x, y, width, depth, angle))
    for _ in range(circles):
        x, y = rng.uniform(area[:2], area[2:])
        radius = rng.uniform(0.12, 0.5)
        centre = np.array([(x, y)])
        if clearances(legs, centre)[0] > radius + FREE and clearances(walls, centre)[0] > radius + 0.02:
            plan.circles.append((x, y, radius))
