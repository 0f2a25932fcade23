"""How the robot drives a route: straight legs, arcs around corners, turns on the spot, stops."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from frontend.records import FloatArray
from tools.simulation.plan import FloorPlan, SimulationError
from tools.simulation.poses import compose, exponential
from tools.simulation.raycast import clearances


@dataclass(frozen=True)
class Driving:
    """The driver's habits; the defaults suit a Pioneer indoors.

    Attributes:
        speed: m/s on straight legs.
        turn_rate: rad/s in curves and on the spot.
        acceleration: m/s^2 along the path.
        turn_acceleration: rad/s^2 on the spot.
        corner_radius: of the arc around a corner, metres; shorter legs get tighter arcs.
        spot_turn: corners sharper than this (radians) and those with a stop are turned on the spot.
        wander: nobody drives dead straight: points on long legs are moved sideways by this standard deviation, metres.
        wander_every: about this many metres apart.
        radius: the robot's, metres: no wall may come nearer to its centre.
    """

    speed: float = 0.7
    turn_rate: float = 0.8
    acceleration: float = 0.5
    turn_acceleration: float = 1.5
    corner_radius: float = 0.6
    spot_turn: float = 2.0
    wander: float = 0.04
    wander_every: float = 3.0
    radius: float = 0.25


@dataclass(frozen=True, slots=True)
class _Motion:
    """A stretch driven with constant curvature: ``length`` units, ``direction`` (vx, omega) per unit."""

    length: float
    direction: tuple[float, float]
    cap: float  # units per second
    acceleration: float  # units per second^2
    stops: bool  # starts and ends at rest


def drive(
    plan: FloorPlan,
    route: str,
    driving: Driving,
    rate: float,
    rng: np.random.Generator,
    laps: int = 1,
    hours: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """The true poses of a robot on a route.

    Args:
        plan: the building.
        route: name of a route of it.
        driving: how it is driven.
        rate: poses a second.
        rng: for the wander.
        laps: times the route is driven; from its last waypoint the robot drives straight to the first.
        hours: as many laps as fill about this time, if that is more.

    Returns:
        times (N,) seconds from 0, and plan_T_robot (N, 3).

    Raises:
        SimulationError: unknown route, fewer than two distinct waypoints, or a wall nearer than the robot's radius.
    """
    points = plan.route(route)
    if laps < 1 or len(points) < 2:
        raise SimulationError(f"plan {plan.name!r}, route {route!r}: needs two waypoints and one lap at least")
    if laps > 1 or hours > 0:
        lap = points if _same_place(points[0], points[-1]) else np.vstack((points, points[0] * (1, 1, 0)))
        steady = replace(driving, wander=0.0)
        seconds = _phases(_motions(lap, plan.name, route, steady, np.random.default_rng(0))[1])[:, 0].sum()
        laps = max(laps, math.ceil(hours * 3600 / seconds))
        points = np.vstack((lap, *[lap[1:]] * (laps - 1)))
    start, motions = _motions(points, plan.name, route, driving, rng)
    times, poses = _sample(start, motions, rate)
    _check_clearance(plan, route, poses, driving.radius)
    return times, poses


def _same_place(a: FloatArray, b: FloatArray) -> bool:
    return bool(np.hypot(*(a - b)[:2]) < 1e-6)


def _check_clearance(plan: FloorPlan, route: str, poses: FloatArray, radius: float) -> None:
    free = clearances(plan.segments, poses[:, :2])
    worst = int(np.argmin(free))
    if free[worst] < radius:
        x, y, _ = poses[worst]
        raise SimulationError(
            f"plan {plan.name!r}, route {route!r}: at ({x:.2f}, {y:.2f}) something is "
            f"{free[worst]:.2f} m from the robot's centre and its radius is {radius:.2f} m: move the waypoints there"
        )


def _wandering(points: FloatArray, driving: Driving, rng: np.random.Generator) -> FloatArray:
    """The waypoints with extra ones on long legs, moved sideways a little."""
    result = [points[:1]]
    for a, b in pairwise(points):
        leg = b[:2] - a[:2]
        length = float(np.hypot(*leg))
        extra = max(0, round(length / driving.wander_every) - 1)
        along = np.arange(1, extra + 1) / (extra + 1)
        aside = driving.wander * np.clip(rng.standard_normal(extra), -2, 2)
        normal = np.array((-leg[1], leg[0])) / length
        between = a[:2] + along[:, None] * leg + aside[:, None] * normal
        result += [np.column_stack((between, np.zeros(extra))), b[None]]
    return np.vstack(result)


def _motions(
    points: FloatArray, plan: str, route: str, driving: Driving, rng: np.random.Generator
) -> tuple[FloatArray, list[_Motion]]:
    """The start pose (3,) and what is driven from there, in order."""
    repeated = np.hypot(*np.diff(points[:, :2], axis=0).T) < 1e-6
    if repeated.any():
        x, y, _ = points[int(np.argmax(repeated))]
        raise SimulationError(f"plan {plan!r}, route {route!r}: waypoint ({x:g}, {y:g}) comes twice in a row")
    points = _wandering(points, driving, rng)
    legs = np.diff(points[:, :2], axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    headings = np.arctan2(legs[:, 1], legs[:, 0])
    turns = np.pi - (np.pi - np.diff(headings)) % (2 * np.pi)

    motions = [_stop(points[0, 2])]
    used = 0.0  # metres of the coming leg already covered by the arc before it
    for i, turn in enumerate(turns):
        stop = points[i + 1, 2]
        if stop > 0 or abs(turn) > driving.spot_turn:
            motions += [_straight(lengths[i] - used, driving), _stop(stop), _spot(turn, driving)]
            used = 0.0
        else:
            room = min(lengths[i], lengths[i + 1]) / 2
            tangent = min(driving.corner_radius * math.tan(abs(turn) / 2), room)
            motions += [_straight(lengths[i] - used - tangent, driving), _arc(turn, tangent, driving)]
            used = tangent
    motions += [_straight(lengths[-1] - used, driving), _stop(points[-1, 2])]
    start = np.array((*points[0, :2], headings[0]))
    return start, [motion for motion in motions if motion.length > 1e-9]


def _straight(length: float, driving: Driving) -> _Motion:
    return _Motion(length, (1.0, 0.0), driving.speed, driving.acceleration, stops=False)


def _arc(turn: float, tangent: float, driving: Driving) -> _Motion:
    if abs(turn) < 1e-9:
        return _straight(2 * tangent, driving)
    radius = tangent / math.tan(abs(turn) / 2)
    cap = min(driving.speed, driving.turn_rate * radius)
    return _Motion(radius * abs(turn), (1.0, math.copysign(1 / radius, turn)), cap, driving.acceleration, stops=False)


def _spot(turn: float, driving: Driving) -> _Motion:
    direction = (0.0, math.copysign(1.0, turn))
    return _Motion(abs(turn), direction, driving.turn_rate, driving.turn_acceleration, stops=True)


def _stop(seconds: float) -> _Motion:
    return _Motion(seconds, (0.0, 0.0), 1.0, math.inf, stops=True)


def _phases(motions: list[_Motion]) -> FloatArray:
    """(3M, 3) duration, first speed, acceleration: every motion speeds up, keeps its speed, slows down."""
    count = len(motions)
    ends = np.zeros(count + 1)  # speed where one motion becomes the next
    for i in range(1, count):
        if not (motions[i - 1].stops or motions[i].stops):
            ends[i] = min(motions[i - 1].cap, motions[i].cap)
            ends[i] = min(
                ends[i], math.sqrt(ends[i - 1] ** 2 + 2 * motions[i - 1].acceleration * motions[i - 1].length)
            )
    for i in range(count - 1, 0, -1):
        if not motions[i].stops:
            reach = math.sqrt(ends[i + 1] ** 2 + 2 * motions[i].acceleration * motions[i].length)
            ends[i] = min(ends[i], reach)
    phases = np.zeros((count, 3, 3))
    for i, motion in enumerate(motions):
        if math.isinf(motion.acceleration):
            phases[i, 1] = motion.length / motion.cap, motion.cap, 0.0
            continue
        u, w, a = ends[i], ends[i + 1], motion.acceleration
        peak = min(motion.cap, math.sqrt(a * motion.length + (u * u + w * w) / 2))
        cruise = motion.length - (2 * peak * peak - u * u - w * w) / (2 * a)
        phases[i] = ((peak - u) / a, u, a), (max(cruise, 0.0) / peak, peak, 0.0), ((peak - w) / a, peak, -a)
    return phases.reshape(-1, 3)


def _sample(start: FloatArray, motions: list[_Motion], rate: float) -> tuple[FloatArray, FloatArray]:
    """Times and poses at a constant rate, from the first moment to the last."""
    twists = np.array([(motion.direction[0], 0.0, motion.direction[1]) for motion in motions])
    lengths = np.array([motion.length for motion in motions])
    begins = np.empty((len(motions), 3))  # pose at the start of each motion
    begins[0] = start
    whole = exponential(twists * lengths[:, None])
    for i in range(len(motions) - 1):
        begins[i + 1] = compose(begins[i], whole[i])

    durations, speeds, accelerations = _phases(motions).T
    phase_begins = np.concatenate(([0.0], np.cumsum(durations)))
    distances = (speeds * durations + accelerations * durations**2 / 2).reshape(-1, 3)
    covered = np.column_stack((np.zeros(len(motions)), np.cumsum(distances[:, :2], axis=1))).ravel()

    times = np.arange(int(phase_begins[-1] * rate) + 1) / rate
    phase = np.clip(np.searchsorted(phase_begins, times, side="right") - 1, 0, len(durations) - 1)
    since = times - phase_begins[phase]
    progress = covered[phase] + speeds[phase] * since + accelerations[phase] * since**2 / 2
    motion = phase // 3
    progress = np.clip(progress, 0.0, lengths[motion])
    return times, compose(begins[motion], exponential(twists[motion] * progress[:, None]))
