"""Where the time of a run goes."""

import gc

import pytest

from mrtm.timing import Stages, uninterrupted


def test_the_collector_waits_until_the_outermost_block_is_done() -> None:
    assert gc.isenabled()
    with uninterrupted():
        with uninterrupted():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()


def test_the_collector_goes_on_after_an_error() -> None:
    with pytest.raises(KeyError), uninterrupted():
        raise KeyError
    assert gc.isenabled()


def test_stages_add_up_and_tell_what_ran_since() -> None:
    stages = Stages()
    with stages("match"):
        pass
    before = dict(stages.seconds)
    with pytest.raises(KeyError), stages("draw"):
        raise KeyError
    assert stages.seconds.keys() == {"match", "draw"}
    assert stages.since(before).keys() == {"draw"}
    assert stages.longest["match"] <= stages.seconds["match"]
