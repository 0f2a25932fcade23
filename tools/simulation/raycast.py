"""Where beams meet wall segments and robots, and how near a robot comes to them. Kernels in numba."""

import numpy as np
from numba import njit

from frontend.records import FloatArray


@njit(cache=True)
def cast(
    segments: FloatArray, poses: FloatArray, first: float, step: float, beams: int, reach: float = np.inf
) -> FloatArray:
    """Distances from each laser pose to the nearest segment along evenly spaced bearings.

    A segment is only tested against the beams inside the angle that it subtends, so the cost of a scan is
    about (segments + hits), not segments x beams.

    Args:
        segments: (S, 4) x1, y1, x2, y2.
        poses: (N, 3) laser poses in the frame of the segments.
        first: bearing of beam 0 in the laser frame, radians.
        step: radians from a beam to the next, above 0.
        beams: number of beams.
        reach: metres, beyond which it does not matter what a beam meets.

    Returns:
        (N, beams) metres, inf where a beam meets nothing; beyond ``reach`` it may miss what is there.
    """
    ranges = np.full((poses.shape[0], beams), np.inf)
    cosines = np.cos(first + step * np.arange(beams))
    sines = np.sin(first + step * np.arange(beams))
    turn = 2.0 * np.pi
    for n in range(poses.shape[0]):
        x, y, theta = poses[n]
        c, s = np.cos(theta), np.sin(theta)
        for k in range(segments.shape[0]):
            dx, dy = segments[k, 0] - x, segments[k, 1] - y
            ux, uy = segments[k, 2] - x, segments[k, 3] - y
            if min(dx, ux) > reach or max(dx, ux) < -reach or min(dy, uy) > reach or max(dy, uy) < -reach:
                continue
            ax, ay = c * dx + s * dy, c * dy - s * dx
            bx, by = c * ux + s * uy, c * uy - s * ux
            ex, ey = bx - ax, by - ay
            cross = ax * ey - ay * ex
            start, end = np.arctan2(ay, ax), np.arctan2(by, bx)
            if cross < 0.0:  # the segment runs clockwise
                start, end = end, start
            if end < start:
                end += turn
            if end - start > np.pi:  # edge-on: rounding put its ends the wrong way round
                continue
            # The first turn in which the segment ends after beam 0; a second one if the fan passes the seam.
            start_in_turn = start + turn * np.ceil((first - end) / turn)
            end_in_turn = start_in_turn + (end - start)
            while start_in_turn <= first + step * (beams - 1):
                low = max(0, int(np.ceil((start_in_turn - first) / step)))
                high = min(beams - 1, int(np.floor((end_in_turn - first) / step)))
                for b in range(low, high + 1):
                    across = cosines[b] * ey - sines[b] * ex
                    if across != 0.0:
                        distance = cross / across
                        if 0.0 <= distance < ranges[n, b]:
                            ranges[n, b] = distance
                start_in_turn += turn
                end_in_turn += turn
    return ranges


@njit(cache=True)
def shade(ranges: FloatArray, discs: FloatArray, radius: float, poses: FloatArray, first: float, step: float) -> None:
    """Shortens, in place, the beams that meet a disc; a disc is somewhere else for each pose.

    A disc whose centre is nearer than twice the radius is passed over: two robots there would be inside each other.

    Args:
        ranges: (N, B) metres, as ``cast`` returns them.
        discs: (N, K, 2) centres, in the frame of the poses.
        radius: of the discs, metres.
        poses: (N, 3) laser poses.
        first: bearing of beam 0 in the laser frame, radians.
        step: radians from a beam to the next, above 0.
    """
    turn = 2.0 * np.pi
    beams = ranges.shape[1]
    for n in range(poses.shape[0]):
        for k in range(discs.shape[1]):
            dx, dy = discs[n, k, 0] - poses[n, 0], discs[n, k, 1] - poses[n, 1]
            away = np.hypot(dx, dy)
            if away < 2.0 * radius:
                continue
            half = np.arcsin(radius / away)
            bearing = np.arctan2(dy, dx) - poses[n, 2]
            bearing += turn * np.ceil((first - half - bearing) / turn)  # the first turn in which it ends after beam 0
            while bearing - half <= first + step * (beams - 1):
                low = max(0, int(np.ceil((bearing - half - first) / step)))
                high = min(beams - 1, int(np.floor((bearing + half - first) / step)))
                for b in range(low, high + 1):
                    off = first + step * b - bearing
                    aside = away * np.sin(off)
                    distance = away * np.cos(off) - np.sqrt(max(0.0, radius * radius - aside * aside))
                    ranges[n, b] = min(ranges[n, b], distance)
                bearing += turn


@njit(cache=True)
def clearances(segments: FloatArray, points: FloatArray) -> FloatArray:
    """(N,) metres from each point (N, 2) to the nearest of the segments (S, 4)."""
    nearest = np.full(points.shape[0], np.inf)
    for n in range(points.shape[0]):
        for k in range(segments.shape[0]):
            ax, ay = segments[k, 0], segments[k, 1]
            ex, ey = segments[k, 2] - ax, segments[k, 3] - ay
            px, py = points[n, 0] - ax, points[n, 1] - ay
            length2 = ex * ex + ey * ey
            along = min(1.0, max(0.0, (px * ex + py * ey) / length2)) if length2 > 0.0 else 0.0
            distance2 = (px - along * ex) ** 2 + (py - along * ey) ** 2
            nearest[n] = min(nearest[n], np.sqrt(distance2))
    return nearest
