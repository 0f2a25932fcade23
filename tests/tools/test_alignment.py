"""The measuring of alignment: cases with truth, and that alignment does well in one building."""

from pathlib import Path

import numpy as np
import pytest

from tools.aligning.figure import draw
from tools.aligning.pairs import ROOM, ROOMS, Case, run, twins


def test_twin_rooms_are_equal() -> None:
    plan = twins(3)
    boxes = np.array(plan.boxes).reshape(ROOMS, -1, 5)
    for i in range(1, ROOMS):
        np.testing.assert_allclose(boxes[i] - boxes[0], np.broadcast_to((i * ROOM, 0, 0, 0, 0), boxes[0].shape))


def test_nothing_met_is_not_accepted() -> None:
    case = Case("hall", "true", np.zeros(3), 0.1, None)
    assert not case.accepted
    assert not case.is_false
    assert np.isnan(case.nees)


@pytest.mark.slow
def test_alignment_in_cluttered_rooms(tmp_path: Path) -> None:
    cases = run("cluttered", 0, np.array([0.2, 0.2, 0.03]))
    true = [case for case in cases if case.kind == "true"]
    accepted = [case for case in true if case.accepted]
    assert len(true) >= 4
    assert len(accepted) >= 0.9 * len(true)
    assert not any(case.is_false for case in cases)
    assert max(np.hypot(*case.error[:2]) for case in accepted) < 0.1
    # Pairs share maps, so their errors are not independent: the bounds are wide.
    assert 0.2 < np.mean([case.nees for case in accepted]) < 3.0
    draw(cases, "cluttered", tmp_path / "alignment.png")
    assert (tmp_path / "alignment.png").stat().st_size > 10_000
