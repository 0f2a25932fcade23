"""Where a run or a comparison may write: nothing that it reads is lost, and what cannot be written to shows first."""

from pathlib import Path

import pytest

from mrtm.errors import OutputError
from mrtm.output.export import export
from mrtm.output.place import check_outputs, comparison_outputs, earlier_files, file_output, run_outputs
from mrtm.session import compare_session, run_session
from tests.mrtm.sample_run import sample_run
from tests.mrtm.small_logs import ring, small
from tools.simulation import write_carmen

ROBOTS = ("red", "b.lue")


def refused(out: Path, *inputs: Path, robots: tuple[str, ...] = ROBOTS) -> str:
    """What is said about a run; empty if nothing is."""
    try:
        check_outputs(run_outputs(out, robots), inputs, earlier_files(out))
    except OutputError as error:
        return str(error)
    return ""


def test_a_run_writes_what_it_says_it_may(tmp_path: Path) -> None:
    export(sample_run(), tmp_path)
    outputs = dict(run_outputs(tmp_path, list(sample_run().trajectories)))
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert all(outputs[path.parent].fullmatch(path.name) for path in written)
    assert {*earlier_files(tmp_path), tmp_path / "run.json"} == set(written)


@pytest.mark.parametrize(
    "name",
    [
        "map.yaml", "map-12.pgm", "run.json", "graph.g2o", "evaluation.json", "trajectory/red.tum",
        "trajectory/b.lue.tum", "local_maps/red-3.npz",
    ],
)  # fmt: skip
def test_what_is_read_is_not_written_over(tmp_path: Path, name: str) -> None:
    assert refused(tmp_path / "out", tmp_path / "out" / name).endswith(
        "would be written over; move it, or write elsewhere"
    )


@pytest.mark.parametrize(
    "name", ["map.clf", "map-01.png", "map-notes.png", "trajectory/truth.tum", "trajectory/bxlue.tum"]
)
def test_what_a_run_would_not_touch_may_lie_there(tmp_path: Path, name: str) -> None:
    assert refused(tmp_path, tmp_path / name) == ""


def test_links_do_not_hide_what_would_be_written_over(tmp_path: Path) -> None:
    out, other = tmp_path / "out", tmp_path / "other"
    other.mkdir()
    out.mkdir()
    (out / "map.yaml").write_text("robots: {}")
    (tmp_path / "team.yaml").symlink_to(out / "map.yaml")
    assert refused(out, tmp_path / "team.yaml").startswith(f"{tmp_path / 'team.yaml'}: is read")
    (tmp_path / "again").symlink_to(out)
    assert refused(out, tmp_path / "again" / "map.yaml")
    (out / "trajectory").symlink_to(other)
    assert refused(out, other / "red.tum")
    (out / "map.png").symlink_to(other / "true.png")  # the link would be lost
    assert refused(out, out / "map.png")


def test_what_an_earlier_run_wrote_is_not_removed_where_it_is_read(tmp_path: Path) -> None:
    export(sample_run(), tmp_path)
    assert refused(tmp_path, tmp_path / "trajectory" / "green.tum").endswith("as an earlier run's; write elsewhere")
    assert refused(tmp_path) == ""


def test_a_place_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert refused(tmp_path / "file").startswith(f"{tmp_path / 'file'}: cannot be written into (not a directory)")
    assert refused(tmp_path / "file" / "out").startswith(f"{tmp_path / 'file' / 'out'}: cannot be written into")
    assert refused(Path("/proc/mrtm")).startswith("/proc/mrtm: cannot be written into")
    out = tmp_path / "out"
    out.mkdir()
    (out / "trajectory").touch()
    assert refused(out).startswith(f"{out / 'trajectory'}: cannot be written into (not a directory)")
    (out / "trajectory").unlink()
    (out / "map-2.png").mkdir()
    assert refused(out).startswith(f"{out / 'map-2.png'}: a directory where a file is to be written")


def test_looking_leaves_nothing(tmp_path: Path) -> None:
    assert refused(tmp_path / "a" / "b") == ""
    assert list(tmp_path.iterdir()) == []


def test_a_single_file_and_what_it_is_made_from(tmp_path: Path) -> None:
    out = tmp_path / "a.clf"
    for name in ("a.clf", "a.clf.part"):
        with pytest.raises(OutputError, match="is read"):
            check_outputs(file_output(out), [tmp_path / name])
    check_outputs(file_output(out), [tmp_path / "a.clf.gz"])


def test_sessions_are_refused_before_they_are_mapped(tmp_path: Path) -> None:
    write_carmen(ring(), tmp_path / "red.clf")

    def progress(done: float, doing: str) -> None:
        pytest.fail("mapping has begun")

    session = tmp_path / "map.yaml"
    session.write_text("robots: {red: {log: red.clf}}\n")
    with pytest.raises(OutputError, match=r"map\.yaml: is read"):
        run_session(session, tmp_path, small(), progress)
    session = tmp_path / "team.yaml"
    session.write_text("robots: {red: {log: red.clf}}\nrelations: comparison.md\n")
    with pytest.raises(OutputError, match=r"comparison\.md: is read"):
        compare_session(session, tmp_path, small(), progress)
    with pytest.raises(OutputError, match=r"run\.json: is read"):
        run_session(tmp_path / "red.clf", tmp_path, small(), progress, kept=[tmp_path / "run.json"])
    assert dict(comparison_outputs(tmp_path, ROBOTS))[tmp_path].fullmatch("fig3-b.lue.png")
