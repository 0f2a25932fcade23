"""False sightings added to a session: how many, which, and what a cluster of them agrees on."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from frontend.readers import open_log
from mrtm.evaluation.trajectory import interpolate, read_tum
from mrtm.team.session_file import TeamSession, TimedSighting, open_session, read_session
from mrtm.team.sightings_file import read_sightings
from tools.false_sightings import app
from tools.simulation.poses import between, compose

DEMO = Path(__file__).parents[2] / "data" / "demo" / "team.yaml"


def run(*arguments: str | Path) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def false_of(session: TeamSession, out: Path) -> tuple[TimedSighting, ...]:
    return read_sightings(out / "false.csv", [member.name for member in session.members])


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_the_copy_holds_all_true_ones_and_the_share_of_false_ones(share: float, tmp_path: Path) -> None:
    run(DEMO, tmp_path, "--share", str(share), "--seed", "4")
    before, after = read_session(DEMO), open_session(tmp_path / "team.yaml")
    false = false_of(after, tmp_path)
    assert set(after.sightings) == set(before.sightings) | set(false)
    assert not set(before.sightings) & set(false)
    assert len(false) / len(after.sightings) == pytest.approx(share, abs=0.5 / len(after.sightings))
    for old, new in zip(before.members, after.members, strict=True):
        assert (old.name, old.begin, old.end, old.start) == (new.name, new.begin, new.end, new.start)
        assert new.log.samefile(old.log)
        assert after.truth[new.name].samefile(before.truth[old.name])


def test_the_same_seed_makes_the_same_files_and_another_one_others(tmp_path: Path) -> None:
    for name, seed in (("a", "0"), ("b", "0"), ("c", "1")):
        run(DEMO, tmp_path / name, "--share", "0.5", "--cluster", "2", "--seed", seed)
    a, b, c = ((tmp_path / name / "sightings.csv").read_bytes() for name in "abc")
    assert a == b != c


def test_a_cluster_agrees_on_one_wrong_offset(tmp_path: Path) -> None:
    run(DEMO, tmp_path, "--cluster", "4", "--seed", "3")
    session = open_session(tmp_path / "team.yaml")
    false = false_of(session, tmp_path)
    assert len(false) == 4
    assert len({(s.observer, s.observed) for s in false}) == 1
    offsets, seen = [], []
    for sighting in false:
        poses = {}
        for member in session.members:
            first = next(iter(open_log(member.log).scans())).time
            at = np.array([sighting.time - member.start + first])
            poses[member.name] = interpolate(read_tum(session.truth[member.name]), at)[0][0]
        one = sighting.measurement
        assert one.heading is not None
        shown = np.array((*one.position, one.heading))
        observer, observed = poses[sighting.observer], poses[sighting.observed]
        assert np.hypot(*(one.position - between(observer, observed)[:2])) > 1.5  # wrong
        offsets.append(compose(compose(observer, shown), between(observed, np.zeros(3))))
        seen.append(observed)
    turns = np.array(offsets)[:, 2] - offsets[0][2]
    assert np.abs(np.arctan2(np.sin(turns), np.cos(turns))).max() < 5 * np.sqrt(2) * 0.05
    # An error of the heading turns the frame about where the observed robot was: so compare where it comes to be.
    places = np.array([compose(offset, seen[0])[:2] for offset in offsets])
    moved = max(np.hypot(*(pose - seen[0])[:2]) for pose in seen)
    assert np.hypot(*(places - places[0]).T).max() < 5 * np.sqrt(2) * np.hypot(0.05, np.hypot(8 * 0.02, moved * 0.05))


def test_a_cluster_needs_trajectories(tmp_path: Path) -> None:
    session = tmp_path / "team.yaml"
    logs = "".join(f"  {name}: {{log: {DEMO.parent / name}.clf.gz}}\n" for name in ("red", "blue"))
    session.write_text(f"robots:\n{logs}", encoding="utf-8")
    result = CliRunner().invoke(app, [str(session), str(tmp_path / "out"), "--cluster", "3"])
    assert result.exit_code == 1
    assert "no truth of red; run it and give --trajectories" in result.output
    run(session, tmp_path / "out", "--cluster", "3", "--trajectories", DEMO.parent / "truth")
    assert len(open_session(tmp_path / "out" / "team.yaml").sightings) == 3


def test_a_session_is_never_overwritten(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, [str(DEMO), str(DEMO.parent), "--share", "0.3"])
    assert result.exit_code == 1
    assert "the session's own folder" in result.output
