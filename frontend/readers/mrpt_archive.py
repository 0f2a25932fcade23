"""MRPT's binary archive: objects one after the other, each with its class name and the version of its layout.

    object    length | 0x80 (1 byte), class name, version (1 byte), fields, 0x88
    before MRPT 0.5.5   length (4 bytes), class name, version (4 bytes), fields

Little-endian. The class name may carry its namespace (``mrpt::obs::CSensoryFrame``, since 1.9.9), which is left off
here. How long an object is, only its class knows. Source: MRPT's CArchive.cpp and the serializeFrom of each class.

Containers (CRawlog, CSensoryFrame, CActionCollection) are a count and then their objects, so that the archive can be
read as one flat sequence, with end flags in between: nothing needs to fit in memory but one object.
"""

import re
import struct
from collections.abc import Iterator

import numpy as np

from frontend.readers.lines import Unreadable
from frontend.records import FloatArray

END_FLAG = 0x88
LONGEST_TEXT = 1 << 10
LARGEST_MATRIX = 1 << 10
_LONGEST_NAME = 120
_NAME = re.compile(rb"(?:mrpt::\w+::)?(C[A-Z]\w*|nullptr)", re.ASCII)
# What a log's objects are called, with what comes before a name: enough to find the next one in bytes unknown.
_HEADER = re.compile(
    rb"(?:([\x80-\xf8])|([\x01-\x78])\0\0\0)(?=((?:mrpt::obs::)?C(?:Observation|Action|SensoryFrame)\w{0,80}))",
    re.ASCII,
)


class EndOfArchive(Exception):
    """The bytes end where there should be more."""


class Archive:
    """Reads objects from blocks of bytes.

    Call ``next_object`` and ``header``, then what the class consists of, then ``close``. ``Unreadable`` is raised for
    bytes that are no archive's, ``EndOfArchive`` when they end too early.
    """

    def __init__(self, blocks: Iterator[bytes]) -> None:
        self._blocks = blocks
        self._data = b""
        self._start = 0  # of the object being read
        self._at = 0
        self._old = False

    def next_object(self) -> bool:
        """Go to the next object, over the end flags of containers; whether there is one."""
        while self._filled(1):
            if self._data[self._at] != END_FLAG:
                self._start = self._at
                return True
            self._at += 1
        return False

    def header(self) -> tuple[str, int]:
        """Class name without its namespace and version; 0 for the null object, which has none."""
        length = self.take(1)[0]
        self._old = not length & 0x80
        if self._old and self.take(3) != b"\0\0\0":
            raise Unreadable("not the beginning of an object")
        length &= 0x7F
        name = _NAME.fullmatch(self.take(length)) if length <= _LONGEST_NAME else None
        if name is None:
            raise Unreadable("not the beginning of an object")
        version = 0
        if name[1] != b"nullptr":
            version = self.one("i") if self._old else self.take(1)[0]
        return name[1].decode("ascii"), version

    def close(self) -> None:
        """Read the end flag."""
        if not self._old and self.take(1)[0] != END_FLAG:
            raise Unreadable("it does not end where its fields do")

    def skip_object(self) -> bool:
        """Leave an object that cannot be read: search for the next header; whether there is one."""
        self._at = self._start = self._start + 1
        while True:
            for found in _HEADER.finditer(self._data, self._at):
                if len(found[3]) == (found[1] or found[2])[0] & 0x7F:
                    self._at = self._start = found.start()
                    return True
            # The last bytes may be the beginning of a header.
            self._at = self._start = max(self._at, len(self._data) - _LONGEST_NAME)
            if not self._filled(len(self._data) - self._at + 1):
                return False

    def take(self, count: int) -> bytes:
        """The next bytes."""
        if not self._filled(count):
            raise EndOfArchive
        self._at += count
        return self._data[self._at - count : self._at]

    def one(self, kind: str) -> int:
        """An integer; ``kind`` is a letter of ``struct``."""
        return int(struct.unpack("<" + kind, self.take(struct.calcsize("<" + kind)))[0])

    def flag(self) -> bool:
        """A C++ bool."""
        return self.take(1) != b"\0"

    def array(self, kind: str, count: int) -> FloatArray:
        """(count,) numbers; ``kind`` is "f4", "f8" or "i4"."""
        values = np.frombuffer(self.take(count * int(kind[1])), dtype="<" + kind)
        with np.errstate(invalid="ignore"):  # a signalling NaN
            return values.astype(np.float64)

    def text(self) -> bytes:
        """A string."""
        length = self.one("I")
        if length > LONGEST_TEXT:
            raise Unreadable(f"a text of {length} bytes")
        return self.take(length)

    def opened(self, *names: str) -> tuple[str, int]:
        """The header of an object inside another, which must be of one of these classes."""
        name, version = self.header()
        if name not in names:
            raise Unreadable(f"{name} in place of {' or '.join(names)}")
        return name, version

    def matrix(self) -> FloatArray:
        """(rows, columns) a CMatrix, CMatrixF or CMatrixD object."""
        name, version = self.opened("CMatrix", "CMatrixF", "CMatrixD")
        known(name, version, 0)
        rows, columns = self.one("I"), self.one("I")
        if max(rows, columns) > LARGEST_MATRIX or rows * columns > LARGEST_MATRIX:
            raise Unreadable(f"a matrix of {rows} x {columns}")
        values = self.array("f8" if name == "CMatrixD" else "f4", rows * columns)
        self.close()
        return values.reshape(rows, columns)

    def pose2d(self) -> FloatArray:
        """(3,) a CPose2D object."""
        name, version = self.opened("CPose2D")
        known(name, version, 1)
        pose = self.array("f8" if version else "f4", 3)
        self.close()
        return pose

    def pose3d(self) -> tuple[FloatArray, FloatArray]:
        """(3,) position and (3, 3) rotation of a CPose3D object."""
        name, version = self.opened("CPose3D")
        known(name, version, 3)
        if version < 2:
            homogeneous = self.matrix()
            if homogeneous.shape != (4, 4):
                raise Unreadable(f"a pose made of {homogeneous.shape[0]} x {homogeneous.shape[1]} numbers")
            position, rotation = homogeneous[:3, 3], homogeneous[:3, :3]
        elif version == 2:
            values = self.array("f8", 7)
            position, rotation = values[:3], _rotation(*values[3:].tolist())
        else:
            values = self.array("f8", 12)
            position, rotation = values[:3], values[3:].reshape(3, 3)
        self.close()
        return position, rotation

    def pose_pdf_mean(self) -> FloatArray:
        """(3,) the mean of a CPosePDFGaussian object."""
        name, version = self.opened("CPosePDFGaussian")
        known(name, version, 2)
        mean = self.pose2d()
        if version:
            self.array("f8" if version == 2 else "f4", 6)
        else:
            self.matrix()
        self.close()
        return mean

    def _filled(self, count: int) -> bool:
        """Whether there are so many bytes from here on; drops what lies before the object being read."""
        while len(self._data) - self._at < count:
            block = next(self._blocks, None)
            if block is None:
                return False
            self._data = self._data[self._start :] + block
            self._at -= self._start
            self._start = 0
        return True


def known(name: str, version: int, newest: int) -> None:
    """Raise ``Unreadable`` if this layout of the class came after the newest one known here."""
    if not 0 <= version <= newest:
        raise Unreadable(f"version {version} of {name}, the newest known is {newest}")


def _rotation(w: float, x: float, y: float, z: float) -> FloatArray:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
