"""MRPT rawlogs byte by byte, after the serializeTo of each class and version.

``old`` writes headers as MRPT did before 0.5.5. Class names carry their namespace, as since 1.9.9, unless ``plain``.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frontend.records import FloatArray

Numbers = Sequence[float] | FloatArray
EPOCH = 116_444_736_000_000_000


@dataclass(frozen=True)
class Writer:
    old: bool = False
    plain: bool = False

    def object(self, name: str, version: int, body: bytes, module: str = "obs") -> bytes:
        full = (name if self.plain or self.old else f"mrpt::{module}::{name}").encode()
        if self.old:
            return struct.pack("<I", len(full)) + full + struct.pack("<i", version) + body
        return bytes([len(full) | 0x80]) + full + bytes([version]) + body + b"\x88"

    def pose2d(self, pose: Numbers, version: int = 1) -> bytes:
        return self.object("CPose2D", version, struct.pack("<3d" if version else "<3f", *pose), "poses")

    def matrix(self, values: FloatArray, name: str = "CMatrixF") -> bytes:
        body = struct.pack("<2I", *values.shape) + values.astype("<f8" if name == "CMatrixD" else "<f4").tobytes()
        return self.object(name, 0, body, "math")

    def pose3d(self, position: Numbers, rotation: FloatArray, version: int = 3) -> bytes:
        if version < 2:
            homogeneous = np.eye(4)
            homogeneous[:3, :3], homogeneous[:3, 3] = rotation, position
            body = self.matrix(homogeneous, "CMatrixD" if version else "CMatrix")
        elif version == 2:
            body = struct.pack("<7d", *position, *quaternion(rotation))
        else:
            body = struct.pack("<12d", *position, *rotation.ravel())
        return self.object("CPose3D", version, body, "poses")

    def odometry(self, pose: Numbers, time: float, version: int = 2, more: bool = False) -> bytes:
        body = self.pose2d(pose) + text(b"ODOMETRY") + ticks(time)
        if version == 1:
            body += struct.pack("<BiiBff", more, 1, 2, more, 0.5, 0.5)
        elif version == 2:
            body += (struct.pack("<Bii", 1, 1, 2) + struct.pack("<B3d", 1, 0.5, 0.0, 0.5)) if more else b"\0\0"
        return self.object("CObservationOdometry", version, body)

    def scan(
        self,
        ranges: Numbers,
        time: float,
        version: int = 7,
        *,
        aperture: float = np.pi,
        right_to_left: bool = True,
        max_range: float = 30.0,
        valid: Sequence[bool] | None = None,
        position: Numbers = (0.0, 0.0, 0.0),
        rotation: FloatArray | None = None,
        pose_version: int = 3,
        label: bytes = b"LASER",
        intensities: bool = False,
        beams: int | None = None,
    ) -> bytes:
        count = len(ranges) if beams is None else beams
        body = struct.pack("<f?f", aperture, right_to_left, max_range)
        body += self.pose3d(position, np.eye(3) if rotation is None else rotation, pose_version)
        if version < 6:
            body += self.matrix(np.zeros((6, 6)), "CMatrix")
        body += struct.pack("<I", count) + np.asarray(ranges, "<f4").tobytes()
        if version >= 1:
            body += bytes([True] * len(ranges) if valid is None else valid)
        if version >= 2:
            body += struct.pack("<f", 0.01)
        if version >= 3:
            body += ticks(time)
        if version >= 4:
            body += struct.pack("<f", 0.0)
        if version >= 5:
            body += text(label) + struct.pack("<d", 0.0)
        if version >= 7:
            body += struct.pack("<?", intensities) + (bytes(4 * count) if intensities else b"")
        return self.object("CObservation2DRangeScan", version, body)

    def movement(self, motion: Numbers, version: int = 7, *, by_odometry: bool = True, more: bool = False) -> bytes:
        method = struct.pack("<i", not by_odometry)
        if version < 2:
            body = self.gaussian(motion, version) + method
        elif by_odometry:
            body = method + self.pose2d(motion) + bytes({2: 44, 3: 44, 4: 48}.get(version, 56))
        else:
            body = method + self.gaussian(motion, 2)
        if 1 <= version < 7:
            body += struct.pack("<BffBii", more, 0.5, 0.5, more, 1, 2)
        elif version == 7:
            body += (struct.pack("<B3d", 1, 0.5, 0.0, 0.5) + struct.pack("<Bii", 1, 1, 2)) if more else b"\0\0"
        return self.object("CActionRobotMovement2D", version, body + (bytes(8) if version >= 6 else b""))

    def gaussian(self, mean: Numbers, version: int) -> bytes:
        covariance = {0: self.matrix(np.eye(3), "CMatrix"), 1: bytes(24), 2: bytes(48)}[version]
        return self.object("CPosePDFGaussian", version, self.pose2d(mean) + covariance, "poses")

    def actions(self, *actions: bytes) -> bytes:
        return self.object("CActionCollection", 0, struct.pack("<I", len(actions)) + b"".join(actions))

    def frame(self, *observations: bytes, version: int = 2, time: float = 0.0) -> bytes:
        body = {0: bytes(4) + ticks(time), 1: bytes(4), 2: b""}[version] + struct.pack("<I", len(observations))
        return self.object("CSensoryFrame", version, body + b"".join(observations))

    def rawlog(self, *entries: bytes) -> bytes:
        comment = self.object("CObservationComment", 0, text(b"made up") + bytes(8))
        return self.object("CRawlog", 1, struct.pack("<I", len(entries)) + b"".join(entries) + comment)


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def ticks(time: float) -> bytes:
    return struct.pack("<Q", round(time * 1e7) + EPOCH)


def about_z(angle: float) -> FloatArray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def about_x(angle: float) -> FloatArray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


def quaternion(rotation: FloatArray) -> tuple[float, ...]:
    """w, x, y, z of a rotation by less than half a turn."""
    w = np.sqrt(1.0 + np.trace(rotation)) / 2.0
    r = rotation
    x, y, z = (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]) / (4.0 * w)
    return float(w), float(x), float(y), float(z)
