"""The command line as a user meets it: a process, its output and its exit code."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

import mrtm
from mrtm.config import load_config, to_yaml
from tests.mrtm.small_logs import ring, small
from tools.fuzzing.seeds import RUNS, TRAJECTORIES
from tools.simulation import write_carmen, write_tum

DEMO = Path(__file__).parents[2] / "data" / "demo"

HEAVY = ("numpy", "scipy", "numba", "gtsam", "matplotlib", "pydantic.main", "yaml")


def call(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mrtm", *map(str, arguments)]
    environment = os.environ | environment
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=environment)


def test_version() -> None:
    done = call("--version")
    assert (done.returncode, done.stdout.strip()) == (0, f"mrtm {mrtm.__version__}")


@pytest.mark.parametrize("command", [(), ("run",), ("compare",), ("evaluate",), ("config",)])
def test_help(command: tuple[str, ...]) -> None:
    done = call(*command, "--help")
    assert done.returncode == 0
    assert "Usage" in done.stdout


def test_help_loads_nothing_heavy() -> None:
    code = f"import sys, mrtm.cli; print([name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_config_prints_what_config_reads(tmp_path: Path) -> None:
    done = call("config", "--preset", "paper", "--set", "frontend.particles=60", "--set", "seed=3")
    assert done.returncode == 0
    path = tmp_path / "printed.yaml"
    path.write_text(done.stdout)
    assert load_config(path) == load_config(preset="paper", options=["frontend.particles=60", "seed=3"])
    assert call("config", "--config", path).stdout == done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("config", "--set", "frontend.particels=60"), "did you mean frontend.particles?"),
        (("config", "--config", "missing.yaml"), "missing.yaml: cannot be read"),
        (("config", "--preset", "papper"), "no such preset; there is: paper"),
        (("run", "missing.clf", "--out", "OUT", "--quiet"), "missing.clf: no such file"),
        (("run", "missing.clf", "--out", "OUT", "--seed", "-1"), "seed is -1: must be at least 0"),
        (("run", "EMPTY", "--out", "OUT", "--quiet"), "is empty"),
        (("compare", "missing.yaml", "--out", "OUT", "--quiet"), "missing.yaml: cannot be read"),
        (("evaluate", "OUT", "--relations", "missing.relations"), "OUT"),
        (("evaluate", "OUT", "--session", "missing.yaml"), "missing.yaml: cannot be read"),
        (("run", "EMPTY", "--out", "", "--quiet"), 'the place to write to is ""'),
        (("run", "EMPTY", "--out", "EMPTY", "--quiet"), "empty.clf: cannot be written into (not a directory)"),
        (("run", "EMPTY", "--out", "HERE", "--config", "HERE/map.yaml", "--quiet"), "map.yaml: is read"),
        (("convert", str(DEMO / "red.clf.gz"), ""), 'the place to write to is ""'),
        (("convert", str(DEMO / "red.clf.gz"), str(DEMO / "red.clf.gz")), "red.clf.gz: is read"),
    ],
)
def test_a_user_error_is_one_line_and_exit_code_2(tmp_path: Path, arguments: tuple[str, ...], said: str) -> None:
    places = {"OUT": str(tmp_path / "OUT"), "EMPTY": str(tmp_path / "empty.clf"), "HERE": str(tmp_path)}
    (tmp_path / "empty.clf").touch()
    (tmp_path / "map.yaml").write_text("seed: 1")
    done = call(*(places.get(argument, argument.replace("HERE", str(tmp_path))) for argument in arguments))
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: ")
    assert said in done.stderr


def test_where_the_machine_fails_is_one_line_and_exit_code_1(tmp_path: Path) -> None:
    log = tmp_path / "red.clf"
    write_carmen(ring(), log)
    command = [sys.executable, "-m", "mrtm", "convert", str(log), str(tmp_path / "copy.clf")]
    limited = ["bash", "-c", 'ulimit -f 10; exec "$@"', "bash", *command]
    done = subprocess.run(limited, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, f"error: {tmp_path / 'copy.clf'}: File too large\n")
    with Path("/dev/full").open("w") as full:
        for command in (["config"], ["info", str(log)]):
            called = [sys.executable, "-m", "mrtm", *command]
            done = subprocess.run(called, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
            assert (done.returncode, done.stderr) == (1, "error: cannot go on: No space left on device\n")


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (MemoryError("8 GiB"), 1, "error: out of memory (8 GiB); set fewer frontend.particles, or"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), 1, "error: cannot go on: Cannot allocate memory\n"),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), 1, ""),
    ],
)
def test_no_failure_is_a_traceback(error: Exception, code: int, said: str) -> None:
    """As the command raises it, in a process of its own for the sake of standard output."""
    program = f"import mrtm.cli as c; from unittest.mock import Mock; c.app = Mock(side_effect={error!r}); c.main()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == code
    assert done.stderr.startswith(said)
    assert done.stderr.count("\n") == (1 if said else 0)


@pytest.mark.slow
def test_a_session_names_what_to_measure_against(tmp_path: Path) -> None:
    (tmp_path / "trajectory").mkdir()
    (tmp_path / "trajectory" / "robot.tum").write_bytes(TRAJECTORIES[0])
    (tmp_path / "run.json").write_bytes(RUNS[0])
    (tmp_path / "true.tum").write_bytes(TRAJECTORIES[0])
    (tmp_path / "true.relations").write_text("3.5 5.5 -2 0 0 0 0 0\n")
    session = tmp_path / "team.yaml"
    team = "robots: {robot: {log: elsewhere.clf}}\n"  # the log is not needed
    session.write_text(f"{team}relations: true.relations\ntruth: {{robot: true.tum}}\n")
    done = call("evaluate", tmp_path, "--session", session)
    assert (done.returncode, done.stderr) == (0, "")
    measured = json.loads((tmp_path / "evaluation.json").read_text())
    assert measured["relations"]["count"] == 1
    assert measured["ate"][0]["count"] == 20
    done = call("evaluate", tmp_path, "--session", session, "--relations", tmp_path / "mine.relations")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "mine.relations: cannot be read" in done.stderr
    session.write_text(team)
    done = call("evaluate", tmp_path, "--session", session)
    assert done.returncode == 2
    assert "names neither" in done.stderr


@pytest.mark.slow
def test_a_comparison_prints_a_table_and_leaves_figures(tmp_path: Path) -> None:
    log = ring(2)
    write_carmen(log, tmp_path / "red.clf")
    write_tum(log.times, log.poses, tmp_path / "red.tum")
    session = tmp_path / "team.yaml"
    session.write_text("robots: {red: {log: red.clf}}\ntruth: {red: red.tum}\n")
    file = tmp_path / "small.yaml"
    file.write_text(to_yaml(small()))
    done = call("compare", session, "--out", tmp_path / "out", "--config", file, "--seed", 3, "--threads", 1)
    assert done.returncode == 0, done.stderr
    assert "tree only" in done.stdout
    assert "ATE RMSE, m" in done.stdout
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "comparison.md", "comparison.json", "fig3-red.png", "fig4.png", "fig5.png", "fig6.png",
    }  # fmt: skip
    ways = {way["name"]: way for way in json.loads((tmp_path / "out" / "comparison.json").read_text())["ways"]}
    assert ways["on line"]["ate"] < 0.05
    quiet = call("compare", session, "--out", tmp_path / "out", "--config", file, "--quiet")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


def children(process: int) -> list[int]:
    found: list[int] = []
    with suppress(OSError):  # it, or a thread of it, ended meanwhile
        for task in Path(f"/proc/{process}/task").glob("*/children"):
            found += map(int, task.read_text().split())
    return found


@pytest.mark.slow
@pytest.mark.skipif(not list(Path("/proc/self/task").glob("*/children")), reason="the system tells no children")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("working", [False, True], ids=["beginning", "working"])
def test_to_be_stopped_is_silent_and_leaves_nobody(
    tmp_path: Path, number: signal.Signals, code: int, working: bool
) -> None:
    """While the processes import, and while they map; as the interrupt key does it, the whole group."""
    command = [sys.executable, "-m", "mrtm", "run", str(DEMO / "team.yaml"), "--out", str(tmp_path), "--quiet"]
    started = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    late = time.monotonic() + 60.0
    while time.monotonic() < late and started.poll() is None:
        below = children(started.pid)
        if len(below) >= 2 and (not working or any(len(children(child)) >= 2 for child in below)):
            break
        time.sleep(0.01)
    os.killpg(started.pid, number)
    _, said = started.communicate(timeout=60)  # whoever is left holds the pipe
    assert (started.returncode, said) == (code, "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_names_that_the_screen_cannot_show(tmp_path: Path) -> None:
    write_carmen(ring(), tmp_path / "red.clf")
    session, file = tmp_path / "team.yaml", tmp_path / "small.yaml"
    session.write_text("robots: {\u8d64: {log: red.clf}}", encoding="utf-8")
    file.write_text(to_yaml(small()))
    command = ["run", session, "--config", file, "--out"]
    done = call(*command, tmp_path / "out", PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)  # the bar, and no warning of letters a font has not
    assert "in one map: ?\n" in done.stdout
    assert (tmp_path / "out" / "trajectory" / "\u8d64.tum").exists()
    old = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    done = call(*command, tmp_path / "again", "--quiet", **old)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "rename the robot" in done.stderr


@pytest.mark.slow
def test_the_demo_compared(tmp_path: Path) -> None:
    done = call("compare", DEMO / "team.yaml", "--out", tmp_path, "--quiet")
    assert (done.returncode, done.stderr) == (0, "")
    figures = {path.name for path in tmp_path.glob("*.png")}
    assert figures == {f"fig{name}.png" for name in ("3-red", "3-blue", "3-green", "4", "5", "6")}
    ways = {way["name"]: way for way in json.loads((tmp_path / "comparison.json").read_text())["ways"]}
    assert max(ways["on line"]["ate"], ways["off-line EM"]["ate"]) < 0.5 * ways["tree only"]["ate"]
    assert ways["on line"]["ate"] < 0.03
    assert ways["on line"]["crispness"]["disagreement"] < ways["tree only"]["crispness"]["disagreement"]


def test_a_wrong_use_is_exit_code_2() -> None:
    assert call("run").returncode == 2
    done = call("evaluate", "somewhere")
    assert done.returncode == 2
    assert "--relations" in done.stderr
