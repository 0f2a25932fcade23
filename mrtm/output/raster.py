"""The joint grid as an image: where to look from, and how log-odds become ink."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from frontend.local_map import LocalMap
from frontend.records import FloatArray
from mrtm.joint.fusion import fuse
from mrtm.output.style import BACKGROUND, FREE, WALL

LONG_SIDE, TALL_SIDE = 2000, 1800
"""Pixels of the map at most, across and up."""

MAX_SCALE = 240.0
"""Pixels per metre at most: a closet does not fill a wall."""

COARSEST = 0.05
"""Metres per cell: the view is found at the coarse one; a pixel larger than it is made of several samples."""


@dataclass(frozen=True, slots=True)
class View:
    """A window on the joint map, turned by ``angle``.

    Attributes:
        angle: radians, picture_R_joint.
        low, high: (2,) corners of the window in the turned frame, metres; whole pixels apart.
        scale: pixels per metre.
    """

    angle: float
    low: FloatArray
    high: FloatArray
    scale: float

    @property
    def width(self) -> int:
        """Pixels across."""
        return round(float(self.high[0] - self.low[0]) * self.scale)

    @property
    def height(self) -> int:
        """Pixels up."""
        return round(float(self.high[1] - self.low[1]) * self.scale)

    def turn(self, points: FloatArray) -> FloatArray:
        """Points (n, 2) of the joint frame in the turned frame."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]))

    def turn_pose(self, pose: gtsam.Pose2) -> FloatArray:
        """A pose of the joint frame, (3,) in the turned frame."""
        turned = gtsam.Pose2(0.0, 0.0, self.angle).compose(pose)
        return np.array([turned.x(), turned.y(), turned.theta()])


Maps = Sequence[tuple[gtsam.Pose2, LocalMap]]


def find_view(maps: Maps, positions: FloatArray) -> View:
    """The view that shows the walls of the maps and all of ``positions`` (n, 2), walls level, the long way across."""
    grid = fuse(maps, COARSEST)
    rows, columns = np.nonzero(grid.log_odds > 1.0)
    walls = grid.origin + grid.resolution * (np.column_stack([columns, rows]) + 0.5)
    angle = -_wall_direction(walls)
    spans = {turn: np.ptp(_shown(walls, positions, angle + turn), axis=0) for turn in (0.0, math.pi / 2)}
    if spans[0.0][0] < spans[math.pi / 2][0]:
        angle += math.pi / 2
    angle = (angle + math.pi / 2) % math.pi - math.pi / 2  # of the two ways up, the one that turns less
    shown = _shown(walls, positions, angle)
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.5 + 0.01 * float((high - low).max())
    low, high = low - margin, high + margin
    scale = min(LONG_SIDE / (high[0] - low[0]), TALL_SIDE / (high[1] - low[1]), MAX_SCALE)
    return View(angle, np.floor(low * scale) / scale, np.ceil(high * scale) / scale, float(scale))


def _shown(walls: FloatArray, positions: FloatArray, angle: float) -> FloatArray:
    """Two corners (2, 2) around all turned positions and all but a stray thousandth of the turned walls."""
    turn = View(angle, np.zeros(2), np.zeros(2), 1.0).turn
    parts = [turn(positions)]
    if len(walls):
        parts.append(np.quantile(turn(walls), [0.001, 0.999], axis=0))
    points = np.concatenate(parts)
    return np.array([points.min(axis=0), points.max(axis=0)])


def _wall_direction(walls: FloatArray) -> float:
    """The direction most walls (n, 2) follow, modulo a right angle, radians in [-pi/4, pi/4).

    Seen along a wall its points fall together: of all directions the one with the most crowded projections.
    """
    points = walls[:: len(walls) // 4000 + 1]

    def crowding(angle: float) -> float:
        turned = View(-angle, np.zeros(2), np.zeros(2), 1.0).turn(points)
        cells = np.floor((turned - turned.min(axis=0)) / COARSEST).astype(np.int64)
        return sum(float((np.bincount(axis) ** 2).sum()) for axis in cells.T)

    if not len(points):
        return 0.0
    coarse = max(np.radians(np.arange(-45.0, 45.0, 0.75)), key=crowding)
    return float(max(coarse + np.radians(np.arange(-0.75, 0.76, 0.125)), key=crowding))


def paint(maps: Maps, view: View) -> npt.NDArray[np.uint8]:
    """The maps as seen in ``view``: an RGB image (height, width, 3), row 0 at the top.

    The local maps are sampled at the pixels themselves, so that no wall is resampled twice.
    """
    samples = max(1, math.ceil(1 / (view.scale * COARSEST)))
    turn = gtsam.Pose2(0.0, 0.0, view.angle)
    turned = [(turn.compose(pose), local_map) for pose, local_map in maps]
    log_odds = fuse(turned, 1 / (view.scale * samples), np.array([view.low, view.high])).log_odds
    # A wall's log-odds rise within a cell, about 0.05 m: ink spreads over about a pixel of that, for smooth borders.
    ramp = np.float32(min(3.0, max(0.5, 4.0 / (COARSEST * view.scale * samples))))
    # In place: at up to 2000 x 1800 pixels each array more is 14 MB.
    wall, free = log_odds - np.float32(0.2), np.float32(-0.2) - log_odds
    del log_odds
    wall /= ramp
    for layer in (wall, free):
        np.clip(layer, 0.0, 1.0, out=layer)
    if samples > 1:
        wall, free = (_mean_of_blocks(layer, samples) for layer in (wall, free))
        wall = np.minimum(samples * wall, 1.0)  # a wall thinner than a pixel is drawn a pixel wide
    if COARSEST * view.scale < 2.5:  # seen from far away walls are drawn a pixel stronger
        wall[1:] = np.maximum(wall[1:], wall[:-1])
        wall[:, 1:] = np.maximum(wall[:, 1:], wall[:, :-1])
    unknown, white, ink = (np.array(rgb(colour), np.float32) for colour in (BACKGROUND, FREE, WALL))
    image = np.empty((*wall.shape, 3), np.uint8)
    for channel in range(3):
        floor = unknown[channel] + free * (white[channel] - unknown[channel])
        image[..., channel] = (floor + wall * (ink[channel] - floor) + 0.5)[::-1]
    return image


def _mean_of_blocks(layer: npt.NDArray[np.float32], size: int) -> npt.NDArray[np.float32]:
    height, width = layer.shape
    blocks = layer.reshape(height // size, size, width // size, size)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def rgb(colour: str) -> tuple[int, int, int]:
    """The channels of a colour written #rrggbb."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
