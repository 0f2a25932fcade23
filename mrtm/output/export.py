"""Write everything a run leaves behind."""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

import mrtm
from factors import VertexId
from frontend.se2 import wrap
from mrtm.joint.fusion import fuse
from mrtm.output.figures import draw_map
from mrtm.output.files import replacing, to_json
from mrtm.output.g2o import write_g2o
from mrtm.output.local_maps import local_map_name, write_local_map
from mrtm.output.occupancy import write_occupancy
from mrtm.output.place import remove_earlier
from mrtm.result import RunResult, Trajectory

MAP_RESOLUTION = 0.05
"""Metres per cell of the exported joint grid."""


def export(result: RunResult, out: Path) -> None:
    """Write ``result`` to the directory ``out`` as the design's "What a run leaves behind" has it.

    What an earlier run wrote is removed first, as far as its ``run.json`` lists it. Then every file appears whole or
    not at all, ``run.json`` last: without one the directory is unfinished. The same result gives the same bytes, except
    for ``timings``, ``longest`` and ``latencies`` in ``run.json``; the seconds spent here are entered among the first
    as ``output``.

    Raises:
        OSError: a file cannot be written.
    """
    started = time.perf_counter()
    remove_earlier(out)
    for directory in (out, out / "trajectory", out / "local_maps"):
        directory.mkdir(parents=True, exist_ok=True)
    components = by_size(result.components)
    written = [out / "graph.g2o"]
    with ThreadPoolExecutor(1) as background:  # compression lets go of the interpreter lock
        pending = []
        for vertex, local_map in result.local_maps.items():
            path = out / "local_maps" / local_map_name(vertex)
            written.append(path)
            pending.append(background.submit(write_local_map, path, local_map))
        for robot, trajectory in result.trajectories.items():
            path = out / "trajectory" / f"{robot}.tum"
            written.append(path)
            _write_tum(path, trajectory)
        write_g2o(out / "graph.g2o", result, components)
        for number, component in enumerate(components):
            stem = out / map_stem(number)
            written += [stem.with_suffix(suffix) for suffix in (".pgm", ".yaml", ".png")]
            write_occupancy(stem, fuse(result.placed_maps(component), MAP_RESOLUTION))
            draw_map(result, component, stem.with_suffix(".png"))
        for job in pending:
            job.result()
    result.timings["output"] = time.perf_counter() - started
    if "total" in result.timings:
        result.timings["total"] += result.timings["output"]
    record = run_record(result) | {"files": sorted(path.relative_to(out).as_posix() for path in written)}
    with replacing(out / "run.json") as temporary:
        temporary.write_text(to_json(record), encoding="utf-8")


def map_stem(component: int) -> str:
    """The name, without suffix, of the map files of a component by size."""
    return f"map-{component}" if component else "map"


def by_size(components: list[list[VertexId]]) -> list[list[VertexId]]:
    """The components, that of most vertices first."""
    return sorted(components, key=len, reverse=True)


def run_record(result: RunResult) -> dict[str, Any]:
    """The content of ``run.json``; a vertex is ``[robot, index]``, a pose ``[x, y, theta]``, all else in SI units."""
    components = by_size(result.components)
    component_of = {vertex: number for number, component in enumerate(components) for vertex in component}
    return {
        "versions": _versions(),
        "seed": result.seed,
        "config": result.config,
        "counts": result.counts,
        "timings": result.timings,
        "longest": result.longest,
        "latencies": [asdict(latency) for latency in result.latencies],
        "robots": {
            robot: {
                "scans": len(trajectory.times),
                "duration": float(np.ptp(trajectory.times)) if len(trajectory.times) else 0.0,
                "component": component_of[VertexId(robot, int(trajectory.vertices[0]))],
            }
            for robot, trajectory in result.trajectories.items()
            if len(trajectory.times)
        },
        "components": [[[v.robot, v.number] for v in component] for component in components],
        "vertices": [_vertex_record(result, vertex, number) for vertex, number in component_of.items()],
        "edges": [
            fate.edge.to_dict() | {"fate": fate.fate, "reason": fate.reason, "chi2": fate.chi2} for fate in result.edges
        ],
        "events": [
            {"time": event.time, "robot": event.robot, "kind": event.kind, "detail": event.detail}
            for event in result.events
        ],
        "blemishes": result.blemishes,
    } | ({} if result.team is None else {"team": asdict(result.team)})


def _vertex_record(result: RunResult, vertex: VertexId, component: int) -> dict[str, Any]:
    local_map = result.local_maps.get(vertex)
    first = None
    if local_map is not None and len(local_map.times):
        first = {"time": local_map.times[0], "pose": local_map.poses[0]}  # local_T_robot
    return {
        "id": [vertex.robot, vertex.number],
        "component": component,
        "pose": _xytheta(result.vertex_poses[vertex]),
        "map_pose": None if local_map is None else _xytheta(result.map_poses[vertex]),
        "covariance": result.vertex_covariances.get(vertex),
        "scans": 0 if local_map is None else len(local_map.times),
        "first_scan": first,
    }


def _xytheta(pose: gtsam.Pose2) -> list[float]:
    return [pose.x(), pose.y(), pose.theta()]


def _versions() -> dict[str, str]:
    packages = {package: version(package) for package in ("gtsam", "numpy", "numba")}
    return {"mrtm": mrtm.__version__, "python": sys.version.split()[0], **packages}


def _write_tum(path: Path, trajectory: Trajectory) -> None:
    """Lines ``t x y z qx qy qz qw``, in the order of the log."""
    half = wrap(trajectory.poses[:, 2]) / 2
    zeros = np.zeros(len(half))
    columns = [trajectory.times, trajectory.poses[:, :2], zeros, zeros, zeros, np.sin(half), np.cos(half)]
    line = "%.6f %.9f %.9f %d %d %d %.12f %.12f"
    with replacing(path) as temporary:
        text = "".join(line % tuple(row) + "\n" for row in np.column_stack(columns).tolist())
        temporary.write_text(text, encoding="utf-8")
