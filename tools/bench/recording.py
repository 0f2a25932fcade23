"""A whole log in memory, as the peers' converters and the scoring of their key poses need it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from frontend import se2
from frontend.readers import open_log
from frontend.records import FloatArray, Laser
from mrtm.evaluation import TimedPoses


@dataclass(frozen=True, slots=True)
class Recording:
    """All n scans of a log in its order.

    Attributes:
        times: (n,) seconds, the log's own clock, which may step back.
        odometry: (n, 3) odom_T_robot.
        ranges: (n, beams) metres, NaN or inf where there is no reading.
        laser: the scanner.
    """

    times: FloatArray
    odometry: FloatArray
    ranges: npt.NDArray[np.float32]
    laser: Laser


def read_recording(path: Path) -> Recording:
    """Read a log with the project's own reader.

    Raises:
        LogError: it cannot be read or holds no usable scan.
    """
    scans = list(open_log(path).scans())
    return Recording(
        np.array([scan.time for scan in scans]),
        np.array([scan.odometry for scan in scans]),
        np.array([scan.ranges for scan in scans]),
        scans[0].laser,
    )


def carried(recording: Recording, keys: npt.NDArray[np.int64], poses: FloatArray) -> TimedPoses:
    """A pose at every scan: that of the last key scan before it, moved on by odometry.

    Args:
        keys: (k,) indices of the key scans, rising.
        poses: (k, 3) map_T_robot there.
    """
    odometry = recording.odometry
    latest = np.maximum(np.searchsorted(keys, np.arange(len(odometry)), side="right") - 1, 0)
    return TimedPoses(recording.times, se2.compose(poses[latest], se2.between(odometry[keys[latest]], odometry)))
