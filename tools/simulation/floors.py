"""Made-up floors for teams: a route for each robot, named like it."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from frontend.records import FloatArray
from tools.simulation.construction import Points, Segments, furnish, shell, wall
from tools.simulation.plan import FloorPlan
from tools.simulation.team import robot_names

LANE = 0.5  # metres that robots keep to the right of a corridor's middle
CORRIDOR = 2.4  # width in blocks, metres


def wings(seed: int = 0) -> FloorPlan:
    """Three wings, each a ring of corridors around rooms, that meet in a lobby; only the furniture is random.

    Routes ``red`` (west), ``blue`` (east) and ``green`` (north): each robot explores its own wing from a room in it,
    comes to the lobby, and goes home the other way round.
    """
    plan = FloorPlan("wings", _west() + _east() + _north() + _middle())
    plan.circles.extend((x, y, 0.3) for x, y in ((22.4, 10.5), (25.5, 5.2), (29.4, 5.2)))
    plan.routes["red"] = [
        (5.5, 9.6), (3.2, 9.0), (0.9, 9.0), (1.0, 1.0), (5.0, 1.0), (5.0, 4.0, 1.0), (5.0, 1.0), (13.2, 1.0),
        (13.2, 3.8, 1.0), (13.2, 1.0), (17.0, 1.0), (17.0, 6.2), (20.0, 6.2), (23.6, 7.0, 20.0), (20.6, 10.4),
        (19.4, 13.4), (13.5, 13.3), (13.5, 16.4, 1.0), (13.5, 13.3), (1.0, 13.3), (1.0, 4.0),
    ]  # fmt: skip
    plan.routes["blue"] = [
        (48.5, 8.2), (50.6, 9.0), (53.0, 9.0), (53.0, -2.0), (43.5, -2.0), (43.5, 1.5, 1.0), (43.5, -2.0),
        (36.8, -2.0), (36.8, 1.5, 1.0), (36.8, -2.0), (33.1, -2.0), (33.1, 7.0), (30.2, 7.0), (27.0, 7.2, 4.0),
        (30.2, 10.2), (31.4, 12.7), (41.0, 12.9), (41.0, 16.0, 1.0), (41.0, 12.9), (53.0, 12.9), (53.0, 8.2),
    ]  # fmt: skip
    plan.routes["green"] = [
        (28.5, 34.5), (23.0, 34.8, 1.0), (20.0, 33.0), (20.0, 29.0), (20.0, 22.6), (23.2, 22.6, 1.0), (20.0, 22.6),
        (20.0, 17.4), (22.6, 17.4, 1.0), (20.0, 17.4), (20.0, 14.5), (21.2, 12.6), (25.4, 10.8, 3.0), (29.2, 12.4),
        (30.0, 15.0), (30.0, 23.2), (32.8, 23.2, 1.0), (30.0, 23.2), (30.0, 29.0), (27.0, 29.2), (27.0, 33.0),
        (24.5, 34.0),
    ]  # fmt: skip
    rng = np.random.default_rng(seed)
    areas = ((0.3, 0.3, 17.7, 19.2), (18.5, 4.3, 31.5, 13.9), (14.8, 14.5, 33.7, 36.7), (32.3, -2.7, 53.7, 19.2))
    for area, boxes in zip(areas, (55, 8, 65, 60), strict=True):
        furnish(plan, boxes, boxes // 6, area, rng)
    return plan


def _west() -> Segments:
    """Corridors around four rooms, x 0 to 18, y 0 to 14.2."""
    walls = wall((0, 0), (18, 0)) + wall((0, 0), (0, 19.5)) + wall((18, 0), (18, 12), [(6.2, 2.4)])
    walls += wall((2, 2), (16, 2), [(3.0,), (11.2,)]) + wall((2, 12), (16, 12), [(5.2, 1.2), (9.4,)])
    walls += wall((2, 2), (2, 12), [(7.0,)]) + wall((16, 2), (16, 12), [(6.8,)])
    return walls + wall((8.2, 2), (8.2, 12), [(2.2,)]) + wall((2, 6.6), (16, 6.6))


def _east() -> Segments:
    """Corridors around six rooms, x 32 to 54, y -3 to 14.2."""
    walls = wall((32, -3), (54, -3)) + wall((54, -3), (54, 19.5)) + wall((32, -3), (32, 12), [(10.0, 2.4)])
    walls += wall((34.2, -1), (52, -1), [(2.6,), (9.3,), (15.5, 1.2)]) + wall((34.2, 12), (52, 12), [(4.5,), (11.0,)])
    walls += wall((34.2, -1), (34.2, 12), [(9.5,)]) + wall((52, -1), (52, 12), [(2.4,), (10.0,)])
    walls += wall((40.6, -1), (40.6, 12), [(9.0,)]) + wall((46.8, -1), (46.8, 12))
    return walls + wall((34.2, 4.4), (46.8, 4.4)) + wall((46.8, 5.6), (52, 5.6))


def _north() -> Segments:
    """Corridors around four rooms, x 19 to 31, y 14.2 to 30; a lecture hall beyond."""
    walls = wall((19, 14.2), (19, 30), [(6.3,), (11.5,)]) + wall((31, 14.2), (31, 30), [(3.5,), (9.0, 1.2), (13.6,)])
    walls += wall((21, 14.2), (21, 28), [(3.2,), (8.4,)]) + wall((29, 14.2), (29, 28), [(5.5,), (11.0,)])
    walls += wall((21, 28), (29, 28)) + wall((21, 20), (29, 20)) + wall((25.4, 14.2), (25.4, 28))
    walls += wall((16, 30), (34, 30), [(4.0, 1.2), (11.0, 1.2)]) + wall((16, 37), (34, 37))
    walls += wall((16, 30), (16, 37)) + wall((34, 30), (34, 37))
    for x in (14.5, 35.5):
        walls += wall((x, 19.5), (x, 30))
        walls += [side for y in (24.0, 30.0) for side in wall((min(x, 31), y), (max(x, 19), y))]
    return walls


def _middle() -> Segments:
    """The lobby, the main corridor's north side, and the rooms behind it."""
    walls = wall((18, 4), (32, 4)) + wall((0, 19.5), (19, 19.5)) + wall((31, 19.5), (54, 19.5))
    doors = [(3.4,), (7.0,), (13.5, 1.2), (20.0, 2.0), (30.0, 2.0), (34.6,), (41.0, 1.2), (48.5,)]
    walls += wall((0, 14.2), (54, 14.2), doors)
    return walls + [side for x in (5.2, 10.5, 37.8, 45.0) for side in wall((x, 14.2), (x, 19.5))]


