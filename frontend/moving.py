"""Which endpoints of a scan are of something that moves: seen by one scan where another has seen through.

A scan is an image of ranges by bearing. An endpoint that lies in front of what an earlier scan saw in its direction has
come there; what it hides from view behind something that the later scan sees through has at least not been seen to
stand still. Another robot that drives ahead in a corridor moves with us: matched to a map in which it is a wall, it
would be the only thing that says how far we have come.
"""

import math
from dataclasses import replace

import numpy as np
from numba import njit

from frontend import se2
from frontend.points import Points
from frontend.records import FloatArray

BINS = 360  # of bearing, a degree each
MARGIN = 0.10  # metres by which a beam must pass something to have seen through it
BACK = 0.3  # metres driven since the scan that a new one is compared with
SPACING = 0.05  # metres between those that are kept for it
LEAST = 4  # successive endpoints, that it is not a post between two beams
MOST = 0.3  # part of a scan: if more of it seems to move, it is the pose that is wrong


@njit(cache=True, nogil=True)
def _bin(x, y):  # type: ignore[no-untyped-def]
    return int(math.floor(math.atan2(y, x) * (BINS / (2.0 * math.pi)) + 0.5)) % BINS


@njit(cache=True, nogil=True)
def _see(ends, sensor, image):  # type: ignore[no-untyped-def]
    """Note the ends of beams in an image: the range to the nearest in each bin of bearing, 0 where there is none."""
    for i in range(len(ends)):
        x = ends[i, 0] - sensor[0]
        y = ends[i, 1] - sensor[1]
        b = _bin(x, y)
        r = math.sqrt(x * x + y * y)
        if image[b] == 0.0 or r < image[b]:
            image[b] = r


@njit(cache=True, nogil=True)
def _against(hits, sensor, pose, image, out):  # type: ignore[no-untyped-def]
    """For each endpoint seen from ``pose`` (3,): -1 if the ``image`` taken there sees through it, 1 if it hides it.

    ``pose`` is where that scan was taken, in the frame of the endpoints. Where the beams at both sides do not agree it
    is 0.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    for i in range(len(hits)):
        dx = hits[i, 0] - pose[0]
        dy = hits[i, 1] - pose[1]
        x = c * dx + s * dy - sensor[0]
        y = c * dy - s * dx - sensor[1]
        b = _bin(x, y)
        r = math.sqrt(x * x + y * y)
        nearest = np.inf
        farthest = 0.0
        for k in (b - 1, b, (b + 1) % BINS):
            if image[k] > 0.0:
                nearest = min(nearest, image[k])
                farthest = max(farthest, image[k])
        out[i] = 0
        if farthest > 0.0:
            if r < nearest - MARGIN:
                out[i] = -1
            elif r > farthest + MARGIN:
                out[i] = 1


@njit(cache=True, nogil=True)
def _moving(hits, sensor, image, old_hits, old_image, pose, within, out):  # type: ignore[no-untyped-def]
    """Mark the endpoints ``within`` metres that moved since an old scan at ``pose`` (3,) in its frame. How many."""
    back = np.empty(3)
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    back[0] = -c * pose[0] - s * pose[1]
    back[1] = s * pose[0] - c * pose[1]
    back[2] = -pose[2]
    # What the old scan saw and this one sees through is gone; 1 gone, 2 at least one endpoint still there.
    side = np.empty(max(len(hits), len(old_hits)), np.int8)
    _against(old_hits, sensor, back, image, side)
    gone = np.zeros(BINS, np.int8)
    for i in range(len(old_hits)):
        b = _bin(old_hits[i, 0] - sensor[0], old_hits[i, 1] - sensor[1])
        gone[b] = max(gone[b], 1 if side[i] == -1 else 2)
    _against(hits, sensor, pose, old_image, side)
    n = 0
    run = 0
    for i in range(len(hits) + 1):
        moved = False
        if i < len(hits):
            moved = side[i] == -1
            if side[i] == 1:
                dx = hits[i, 0] - pose[0]
                dy = hits[i, 1] - pose[1]
                b = _bin(c * dx + s * dy - sensor[0], c * dy - s * dx - sensor[1])
                moved = max(gone[b - 1], gone[b], gone[(b + 1) % BINS]) == 1
            moved = moved and math.hypot(hits[i, 0] - sensor[0], hits[i, 1] - sensor[1]) < within
            out[i] = False
        if moved:
            run += 1
            continue
        if run >= LEAST:
            out[i - run : i] = True
            n += run
        run = 0
    return n


class Movers:
    """Compares each scan with one taken a little earlier, along the path that the robot was tracked on."""

    def __init__(self) -> None:
        self._kept: list[tuple[Points, FloatArray, FloatArray, float]] = []  # with image, pose, and metres until then
        self._pose, self._way = np.zeros(3), 0.0
        self._last: Points | None = None

    def start(self, points: Points) -> None:
        """A path begins with a scan, or goes on in another map if that is what ``standing`` returned last."""
        if points is not self._last:
            self._kept.clear()
            self._compare(points)

    def standing(self, points: Points, motion: FloatArray, within: float = math.inf) -> Points:
        """What of a scan taken ``motion`` (3,) after the last one stands still, as far as can be told.

        Only what is ``within`` metres of the sensor is taken to move.
        """
        self._pose = se2.compose(self._pose, motion)
        self._way += math.hypot(motion[0], motion[1])
        return self._compare(points, within)

    def _compare(self, points: Points, within: float = math.inf) -> Points:
        image = np.zeros(BINS)
        _see(points.hits, points.sensor, image)
        _see(points.clear, points.sensor, image)
        while len(self._kept) > 1 and self._way - self._kept[1][3] >= BACK:
            del self._kept[0]
        result = points
        if self._kept and self._way - self._kept[0][3] >= BACK:
            old, old_image, pose, _ = self._kept[0]
            moving = np.empty(len(points.hits), np.bool_)
            at = se2.between(self._pose, pose)
            count = _moving(points.hits, points.sensor, image, old.hits, old_image, at, within, moving)
            if 0 < count <= MOST * len(points.hits):
                result = replace(points, hits=points.hits[~moving])
        if not self._kept or self._way - self._kept[-1][3] >= SPACING:
            self._kept.append((points, image, self._pose, self._way))
        self._last = result
        return result
