"""What moves is told from what stands still."""

import numpy as np
import numpy.typing as npt

from frontend import se2
from frontend.moving import BACK, Movers
from frontend.points import Points, points_of
from frontend.records import FloatArray
from tests.frontend.simulated import CORRIDOR, drive, scan_of
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