def blocks(seed: int = 0, columns: int = 9, rows: int = 7, robots: int = 50, length: float = 450.0) -> FloorPlan:
    """A big floor for many robots: a grid of corridors with rooms between. One route for each robot.

    Every robot walks at random from crossing to crossing, never straight back, and keeps to the right.

    Args:
        seed: of everything random.
        columns: corridors along y.
        rows: corridors along x.
        robots: number of routes, named as ``robot_names`` names them.
        length: of a route, metres, at least.
    """
    rng = np.random.default_rng(seed)
    xs, ys = (CORRIDOR / 2 + np.cumsum([0.0, *rng.uniform(11, 18, count - 1)]) for count in (columns, rows))
    walls = shell(xs[-1] + CORRIDOR / 2, ys[-1] + CORRIDOR / 2)
    half = CORRIDOR / 2
    for left, right in pairwise(xs):
        for low, high in pairwise(ys):
            walls += _block(left + half, low + half, right - half, high - half, rng)
    plan = FloorPlan("blocks", walls)
    starts = rng.permutation(columns * rows)
    for i, name in enumerate(robot_names(robots)):
        start = divmod(int(starts[i % len(starts)]), rows)
        plan.routes[name] = _walk(xs, ys, start, length, rng)
    area = (0.3, 0.3, xs[-1] + half - 0.3, ys[-1] + half - 0.3)
    furnish(plan, 10 * (columns - 1) * (rows - 1), (columns - 1) * (rows - 1), area, rng)
    return plan


def _block(left: float, low: float, right: float, high: float, rng: np.random.Generator) -> Segments:
    """Four rooms with doors to the corridors around, some shut, some wide."""
    corners = [(left, low), (right, low), (right, high), (left, high)]
    walls: Segments = []
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        length = abs(b[0] - a[0]) + abs(b[1] - a[1])
        doors: Points = []
        for part in (0.0, 0.5):
            if rng.random() < 0.6:
                width = float(rng.choice([0.9, 1.4, 2.0]))
                doors.append(((part + rng.uniform(0.15, 0.35)) * length, width))
        walls += wall(a, b, doors)
    x, y = left + rng.uniform(0.42, 0.58) * (right - left), low + rng.uniform(0.42, 0.58) * (high - low)
    return walls + wall((x, low), (x, high)) + wall((left, y), (right, y))


def _walk(xs: FloatArray, ys: FloatArray, start: tuple[int, int], length: float, rng: np.random.Generator) -> Points:
    """Waypoints of a random walk over the crossings, in the right lane."""
    steps = ((1, 0), (0, 1), (-1, 0), (0, -1))
    at, heading, driven = start, -1, 0.0
    crossings = [at]
    while driven < length:
        ways = [
            way
            for way, (i, j) in enumerate(steps)
            if 0 <= at[0] + i < len(xs) and 0 <= at[1] + j < len(ys) and (heading < 0 or way != (heading + 2) % 4)
        ]
        heading = ways[rng.integers(len(ways))]
        step = steps[heading]
        at = (at[0] + step[0], at[1] + step[1])
        before = crossings[-1]
        driven += abs(xs[at[0]] - xs[before[0]]) + abs(ys[at[1]] - ys[before[1]])
        crossings.append(at)
    middle = np.array([(xs[i], ys[j]) for i, j in crossings])
    ways_taken = np.diff(middle, axis=0)
    ways_taken /= np.hypot(ways_taken[:, 0], ways_taken[:, 1])[:, None]
    right = LANE * np.column_stack((ways_taken[:, 1], -ways_taken[:, 0]))
    into, out = np.vstack((right[:1], right)), np.vstack((right, right[-1:]))
    straight = (into * out).sum(axis=1) > LANE**2 / 2
    points = middle + np.where(straight[:, None], out, into + out)
    return [(x, y) for x, y in points.tolist()]


FLOORS: dict[str, Callable[[int], FloorPlan]] = {"wings": wings, "blocks": blocks}
