"""What a run on a data set reached, as a table and as a picture."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frontend import se2
from mrtm.evaluation import TimedPoses
from mrtm.output.style import INK, MUTED
from tools.mrclam_data.run import Outcome

COLOURS = ("#2f6fde", "#e8710a", "#1f9d55", "#8a4fd3", "#dc3545", "#0c9fb5", "#8d6142")


def table(outcome: Outcome, name: str) -> str:
    """The figures, as Markdown."""
    trajectories = {
        "joint map, at the end": outcome.joint,
        "joint map, on line": outcome.online,
        "odometry alone, true start": outcome.true_start,
        "odometry alone, common start": outcome.common_start,
    }
    errors = {key: outcome.ate(poses) for key, poses in trajectories.items()}
    joint, alone = (errors[key].translation.rmse for key in ("joint map, at the end", "odometry alone, true start"))
    lines = [
        f"# {name}: robots {', '.join(map(str, outcome.robots))}, wheel odometry and sightings of each other",
        "",
        "| whole team, one alignment | ATE RMSE | median | heading RMSE |",
        "|---|---|---|---|",
        *(
            f"| {key} | {e.translation.rmse:.3f} m | {e.translation.median:.3f} m | {e.rotation.rmse:.1f} deg |"
            for key, e in errors.items()
        ),
        "",
        f"Joint map over odometry alone from the true start: {joint / alone:.3f}.",
        "",
        "True start: each robot's wheels integrated from its true first pose, which the joint map does not know: the",
        "most that odometry alone can do. Common start: from where the robots held themselves to be when all were in",
        "one frame, by the first sightings.",
        "",
        "| NEES / degrees of freedom | count | mean | median |",
        "|---|---|---|---|",
        *(f"| {key} | {len(v)} | {v.mean():.2f} | {np.median(v):.2f} |" for key, v in outcome.honesty.items()),
        "",
        f"In one frame {outcome.joined:.0f} s after the first sighting. {outcome.vertices} vertices, "
        f"{outcome.edges} edges, {outcome.false_sightings} sightings beyond the 99.9 % bound of the final estimate.",
        "Processor time for each second with sightings: "
        f"mean {1e3 * outcome.steps.mean():.0f} ms, 99 % {1e3 * np.quantile(outcome.steps, 0.99):.0f} ms, "
        f"worst {1e3 * outcome.steps.max():.0f} ms; {outcome.steps.sum():.1f} s in all.",
    ]
    return "\n".join(lines) + "\n"


def draw(outcome: Outcome, name: str, path: Path) -> None:
    """The paths against the truth, jointly and by odometry alone, and the error over time."""
    figure = Figure(figsize=(14, 4.8), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    for axes, poses, title in (
        (left, outcome.joint, "joint map"),
        (middle, outcome.true_start, "odometry alone, true start"),
    ):
        error = outcome.ate(poses).translation.rmse
        _paths(axes, outcome, poses, f"{title}: ATE RMSE {error:.2f} m")
    for poses, title, colour in (
        (outcome.true_start, "odometry alone, true start", MUTED),
        (outcome.online, "joint map, on line", "#e8710a"),
        (outcome.joint, "joint map, at the end", "#2f6fde"),
    ):
        _errors(right, outcome, poses, title, colour)
    right.set_xlabel("seconds")
    right.set_ylabel("RMS over the team, metres")
    right.legend(fontsize=8, frameon=False)
    figure.suptitle(f"{name}: {len(outcome.robots)} robots that only see each other; the truth is grey", color=INK)
    figure.savefig(path, dpi=130)


def _paths(axes: Axes, outcome: Outcome, poses: dict[str, TimedPoses], title: str) -> None:
    alignment = np.array(outcome.ate(poses).alignment)
    for colour, (robot, path) in zip(COLOURS * len(poses), poses.items(), strict=False):
        axes.plot(*outcome.truth[robot].poses[:, :2].T, color="#c4c9cf", linewidth=1.6, zorder=1)
        axes.plot(*se2.compose(alignment, path.poses)[:, :2].T, color=colour, linewidth=0.9, label=robot, zorder=2)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10, color=INK)
    axes.set_xlabel("metres")
    axes.legend(fontsize=8, frameon=False, loc="upper right", title="robot", title_fontsize=8)


def _errors(axes: Axes, outcome: Outcome, poses: dict[str, TimedPoses], title: str, colour: str) -> None:
    """RMS distance from the truth over the robots, by time."""
    alignment = np.array(outcome.ate(poses).alignment)
    squares: dict[float, list[float]] = {}
    for robot, path in poses.items():
        true = dict(zip(outcome.truth[robot].times.tolist(), outcome.truth[robot].poses, strict=True))
        for t, pose in zip(path.times.tolist(), se2.compose(alignment, path.poses), strict=True):
            if t in true:
                squares.setdefault(t, []).append(float(((pose - true[t])[:2] ** 2).sum()))
    times = np.array(sorted(squares))
    axes.plot(times - times[0], [np.sqrt(np.mean(squares[t])) for t in times], color=colour, linewidth=1.2, label=title)
