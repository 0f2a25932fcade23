"""What a person looks at before trusting a simulated log."""

from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from frontend.records import FloatArray
from tools.simulation.log import SimulatedLog
from tools.simulation.plan import FloorPlan
from tools.simulation.poses import compose
from tools.simulation.sightings import SimulatedSighting
from tools.simulation.team import COLOURS, SimulatedTeam


def draw(plan: FloorPlan, log: SimulatedLog, path: Path, scan: int) -> None:
    """A PNG: the plan, the true path, the odometry from the same start, and one scan."""
    figure = Figure(figsize=(12, 8), layout="constrained")
    axes = figure.add_subplot(aspect="equal", title=f"{plan.name}: {len(log.times)} scans", xlabel="m", ylabel="m")
    walls = plan.segments.reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(walls), colors="black", linewidths=0.8))
    axes.plot(*log.poses[:, :2].T, color="tab:blue", linewidth=1, label="true path")
    axes.plot(*compose(log.poses[0], log.odometry)[:, :2].T, color="tab:orange", linewidth=0.6, label="odometry")
    axes.plot(*log.poses[0, :2], "o", color="tab:green", label="start")
    axes.plot(*scan_points(log, scan).T, ".", color="tab:red", markersize=3, label=f"scan {scan}")
    axes.plot(*log.poses[scan, :2], "^", color="tab:red")
    low, high = walls.min(axis=(0, 1)) - 1, walls.max(axis=(0, 1)) + 1
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    figure.savefig(path, dpi=110)


def draw_team(team: SimulatedTeam, sightings: list[SimulatedSighting], path: Path) -> None:
    """A PNG: the plan, every robot's true path and start, and who believes to see whom from where."""
    plan = team.plan
    figure = Figure(figsize=(12, 8), layout="constrained")
    axes = figure.add_subplot(aspect="equal", title=f"{plan.name}: {len(team.robots)} robots", xlabel="m", ylabel="m")
    axes.add_collection(LineCollection(list(plan.segments.reshape(-1, 2, 2)), colors="black", linewidths=0.8))
    colours = {robot.name: robot.name if robot.name in COLOURS else f"C{i}" for i, robot in enumerate(team.robots)}
    for robot in team.robots:
        axes.plot(*robot.journey.poses[:, :2].T, color=colours[robot.name], linewidth=1, label=robot.name)
        axes.plot(*robot.journey.poses[0, :2], "o", color=colours[robot.name])
    robots = {robot.name: robot for robot in team.robots}
    for sighting in sightings:
        eye = robots[sighting.observer].at(np.array([sighting.time]))[0]
        angle = eye[2] + sighting.bearing
        seen = eye[:2] + sighting.range * np.array((np.cos(angle), np.sin(angle)))
        axes.plot(*np.stack((eye[:2], seen)).T, color=colours[sighting.observed], linewidth=0.4)
    low, high = plan.segments.reshape(-1, 2).min(axis=0) - 1, plan.segments.reshape(-1, 2).max(axis=0) + 1
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    if len(team.robots) <= len(COLOURS):
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    figure.savefig(path, dpi=110)


def scan_points(log: SimulatedLog, scan: int) -> FloatArray:
    """(H, 2) where the beams of a scan ended, in the plan's frame."""
    laser, ranges = log.laser.record(), log.ranges[scan]
    hit = np.isfinite(ranges)
    ends = np.column_stack((ranges * np.cos(laser.angles), ranges * np.sin(laser.angles), laser.angles))[hit]
    return compose(compose(log.poses[scan], laser.mount), ends)[:, :2]
