"""Relations between poses of one building: how wrong a map is where it matters, whatever the frame it is drawn in.

Source: R. Kuemmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 27, 2009.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from frontend import se2
from frontend.records import FloatArray
from mrtm.evaluation.errors import EvaluationError
from mrtm.evaluation.statistics import Statistics
from mrtm.evaluation.trajectory import MAX_GAP, TimedPoses, interpolate, read_rows


@dataclass(frozen=True, slots=True)
class Relations:
    """True relative poses: ``times`` (n, 2) t1, t2 in seconds, ``poses`` (n, 3) the pose at t2 seen from that at t1."""

    times: FloatArray
    poses: FloatArray


@dataclass(frozen=True, slots=True)
class RelationErrors:
    """The relations metric over one set of relations.

    Attributes:
        translation: metres, the norm of the error's translation.
        rotation: degrees, the error's absolute angle.
        count: relations measured.
        no_scan: relations left out because no scan is close enough to one of their times.
        unconnected: relations left out because their two robots never came into one joint map.
    """

    translation: Statistics
    rotation: Statistics
    count: int
    no_scan: int
    unconnected: int


def read_relations(path: Path) -> Relations:
    """Read a file of lines ``t1 t2 x y z roll pitch yaw``; ``z``, ``roll`` and ``pitch`` are not used.

    Raises:
        EvaluationError: the file or a line of it cannot be read, or it holds a trajectory.
    """
    rows = read_rows(path, "t1 t2 x y z roll pitch yaw")
    if len(rows) > 1 and np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1.0).max() < 1e-3:
        raise EvaluationError(f"{path}: no relations: quaternions, as in a TUM trajectory; give it as --truth")
    return Relations(rows[:, :2], np.column_stack([rows[:, 2:4], se2.wrap(rows[:, 7])]))


def relation_errors(true: FloatArray, estimated: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Metres and degrees, (n,) each, of ``true^-1 * estimated``, (n, 3) each."""
    error = se2.between(true, estimated)
    return np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))


def evaluate_relations(
    relations: Relations,
    trajectories: Mapping[str, TimedPoses],
    components: Mapping[str, int] | None = None,
    max_gap: float = MAX_GAP,
) -> tuple[RelationErrors, RelationErrors | None]:
    """Measure a team's trajectories, each in the joint frame of its robot's component.

    Args:
        relations: the true relative poses, in the logs' own time.
        trajectories: one a robot. Where several robots have a scan at a time the one with the closest scan answers.
        components: the component each robot is in; all in one by default. Between two there is nothing to measure.
        max_gap: see :func:`mrtm.evaluation.trajectory.interpolate`.

    Returns:
        The errors over all relations, and, for a team, over those whose times fall in different robots' logs.
    """
    poses, owners = _locate(relations.times.ravel(), trajectories, max_gap)
    owners = owners.reshape(-1, 2)
    poses = poses.reshape(-1, 2, 3)
    scanned = (owners >= 0).all(axis=1)
    component = np.array([components[name] if components else 0 for name in trajectories], dtype=np.int64)
    connected = component[owners[:, 0]] == component[owners[:, 1]]  # an owner of -1 is not scanned anyway
    estimated = se2.between(poses[:, 0], poses[:, 1])
    everything = np.ones(len(owners), dtype=np.bool_)
    across = scanned & (owners[:, 0] != owners[:, 1])

    def measure(chosen: npt.NDArray[np.bool_]) -> RelationErrors:
        use = chosen & scanned & connected
        translation, rotation = relation_errors(relations.poses[use], estimated[use])
        return RelationErrors(
            translation=Statistics.of(translation),
            rotation=Statistics.of(rotation),
            count=int(use.sum()),
            no_scan=int((chosen & ~scanned).sum()),
            unconnected=int((chosen & scanned & ~connected).sum()),
        )

    return measure(everything), measure(across) if len(trajectories) > 1 else None


def _locate(
    times: FloatArray, trajectories: Mapping[str, TimedPoses], max_gap: float
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """The pose at each time (m, 3) and the number of the robot that was there (m,), -1 for none."""
    poses = np.full((len(times), 3), np.nan)
    owners = np.full(len(times), -1, dtype=np.int64)
    closest = np.full(len(times), np.inf)
    for number, trajectory in enumerate(trajectories.values()):
        found_poses, found = interpolate(trajectory, times, max_gap)
        if not found.any():
            continue
        distance = _to_nearest(np.sort(trajectory.times), times)
        better = found & (distance < closest)
        poses[better], owners[better], closest[better] = found_poses[better], number, distance[better]
    return poses, owners


def _to_nearest(known: FloatArray, times: FloatArray) -> FloatArray:
    """Seconds from each of ``times`` (m,) to the nearest of the sorted ``known`` (n > 0,)."""
    after = np.searchsorted(known, times).clip(0, len(known) - 1)
    before = np.maximum(after - 1, 0)
    return np.asarray(np.minimum(np.abs(times - known[before]), np.abs(times - known[after])))
