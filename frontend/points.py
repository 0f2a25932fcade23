"""A scan as the matcher wants it: endpoints with surface normals, in the robot frame.

The normal of an endpoint comes from its neighbours in the same sweep. It is computed once per scan and shared by all
particles, which only rotate it.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from frontend.records import FloatArray, LaserScan

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Points:
    """One scan, ready to be matched and mapped.

    Attributes:
        hits: (n, 4) float32 ``x, y, normal_x, normal_y``: endpoints within the sensing range, robot frame, metres. The
            normal has length one and faces the laser; it is zero where no surface could be fitted.
        clear: (m, 2) float32 ends of the part within the sensing range of the beams that hit something farther away.
        sensor: (2,) where the beams start, robot frame.
    """

    hits: Float32Array
    clear: Float32Array
    sensor: npt.NDArray[np.float64]


# The fit of a surface at a beam looks at most this many beams to each side,
MAX_NEIGHBOURS = 6
# breaks off at a gap wider than this (metres, plus GAP_STEPS times the spacing of beams on a facing wall),
GAP = 0.10
GAP_STEPS = 4.0
# looks no farther than this (metres, or REACH_STEPS spacings),
REACH = 0.15
REACH_STEPS = 3.0
# and calls it a surface when the points' variance across is below this fraction of that along it.
FLATNESS = 0.12
# A beam shorter than this hit the robot itself.
MIN_RANGE = 0.05


@njit(cache=True, nogil=True)
def _points(ranges, angles, mount, sensing_range, stride, hits, clear):  # type: ignore[no-untyped-def]
    beams = len(ranges)
    step = abs(angles[1] - angles[0]) if beams > 1 else 0.0
    xy = np.empty((beams, 2), np.float32)
    usable = np.zeros(beams, np.bool_)
    for i in range(beams):
        r = ranges[i]
        if MIN_RANGE < r < sensing_range:
            usable[i] = True
            xy[i, 0] = r * math.cos(angles[i])
            xy[i, 1] = r * math.sin(angles[i])
    c = math.cos(mount[2])
    s = math.sin(mount[2])
    n = 0
    m = 0
    for i in range(0, beams, stride):
        r = ranges[i]
        if not usable[i]:
            if sensing_range <= r < np.inf:
                x = sensing_range * math.cos(angles[i])
                y = sensing_range * math.sin(angles[i])
                clear[m, 0] = mount[0] + c * x - s * y
                clear[m, 1] = mount[1] + s * x + c * y
                m += 1
            continue
        gap = GAP + GAP_STEPS * r * step
        reach = max(REACH, REACH_STEPS * r * step)
        sx = 0.0
        sy = 0.0
        sxx = 0.0
        sxy = 0.0
        syy = 0.0
        count = 1
        for direction in (-1, 1):
            j = i
            for _ in range(MAX_NEIGHBOURS):
                k = j + direction
                if k < 0 or k >= beams or not usable[k]:
                    break
                gx = xy[k, 0] - xy[j, 0]
                gy = xy[k, 1] - xy[j, 1]
                dx = xy[k, 0] - xy[i, 0]
                dy = xy[k, 1] - xy[i, 1]
                # The nearest neighbour always counts: far walls are sampled sparsely.
                if gx * gx + gy * gy > gap * gap or (j != i and dx * dx + dy * dy > reach * reach):
                    break
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
                count += 1
                j = k
        nx = 0.0
        ny = 0.0
        if count >= 3:
            sx /= count
            sy /= count
            cxx = sxx / count - sx * sx
            cxy = sxy / count - sx * sy
            cyy = syy / count - sy * sy
            mid = 0.5 * (cxx + cyy)
            dev = math.sqrt(0.25 * (cxx - cyy) ** 2 + cxy * cxy)
            if mid - dev <= FLATNESS * (mid + dev):
                along = 0.5 * math.atan2(2.0 * cxy, cxx - cyy)
                nx = -math.sin(along)
                ny = math.cos(along)
                if nx * xy[i, 0] + ny * xy[i, 1] > 0.0:
                    nx = -nx
                    ny = -ny
        hits[n, 0] = mount[0] + c * xy[i, 0] - s * xy[i, 1]
        hits[n, 1] = mount[1] + s * xy[i, 0] + c * xy[i, 1]
        hits[n, 2] = c * nx - s * ny
        hits[n, 3] = s * nx + c * ny
        n += 1
    return n, m


def points_of(scan: LaserScan, sensing_range: float, max_beams: int) -> Points:
    """Turn a scan into points; of more than ``max_beams`` beams an evenly spaced subset is used.

    The surface fit sees all beams. ``sensing_range`` in metres is the paper's d_s.
    """
    beams = len(scan.ranges)
    stride = max(1, -(-beams // max_beams))
    hits = np.empty((beams, 4), np.float32)
    clear = np.empty((beams, 2), np.float32)
    n, m = _points(scan.ranges, scan.laser.angles, scan.laser.mount, sensing_range, stride, hits, clear)
    return Points(hits[:n].copy(), clear[:m].copy(), scan.laser.mount[:2])


def merge(points: list[Points], poses: FloatArray) -> Points:
    """Several scans as one: ``poses`` (n, 3) of the robot at each, in the frame of the result; only hits are kept."""
    parts = []
    for scan, pose in zip(points, poses, strict=True):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        rotation = np.array([[c, s], [-s, c]], np.float32)
        xy = scan.hits[:, :2] @ rotation + pose[:2].astype(np.float32)
        parts.append(np.hstack([xy, scan.hits[:, 2:] @ rotation]))
    return Points(np.concatenate(parts), np.empty((0, 2), np.float32), points[-1].sensor)
