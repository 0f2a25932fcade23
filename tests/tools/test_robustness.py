"""False edges among loops, sightings and alignments: none may be believed, nearly all true ones must be."""

from pathlib import Path

import pytest

from factors import EdgeKind
from tools.robust.csail import FOLDER, csail
from tools.robust.feed import Outcome, feed
from tools.robust.problem import KINDS, Building, Problem

SHARES = (0.0, 0.1, 0.3, 0.5, 0.7)


def building(seed: int) -> Building:
    return Building(seed, robots=2, vertices=25)


def check(problem: Problem, outcome: Outcome, least: float = 0.97) -> None:
    assert [claim for claim in outcome.believed if not claim.true] == []
    assert len(outcome.believed) >= least * sum(claim.true for claim in problem.claims)


@pytest.mark.slow
@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("kinds", [*((kind,) for kind in KINDS), KINDS], ids=[*KINDS, "all"])
def test_random_false_edges(kinds: tuple[EdgeKind, ...], share: float) -> None:
    world = building(2)
    problem = world.problem.with_claims(world.false(dict.fromkeys(kinds, share)))
    outcome = feed(problem, every=2)
    check(problem, outcome)
    assert outcome.components == 1
    assert outcome.ate < 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_three_false_edges_that_agree_with_each_other(kind: EdgeKind) -> None:
    world = building(2)
    problem = world.problem.with_claims(world.cluster(kind, 3))
    check(problem, feed(problem))


def test_identical_rooms() -> None:
    world = building(2)
    problem = world.problem.with_claims(world.look_alike(0.5))
    check(problem, feed(problem))


@pytest.mark.slow
def test_the_public_set_with_250_false_closures(data: Path) -> None:
    if not (data / FOLDER).is_dir():
        pytest.skip(f"no {data / FOLDER}")
    problem = csail(data)
    assert sum(not claim.true for claim in problem.claims) == 250
    check(problem, feed(problem, every=300))


def test_counting_sees_what_is_wrong() -> None:
    """The same, with the doubts switched off."""
    world = building(2)
    problem = world.problem.with_claims(world.false({EdgeKind.LOOP: 0.5}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mrtm.joint.doubts._is_told_true", lambda *_: True)
        patch.setattr("mrtm.joint.doubts.Doubts._put_out", lambda *_: [])
        believed = feed(problem, every=8).believed
    assert any(not claim.true for claim in believed)
