"""The joint grid as ROS map_server reads it: an image and a few lines of YAML."""

from pathlib import Path

import numpy as np

from frontend.local_map import Grid
from mrtm.output.files import replacing

FREE, OCCUPIED, UNKNOWN = 254, 0, 205

THRESHOLD = 0.62
"""Log-odds beyond which a cell counts as occupied (p = 0.65), below minus which as free (p = 0.35)."""


def write_occupancy(stem: Path, grid: Grid) -> None:
    """Write ``stem.pgm`` and ``stem.yaml``. Row 0 of the image is the top: the largest y.

    The image holds three values only, which map_server's trinary mode, with the thresholds its own map_saver writes,
    takes for free, occupied and unknown.
    """
    image = np.full(grid.log_odds.shape, UNKNOWN, np.uint8)
    image[grid.log_odds > THRESHOLD] = OCCUPIED
    image[grid.log_odds < -THRESHOLD] = FREE
    height, width = grid.log_odds.shape
    with replacing(stem.with_suffix(".pgm")) as path:
        path.write_bytes(b"P5\n%d %d\n255\n" % (width, height) + image[::-1].tobytes())
    x, y = grid.origin
    with replacing(stem.with_suffix(".yaml")) as path:
        path.write_text(
            f"image: {stem.name}.pgm\n"
            f"mode: trinary\n"
            f"resolution: {grid.resolution:.6f}\n"
            f"origin: [{x:.6f}, {y:.6f}, 0.000000]\n"
            f"negate: 0\n"
            f"occupied_thresh: 0.65\n"
            f"free_thresh: 0.196\n",
            encoding="utf-8",
        )
