"""What moves is told from what stands still."""

import numpy as np
import numpy.typing as npt

from frontend import se2
from frontend.local_slam import LocalSlam
from frontend.moving import BACK, Movers
from frontend.parameters import FilterParameters
from frontend.points import Points, points_of
from frontend.records import FloatArray
from tests.frontend.simulated import CORRIDOR, drive, scan_of
from tools.simulation import FloorPlan
from tools.simulation.laser import LMS200, measure

STEP = 0.14  # metres between two scans


def led(steps: int, speed: float, distance: float) -> tuple[FloatArray, list[Points], list[npt.NDArray[np.bool_]]]:
    """Poses along a bare corridor, and the scans there, without and with another robot on ahead.

    ``speed`` of the other in metres a scan (negative: it comes), ``distance`` to it at first.
    """
    along = STEP * np.arange(steps)
    poses = np.column_stack((along, np.zeros(steps), np.zeros(steps)))
    others = np.column_stack((distance + speed * np.arange(steps), np.full(steps, 0.2)))[:, None, :]
    bare, full = (
        measure(LMS200, CORRIDOR.segments, poses, np.random.default_rng(3), around) for around in (None, others)
    )
    # Of every endpoint, whether it is on the other robot.
    seen = [f[f < 25.0] != b[f < 25.0] for b, f in zip(bare, full, strict=True)]
    return poses, [points_of(scan_of(ranges), 25.0, 181) for ranges in full], seen


def test_a_robot_ahead_is_left_out_and_the_walls_stay() -> None:
    for speed, distance in ((STEP, 2.5), (-STEP, 9.0), (0.0, 5.0)):
        poses, points, bodies = led(24, speed, distance)
        movers = Movers()
        movers.start(points[0])
        hidden = body = walls = lost = 0
        for i in range(1, len(points)):
            standing = movers.standing(points[i], se2.between(poses[i - 1], poses[i]))
            kept = {tuple(hit) for hit in standing.hits.tolist()}
            gone = np.array([tuple(hit) not in kept for hit in points[i].hits.tolist()])
            if poses[i, 0] > BACK + STEP and bodies[i].sum() >= 6:
                hidden, body = hidden + int((gone & bodies[i]).sum()), body + int(bodies[i].sum())
            walls, lost = walls + int((~bodies[i]).sum()), lost + int((gone & ~bodies[i]).sum())
        assert body > 50
        assert hidden > 0.8 * body if speed else hidden < 0.1 * body
        assert lost < 0.02 * walls


def test_where_nothing_moves_nearly_everything_stays() -> None:
    log, points, _ = drive()
    movers = Movers()
    movers.start(points[0])
    kept = [
        len(movers.standing(points[i], se2.between(log.poses[i - 1], log.poses[i])).hits) for i in range(1, len(points))
    ]
    assert sum(kept) > 0.99 * sum(len(p.hits) for p in points[1:])


def test_a_path_that_begins_anew_has_nothing_to_compare_with() -> None:
    poses, points, _ = led(8, STEP, 2.5)
    movers = Movers()
    movers.start(points[0])
    last = points[0]
    for i in range(1, 6):
        last = movers.standing(points[i], se2.between(poses[i - 1], poses[i]))
    assert len(last.hits) < len(points[5].hits)
    movers.start(last)  # the same scan: the path goes on, in another map
    assert movers.standing(points[6], se2.between(poses[5], poses[6])) is not points[6]
    movers.start(points[6])
    assert movers.standing(points[7], se2.between(poses[6], poses[7])) is points[7]


def test_only_what_is_near_enough_is_taken_to_move() -> None:
    poses, points, bodies = led(20, STEP, 1.5)
    motion = se2.between(poses[-2], poses[-1])
    for within, moves in ((1.0, False), (2.5, True)):
        movers = Movers()
        movers.start(points[0])
        for i in range(1, 19):
            movers.standing(points[i], se2.between(poses[i - 1], poses[i]))
        left = len(points[-1].hits) - len(movers.standing(points[-1], motion, within).hits)
        assert bodies[-1].any()
        assert (left > 0) == moves


def test_a_body_that_fills_much_of_the_view_stays_out_of_the_map() -> None:
    step, steps, width = 0.25, 32, 34.0
    doors = [(x, y, x + 2.2, y) for x in np.arange(-12.0, 30.0, 3.0) for y in (-1.1, 1.1)]
    rooms = [(-12.0, -5.0, 30.0, -5.0), (-12.0, 5.0, 30.0, 5.0)]
    plan = FloorPlan("doors", [*doors, *rooms])
    poses = np.zeros((steps, 3))
    poses[:, 0] = step * np.arange(steps)
    # The other is behind at first, then comes from the side and drives as fast as we do, a hand's breadth ahead.
    away = np.where(np.arange(steps) < 6, -3.0, 0.5)
    others = np.column_stack((poses[:, 0] + away, np.zeros(steps)))[:, None, :]
    ranges = measure(LMS200, plan.segments, poses, np.random.default_rng(3), others)
    points = [points_of(scan_of(r), 25.0, 181) for r in ranges]
    parameters = FilterParameters(particles=8, map_width=width)
    slam = LocalSlam(parameters, 0)
    slam.begin(points[0], np.zeros((parameters.particles, 3)))
    for i in range(1, steps):
        tracked = slam.add(points[i], np.array([step, 0.0, 0.0]))
        assert abs(tracked.pose[0] - poses[i, 0]) < 0.4
