"""Made-up buildings. Each seed gives another building of the kind; every route of it can be driven."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from frontend.records import FloatArray
from tools.simulation.construction import DOOR, Points, furnish, shell, splits, wall
from tools.simulation.plan import FloorPlan


def corridor(seed: int = 0, length: float = 60.0, width: float = 2.2) -> FloorPlan:
    """A long corridor: little but door niches tells how far along it one is. Route ``there_and_back``."""
    rng = np.random.default_rng(seed)
    walls = wall((0, 0), (0, width)) + wall((length, 0), (length, width))
    for y, out in ((0.0, -0.2), (width, 0.2)):
        doors = [float(x) for x in np.arange(5.0, length - 3.0, 9.0) + rng.uniform(-1.5, 1.5, 1)]
        walls += wall((0, y), (length, y), [(x,) for x in doors])
        walls += [side for x in doors for side in wall((x - DOOR / 2, y + out), (x + DOOR / 2, y + out))]
    middle = width / 2
    ends = (1.5, middle), (length - 1.5, middle)
    return FloorPlan("corridor", walls, routes={"there_and_back": [ends[0], (*ends[1], 2.0), ends[0]]})


def hall(seed: int = 0, width: float = 30.0, depth: float = 22.0) -> FloorPlan:
    """A big hall with a few columns: walls are far. Route ``tour``, closed."""
    rng = np.random.default_rng(seed)
    plan = FloorPlan("hall", shell(width, depth))
    plan.circles.extend((width / 2 + x, depth / 2 + y, 0.35) for x, y in ((5, 0), (-5, 0), (0, 5), (0, -5)))
    m = 4.0
    right, top = width - m, depth - m
    plan.routes["tour"] = [(m, m), (right, m), (right, top), (width / 2, depth / 2, 3.0), (m, top), (m, m)]
    furnish(plan, 14, 6, (0.8, 0.8, width - 0.8, depth - 0.8), rng)
    return plan


def cluttered(seed: int = 0, room: float = 7.0) -> FloorPlan:
    """Two by three rooms full of furniture, joined by doors in a ring. Route ``tour``, closed."""
    rng = np.random.default_rng(seed)
    width, depth = 3 * room, 2 * room
    walls = shell(width, depth)
    doors = rng.uniform(1.5, room - 1.5, size=6)
    for i in (1, 2):
        walls += wall((i * room, 0), (i * room, depth), [(doors[i],), (room + doors[i + 2],)])
    walls += wall((0, room), (width, room), [(doors[0],), (2 * room + doors[5],)])
    plan = FloorPlan("cluttered", walls)
    low, high, left, right = room / 2, room * 1.5, float(doors[0]), 2 * room + float(doors[5])
    plan.routes["tour"] = [
        (left, low),
        *_through(room, float(doors[1])),
        (1.5 * room, low, 2.0),
        *_through(2 * room, float(doors[2])),
        (right, low),
        (right, high),
        *_through(2 * room, room + float(doors[4]))[::-1],
        (1.5 * room, high, 2.0),
        *_through(room, room + float(doors[3]))[::-1],
        (left, high),
        (left, low),
    ]
    furnish(plan, 90, 30, (0.4, 0.4, width - 0.4, depth - 0.4), rng)
    return plan


def _through(x: float, y: float) -> Points:
    """Waypoints that pass a door in a wall along y, left to right."""
    return [(x - 0.7, y), (x + 0.7, y)]


def factory(seed: int = 0, width: float = 60.0, depth: float = 40.0) -> FloorPlan:
    """A shop floor: rows of machines, columns, and long aisles that look alike. Route ``aisles``, closed."""
    rng = np.random.default_rng(seed)
    plan = FloorPlan(
        "factory",
        shell(width, depth) + wall((width * 0.7, 0), (width * 0.7, depth * 0.35), [(4, 3.0), (12, 3.0)]),
    )
    aisles = np.linspace(4.0, depth - 4.0, 5)
    left, right = 4.0, width - 4.0
    snake: Points = [(left, aisles[0])]
    for i, y in enumerate(aisles):
        snake += [(x, float(y)) for x in ((left, right) if i % 2 == 0 else (right, left))]
    plan.routes["aisles"] = [*dict.fromkeys(snake), (left, float(aisles[-1])), (left, float(aisles[0]))]
    plan.circles.extend((x, y, 0.3) for x in np.arange(10, width - 5, 10.0) for y in aisles[:-1] + 1.6)
    for y in (aisles[1:] + aisles[:-1]) / 2:
        x = 7.0
        while x < width - 9.0:
            length, height = rng.uniform((1.5, 1.0), (5.0, 3.0))
            if rng.random() < 0.75 and abs(x + length / 2 - width * 0.7) > length / 2 + 0.5:
                plan.boxes.append((x + length / 2, y + rng.uniform(-0.5, 0.5), length, height, rng.normal(0, 0.03)))
            x += length + rng.uniform(0.5, 2.5)
    return plan


def loop(seed: int = 0, width: float = 32.0, depth: float = 20.0) -> FloorPlan:
    """A ring of corridors between small rooms, most doors shut. Routes ``ring`` and ``tour``, closed."""
    return _ring(
        "loop",
        seed,
        width,
        depth,
        room=3.5,
        rooms=(3.0, 4.5),
        corridor_width=1.8,
        visits=3,
        shut=0.8,
        furniture=30,
    )


def office(seed: int = 0, width: float = 40.0, depth: float = 30.0) -> FloorPlan:
    """An office floor: rooms on both sides of a ring of corridors. Routes ``ring`` and ``tour``, closed."""
    return _ring(
        "office",
        seed,
        width,
        depth,
        room=5.5,
        rooms=(4.0, 7.5),
        corridor_width=2.0,
        visits=7,
        shut=0.3,
        furniture=180,
    )


def _ring(
    name: str,
    seed: int,
    width: float,
    depth: float,
    *,
    room: float,
    rooms: tuple[float, float],
    corridor_width: float,
    visits: int,
    shut: float,
    furniture: int,
) -> FloorPlan:
    """Outer rooms ``room`` deep, a ring of corridors, and rooms in the core.

    Going around, a side of the ring is a line along which doors lie; its rooms are outside (below the line in
    the side's own frame) or in the core (above it).
    """
    rng = np.random.default_rng(seed)
    inner, outer = room + corridor_width, room
    core_x, core_y = (inner, width - inner), (inner, depth - inner)
    walls = shell(width, depth)
    doors: list[tuple[FloatArray, FloatArray]] = []  # of each room: its door, and the way in (unit vector)

    def row(
        a: tuple[float, float], b: tuple[float, float], into: tuple[float, float], deep: float, skip: float
    ) -> None:
        """Rooms behind the line from a to b, with doors in it, none nearer to an end than skip."""
        start, end, inward = np.array(a), np.array(b), np.array(into)
        length = float(np.hypot(*(end - start)))
        along = (end - start) / length
        borders = splits(length, *rooms, rng)
        openings: Points = []
        for low, high in pairwise(borders):
            reach = max(low + 0.8, skip + 0.8), min(high - 0.8, length - skip - 0.8)
            if reach[0] < reach[1]:
                at = float(rng.uniform(*reach))
                openings.append((at,))
                doors.append((start + along * at, inward))
        walls.extend(wall(a, b, openings))
        for border in borders[1:-1]:
            foot = start + along * border
            walls.extend(wall((foot[0], foot[1]), tuple(foot + inward * deep)))

    row((0, outer), (width, outer), (0, -1), room, skip=room)
    row((width - outer, outer), (width - outer, depth - outer), (1, 0), room, skip=0)
    row((width, depth - outer), (0, depth - outer), (0, 1), room, skip=room)
    row((outer, depth - outer), (outer, outer), (-1, 0), room, skip=0)
    half = (core_y[1] - core_y[0]) / 2
    row((core_x[0], core_y[0]), (core_x[1], core_y[0]), (0, 1), half, skip=0)
    row((core_x[1], core_y[1]), (core_x[0], core_y[1]), (0, -1), half, skip=0)
    middle = core_y[0] + half
    walls += wall((core_x[0], middle), (core_x[1], middle))
    walls += wall((core_x[0], core_y[0]), (core_x[0], core_y[1])) + wall((core_x[1], core_y[0]), (core_x[1], core_y[1]))

    near = room + corridor_width / 2
    right, top = width - near, depth - near
    ring: Points = [(near, near), (right, near), (right, top), (near, top), (near, near)]
    visited = set(np.linspace(0, len(doors) - 1, visits).round().astype(int).tolist())
    for i, (door, inward) in enumerate(doors):
        if i not in visited and rng.random() < shut:
            leaf = np.array((-inward[1], inward[0])) * DOOR / 2
            walls.append((*(door - leaf), *(door + leaf)))
    tour = _with_visits(ring, [doors[i] for i in sorted(visited)], corridor_width / 2, rng)
    plan = FloorPlan(name, walls, routes={"tour": tour, "ring": ring})
    furnish(plan, furniture, furniture // 6, (0.3, 0.3, width - 0.3, depth - 0.3), rng)
    return plan


def _with_visits(
    corners: Points, doors: list[tuple[FloatArray, FloatArray]], half: float, rng: np.random.Generator
) -> Points:
    """From a room around the ring, with a detour into each of the rooms, and half a lap more.

    Args:
        corners: of the ring, the first again at the end.
        doors: of the rooms to visit: centre of the door, and the unit vector that leads in.
        half: metres from the ring to its walls.
        rng: where in a room the robot looks around.
    """
    tour: Points = []
    for a, b in pairwise(corners):
        start, leg = np.array(a), np.array(b) - np.array(a)
        length = float(np.hypot(*leg))
        along = leg / length
        tour.append(a)
        stops = []
        for door, inward in doors:
            position = float((door - start) @ along)
            beside = np.allclose(door - inward * half, start + along * position)
            if beside and 0 <= position <= length:
                stops.append((position, inward))
        for position, inward in sorted(stops, key=lambda stop: stop[0]):
            before = start + along * position
            door_way = tuple(before + inward * (half + 0.4))
            inside = before + inward * (half + rng.uniform(1.6, 2.4)) + along * rng.uniform(-0.3, 0.3)
            tour += [tuple(before), door_way, (*inside, 2.0), door_way, tuple(before)]
    first = next(i for i, point in enumerate(tour) if len(point) == 3)
    around = tour[first:] + tour[: first - 1]
    return [*around, *[point for point in around if point in corners][:2]]


BUILDINGS: dict[str, Callable[[int], FloorPlan]] = {
    "corridor": corridor,
    "hall": hall,
    "cluttered": cluttered,
    "loop": loop,
    "office": office,
    "factory": factory,
}
