"""Odometry that jumps farther than a robot can drive: the fault of a counter, of a line or of the unit."""

import numpy as np

from frontend import se2
from frontend.readers.report import Report
from frontend.records import FloatArray

FARTHEST_JUMP = 20.0  # metres: what may come of clocks that stand still, or of scans that are missing
FASTEST = 20.0  # metres a second


class Continuity:
    """Takes the jumps out of odometry: over a jump the robot stood still, as far as anybody can tell.

    Args:
        report: counts the jumps.
    """

    def __init__(self, report: Report) -> None:
        self._report = report
        self._last: tuple[float, FloatArray, FloatArray] | None = None  # time, odometry as it came and as it went
        self._correction: FloatArray | None = None

    def joined(self, line: int, time: float, odometry: FloatArray) -> FloatArray:
        """The next odometry (3,) in the frame of the first."""
        if self._last is not None:
            before, came, went = self._last
            jump = float(np.hypot(*(odometry - came)[:2]))
            if jump > FARTHEST_JUMP + FASTEST * abs(time - before):  # clocks step back, too
                self._report.jump(line, jump)
                self._correction = se2.compose(went, se2.inverse(odometry))
        joined = odometry if self._correction is None else se2.compose(self._correction, odometry)
        self._last = time, odometry, joined
        return joined
