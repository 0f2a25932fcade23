import numpy as np
import pytest

from tests.mrtm.team_world import NO_MAPS, chain, timed
from tests.mrtm.test_playback import moments, runs
from tools.bench import growth


def test_one_robot_alone_thinks_and_all_its_meetings_count() -> None:
    world = chain(11, 3, sightings=8)
    when = moments(world)
    team = growth.Lone("r1", runs(world, when), timed(when), NO_MAPS)
    team.play(lambda fraction: None)
    records, seconds = np.array(team.paid).T
    assert records[-1] == len(team.team["r1"].store)
    assert (np.diff(records) >= 0).all()
    assert (np.diff(seconds) > 0).all()
    assert set(team.team["r1"].joint.component("r1").robots) == {"r0", "r1", "r2"}
    assert team.team["r0"].judgements == {}


def test_the_power_is_the_slope() -> None:
    assert growth.power([(1000, 2.0), (2000, 4.0), (8000, 16.0)]) == pytest.approx(1.0)
    assert growth.power([(1000, 2.0), (4000, 32.0)]) == pytest.approx(2.0)
    assert np.isnan(growth.power([(1000, 2.0)]))
