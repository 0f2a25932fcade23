"""Reflective tags in a laser scan: another robot, seen but not named."""

import numpy as np
import numpy.typing as npt

from frontend.records import FloatArray, Laser, Sighting

# Bright beams belong to one tag if at most one beam lies between them and their ends are this near, metres.
BEAMS_APART = 2
JOINED = 0.5
# A bright thing wider than this is no tag on a robot, metres.
WIDEST = 1.0


def find_tags(
    time: float, ranges: npt.NDArray[np.float32], bright: npt.NDArray[np.bool_], laser: Laser
) -> list[Sighting]:
    """The tags of one scan, a sighting each: the middle of the tag's beam ends, seen from the robot.

    Args:
        time: of the scan, seconds.
        ranges: (B,) metres, NaN or inf where there is no end of a beam.
        bright: (B,) whether the beam came back from a reflector.
        laser: the scanner.
    """
    beams = np.flatnonzero(bright & np.isfinite(ranges))
    if not beams.size:
        return []
    x, y, theta = laser.mount
    bearings = laser.angles[beams] + theta
    ends: FloatArray = np.column_stack((x + ranges[beams] * np.cos(bearings), y + ranges[beams] * np.sin(bearings)))
    apart = (np.diff(beams) > BEAMS_APART) | (np.hypot(*np.diff(ends, axis=0).T) > JOINED)
    found = []
    for tag in np.split(ends, np.flatnonzero(apart) + 1):
        if np.hypot(*(tag[-1] - tag[0])) <= WIDEST:
            middle = tag.mean(axis=0)
            found.append(Sighting(time, float(np.hypot(*middle)), float(np.arctan2(middle[1], middle[0]))))
    return found
