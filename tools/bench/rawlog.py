"""Writes MRPT's ``.rawlog``: action and observation in turn, the form that both icp-slam and rbpf-slam read.

MRPT's own ``carmen2rawlog`` writes observations alone, on which rbpf-slam ends with a segmentation fault; it also takes
time stamps for picoseconds and has no way to say that a fan of beams does not look straight ahead.

An object is its class name with its length, a version, its fields (little endian) and an end mark. Source: MRPT's
documentation of CArchive, CActionRobotMovement2D (version 6) and CObservation2DRangeScan (version 7).
"""

import gzip
import math
import struct
from pathlib import Path

import numpy as np

from frontend import se2
from frontend.records import FloatArray
from tools.bench.recording import Recording

_END = b"\x88"
_EPOCH = 116_444_736_000_000_000  # 1970 in MRPT's clock: steps of 100 ns since 1601
_GAUSSIAN = (0.01, math.degrees(0.001), math.radians(1.0), 0.05, 0.01, math.radians(0.2))  # MRPT's motion model
_THRUN = (0.05, math.radians(4.0), 0.01, math.degrees(0.0001), 0.001, math.radians(0.05))  # not selected


def write_rawlog(recording: Recording, path: Path) -> None:
    """Write a recording whose beams are evenly spaced.

    The clock of the file never steps back: where the log's does, it stands still.
    """
    laser = recording.laser
    middle = float(laser.angles[0] + laser.angles[-1]) / 2  # MRPT lets every fan look straight ahead of its scanner
    mount = se2.compose(laser.mount, np.array([0.0, 0.0, middle]))
    head = struct.pack("<fBf", laser.angles[-1] - laser.angles[0], 1, laser.max_range)
    head += _pose3d(mount) + struct.pack("<I", len(laser.angles))
    times = np.maximum.accumulate(recording.times)
    ticks = _EPOCH + np.rint(times * 1e7).astype(np.int64)
    previous = recording.odometry[0]
    with gzip.open(path, "wb", compresslevel=1) as file:
        for tick, odometry, ranges in zip(ticks.tolist(), recording.odometry, recording.ranges, strict=True):
            stamp = struct.pack("<Q", tick)
            moved = se2.between(previous, odometry)
            previous = odometry
            usable = np.isfinite(ranges)
            readings = np.where(usable, ranges, 0.0).astype("<f4").tobytes() + usable.astype(np.uint8).tobytes()
            scan = head + readings + struct.pack("<f", 0.01) + stamp + struct.pack("<f", 0.0)
            scan += _text("LASER") + struct.pack("<dB", 0.0, 0)
            file.write(_object("CActionCollection", 0, struct.pack("<I", 1) + _movement(moved, stamp)))
            observation = _object("CObservation2DRangeScan", 7, scan)
            file.write(_object("CSensoryFrame", 2, struct.pack("<I", 1) + observation))


def _object(name: str, version: int, fields: bytes) -> bytes:
    full = f"mrpt::obs::{name}"
    return bytes([len(full) | 0x80]) + full.encode() + bytes([version]) + fields + _END


def _movement(moved: FloatArray, stamp: bytes) -> bytes:
    """An odometry increment with MRPT's default Gaussian motion model."""
    fields = struct.pack("<I", 0) + _pose2d(moved)
    fields += struct.pack("<I6f", 0, *_GAUSSIAN) + struct.pack("<I6f", 300, *_THRUN)
    fields += struct.pack("<B2f", 0, 0.0, 0.0) + struct.pack("<Bii", 0, 0, 0) + stamp
    return _object("CActionRobotMovement2D", 6, fields)


def _pose2d(pose: FloatArray) -> bytes:
    name = "mrpt::poses::CPose2D"
    return bytes([len(name) | 0x80]) + name.encode() + b"\x01" + struct.pack("<3d", *pose) + _END


def _pose3d(pose: FloatArray) -> bytes:
    name = "mrpt::poses::CPose3D"
    x, y, theta = pose.tolist()
    c, s = math.cos(theta), math.sin(theta)
    fields = struct.pack("<12d", x, y, 0.0, c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0)
    return bytes([len(name) | 0x80]) + name.encode() + b"\x03" + fields + _END


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()
