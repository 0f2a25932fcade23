"""Robots that drive through each other's scans: they are no part of the building."""

import numpy as np

from mrtm.config import load_config
from mrtm.session import map_scans
from tools.honesty.runs import samples_of
from tools.simulation import divided, office, robot_names, simulate_team


def test_a_robot_ahead_in_a_corridor_does_not_drag_the_map_along() -> None:
    names = robot_names(4)
    team = simulate_team(divided(office(), "tour", names), names, seed=3)
    parts = list(team.log(team.robots[1]))
    result = map_scans((scan for part in parts for scan in part.scans()), load_config())
    samples = samples_of(result, np.concatenate([part.poses for part in parts]), "office", 3)
    driven = [sample for sample in samples if sample.kind == "inter_vertex"]
    assert len(driven) >= 2
    assert max(sample.distance for sample in driven) < 0.1
    assert np.mean([sample.nees for sample in driven]) < 4.0
