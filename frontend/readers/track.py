"""Odometry at the time of a scan, for the formats that log the two apart."""

from collections import deque
from collections.abc import Iterator
from itertools import pairwise

from frontend.readers.scans import RawScan, wrap
from frontend.records import Odometry

KEPT = 1000
WAITING_AT_MOST = 50


class OdometryTrack:
    """Gives each scan the odometry interpolated at its time, in the order the scans came.

    A scan newer than the newest odometry waits for the next one, fifty scans at most. Where no two readings of the
    odometry enclose its time, it takes the one nearest in time. When the odometry's clock steps back, the track
    starts anew: what lies on the two sides of the step is never mixed.
    """

    def __init__(self) -> None:
        self._past: deque[Odometry] = deque(maxlen=KEPT)
        self._waiting: deque[RawScan] = deque()

    @property
    def started(self) -> bool:
        """Whether there has been any odometry; ``place`` needs it."""
        return bool(self._past)

    def add(self, odometry: Odometry) -> Iterator[RawScan]:
        """Take a reading of the odometry; yields the scans that waited for it."""
        if self._past and odometry.time < self._past[-1].time:
            yield from self.rest()
            self._past.clear()
        self._past.append(odometry)
        yield from self._settled()

    def place(self, scan: RawScan) -> Iterator[RawScan]:
        """Take a scan, whose ``odometry`` is filled in; yields the scans that are settled now."""
        self._waiting.append(scan)
        yield from self._settled()

    def rest(self) -> Iterator[RawScan]:
        """Yield the scans that still wait."""
        while self._waiting:
            yield self._placed(self._waiting.popleft())

    def _settled(self) -> Iterator[RawScan]:
        newest = self._past[-1].time
        # Written so that a time that is NaN does not wait.
        while self._waiting and (not self._waiting[0].time > newest or len(self._waiting) > WAITING_AT_MOST):
            yield self._placed(self._waiting.popleft())

    def _placed(self, scan: RawScan) -> RawScan:
        for after, before in pairwise(reversed(self._past)):
            if before.time <= scan.time <= after.time:
                share = (scan.time - before.time) / (after.time - before.time) if after.time > before.time else 1.0
                step = after.pose - before.pose
                step[2] = wrap(step[2])
                scan.odometry[:] = before.pose + share * step
                return scan
        nearest = min(reversed(self._past), key=lambda odometry: abs(odometry.time - scan.time))
        scan.odometry[:] = nearest.pose
        return scan
