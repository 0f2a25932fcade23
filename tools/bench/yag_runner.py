"""Maps a recording with yag-slam; runs in that package's own environment: ``python yag_runner.py IN.npz OUT.npz``.

IN holds ``odometry`` (n, 3) of the laser, ``ranges`` (n, beams), beyond the longest range where there is no reading,
and ``geometry``: first and last bearing, their step, and the longest range. OUT gets ``keys`` (k,), the scans that
were used, and their ``poses`` (k, 3). yag-slam leaves the choice of scans to its caller: as in Karto's
default, one each 0.2 m or 10 degrees.
"""

import math
import sys

import numpy as np
from yag_slam.graph_slam import GraphSlam  # type: ignore[import-not-found]
from yag_slam.models import LocalizedRangeScan  # type: ignore[import-not-found]
from yag_slam.scan_matching import Scan2DMatcherCpp  # type: ignore[import-not-found]

TRAVEL, TURN = 0.2, math.radians(10.0)
RANGE_THRESHOLD = 20.0  # yag-slam's default, metres


def main(source: str, destination: str) -> None:
    """Read, map, write."""
    with np.load(source) as recording:
        odometry, ranges, geometry = recording["odometry"], recording["ranges"], recording["geometry"]
    first, last, step, longest = (float(value) for value in geometry)
    slam = GraphSlam(Scan2DMatcherCpp({}), Scan2DMatcherCpp({}, loop=True))
    keys: list[int] = []
    for index, (x, y, theta) in enumerate(odometry.tolist()):
        if keys:
            px, py, before = odometry[keys[-1]]
            turned = abs(math.remainder(theta - before, math.tau))
            if math.hypot(x - px, y - py) < TRAVEL and turned < TURN:
                continue
        threshold = min(RANGE_THRESHOLD, longest)
        readings = ranges[index].tolist()
        scan = LocalizedRangeScan(readings, first, last, step, 0.05, longest, threshold, x, y, theta)
        slam.process_scan(scan)
        keys.append(index)
    poses = [(p.x, p.y, p.euler[-1]) for p in (vertex.obj.corrected_pose for vertex in slam.graph.vertices)]
    np.savez(destination, keys=np.array(keys), poses=np.array(poses))


if __name__ == "__main__":
    main(*sys.argv[1:])
