"""The benchmark: its scoring, parsing and counting against what is known; never a timing."""

import json
import shutil
import sys
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from frontend import matching, se2
from frontend.grid import Maps, insert
from frontend.points import points_of
from frontend.records import FloatArray
from mrtm.evaluation import Statistics, TimedPoses
from tools.bench import plot
from tools.bench.anchors import Anchor, read_anchors
from tools.bench.bars import draw_day
from tools.bench.day import Day, Hour, drive_day
from tools.bench.kernels import Counter, nanoseconds_per_evaluation, nanoseconds_per_lookup, observed
from tools.bench.logs import BenchLog, Score, find_logs, score
from tools.bench.machine import Setting
from tools.bench.peers import PEERS, IcpSlam, RbpfSlam, YagSlam, filter_steps
from tools.bench.process import Cost, ProcessError, measure
from tools.bench.rawlog import write_rawlog
from tools.bench.recording import Recording, carried, read_recording
from tools.bench.stages import profile
from tools.bench.suite import LogReport, Outcome, Spread, run_log, stages
from tools.bench.systems import Mrtm, OutputError
from tools.bench.table import differences, report
from tools.benchmark import app
from tools.simulation import LMS200, PERFECT, hall, simulate, write_carmen, write_tum

SETTING = Setting("a processor", 2, 8.0, "an operating system", 0.1, "abc1234", date(2026, 1, 2))


@pytest.fixture(scope="module")
def drive() -> Recording:
    """Some metres in a hall, with perfect odometry and a clock that steps back once."""
    log = simulate(hall(), "tour", replace(LMS200, rate=5.0), PERFECT, seed=3)
    n = 120
    times = log.times[:n].copy()
    times[60:] -= 0.5
    return Recording(times, log.odometry[:n], log.ranges[:n], LMS200.record())


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> BenchLog:
    """The same drive on disk, with its truth."""
    directory = tmp_path_factory.mktemp("small")
    log = simulate(hall(), "tour", replace(LMS200, rate=5.0), seed=3)
    n = 150
    cut = replace(log, times=log.times[:n], odometry=log.odometry[:n], poses=log.poses[:n], ranges=log.ranges[:n])
    write_carmen(cut, directory / "small.clf")
    write_tum(cut.times, cut.poses, directory / "truth.tum")
    return BenchLog("small", directory / "small.clf", reference=directory / "truth.tum")


# Scoring


def test_poses_between_key_scans_are_carried_by_odometry(drive: Recording) -> None:
    keys = np.array([0, 40, 41, 100])
    shift = np.array([3.0, -2.0, 0.7])
    poses = se2.compose(shift, drive.odometry[keys])
    whole = carried(drive, keys, poses)
    assert np.allclose(se2.between(whole.poses, se2.compose(shift, drive.odometry)), 0.0, atol=1e-9)
    poses[1] = se2.compose(poses[1], np.array([0.1, 0.0, 0.0]))  # a wrong key pose is wrong until the next one
    off = np.hypot(*(carried(drive, keys, poses).poses - whole.poses)[:, :2].T)
    assert off[40] == pytest.approx(0.1)
    assert np.flatnonzero(off > 1e-9).tolist() == [40]


def test_scans_before_the_first_key_scan_are_carried_back(drive: Recording) -> None:
    keys = np.array([10, 50])
    whole = carried(drive, keys, drive.odometry[keys])
    assert np.allclose(whole.poses, drive.odometry, atol=1e-9)


def test_a_peers_trajectory_is_scored_as_ours(drive: Recording, tmp_path: Path) -> None:
    rising = replace(drive, times=np.linspace(0.0, 30.0, len(drive.times)))
    relations = tmp_path / "x.relations"
    pairs = [(i, i + 50) for i in range(0, 60, 10)]
    truth = [se2.between(rising.odometry[i], rising.odometry[j]) for i, j in pairs]
    relations.write_text(
        "".join(
            f"{rising.times[i]} {rising.times[j]} {x} {y} 0 0 0 {t}\n"
            for (i, j), (x, y, t) in zip(pairs, truth, strict=True)
        )
    )
    log = BenchLog("x", Path("x.clf"), relations=relations)
    moved = se2.compose(np.array([1.0, 2.0, 3.0]), rising.odometry)
    perfect = score(log, TimedPoses(rising.times, moved))
    assert perfect.headline == pytest.approx((0.0, 0.0), abs=1e-6)
    assert (perfect.measured, perfect.left_out) == (6, 0)
    stretched = moved * np.array([1.1, 1.1, 1.0])  # every way ten per cent too long
    ways = [float(np.hypot(x, y)) for x, y, _ in truth]
    assert score(log, TimedPoses(rising.times, stretched)).headline[0] == pytest.approx(0.1 * np.mean(ways))


def test_without_relations_the_headline_is_the_rmse_after_alignment(small: BenchLog) -> None:
    recording = read_recording(small.path)
    truth = np.loadtxt(small.reference or "")
    poses = np.column_stack([truth[:, 1:3], 2 * np.arctan2(truth[:, 6], truth[:, 7])])
    moved = se2.compose(np.array([5.0, 0.0, 1.0]), poses)
    result = score(small, TimedPoses(recording.times, moved))
    assert small.metric == "ATE, RMSE"
    assert result.headline[0] < 1e-5
    assert result.measured == 150


# Peers


def test_filter_steps_follow_both_distances() -> None:
    x = np.concatenate([np.arange(0.0, 1.0, 0.15), np.full(5, 0.9)])
    theta = np.concatenate([np.zeros(len(x) - 5), [0.1, 0.2, 0.3, 0.4, 0.5]])
    odometry = np.column_stack([x, np.zeros_like(x), theta])
    # Every second step of 0.15 m is beyond 0.2 m; then every second turn of 0.1 rad beyond 10 degrees.
    assert filter_steps(odometry).tolist() == [0, 2, 4, 6, 8, 10]


def test_a_scan_that_goes_into_the_map_is_a_step_of_the_filter_as_well() -> None:
    odometry = np.zeros((40, 3))
    odometry[:, 2] = np.deg2rad(4.9) * np.arange(40)  # steps after 3 scans (14.7 deg), the map after 7 (34.3 deg)
    assert filter_steps(odometry).tolist()[:7] == [0, 3, 6, 7, 10, 13, 14]


def test_outputs_of_the_peers_are_read(drive: Recording, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    n = len(drive.times)
    (out / "log_estimated_path.txt").write_text("".join(f"{i} {i}.5 {-i} 0.25\n" for i in range(n)))
    assert IcpSlam().trajectory(drive, tmp_path).poses[7].tolist() == [7.5, -7.0, 0.25]
    keys = filter_steps(drive.odometry)
    poses = drive.odometry[keys]
    lines = ["0.000 0.000 0.000\n"] + [f"{x:.3f} {y:.3f} {t:.3f}\n" for x, y, t in poses]
    (out / "most_likely_path.txt").write_text("".join(lines))
    assert np.allclose(RbpfSlam().trajectory(drive, tmp_path).poses, drive.odometry, atol=2e-3)
    (out / "most_likely_path.txt").write_text("".join(lines[:-1]))
    with pytest.raises(OutputError, match="steps of its filter"):
        RbpfSlam().trajectory(drive, tmp_path)
    np.savez(tmp_path / "out.npz", keys=keys, poses=poses)
    assert np.allclose(YagSlam().trajectory(drive, tmp_path).poses, drive.odometry, atol=1e-9)


def test_a_missing_pose_is_an_error(drive: Recording, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/log_estimated_path.txt").write_text("0 0 0 0\n1 0 0 0\n")
    with pytest.raises(OutputError, match="2 poses for 120 scans"):
        IcpSlam().trajectory(drive, tmp_path)


def test_rawlog_holds_the_log(drive: Recording, tmp_path: Path) -> None:
    write_rawlog(drive, tmp_path / "x.rawlog")
    read = read_recording(tmp_path / "x.rawlog")  # by the project's own reader of MRPT's logs, written by others
    assert np.array_equal(np.isfinite(read.ranges), np.isfinite(drive.ranges))
    usable = np.isfinite(drive.ranges)
    assert np.array_equal(read.ranges[usable], drive.ranges[usable])
    assert np.allclose(read.odometry, se2.between(drive.odometry[0], drive.odometry), atol=1e-9)
    bearings = read.laser.angles + read.laser.mount[2]  # MRPT's fans look straight ahead, so the scanner is turned
    assert np.allclose(bearings, drive.laser.angles, atol=1e-6)
    assert np.all(np.diff(read.times) >= 0)  # although the log's clock steps back
    assert read.times[:60] == pytest.approx(drive.times[:60], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("peer", PEERS, ids=lambda peer: peer.name)
def test_an_installed_peer_maps_the_small_log(peer: IcpSlam | RbpfSlam | YagSlam, small: BenchLog) -> None:
    if not peer.installed():
        pytest.skip(f"not installed: {peer.install}")
    (outcome,) = run_log(small, [peer], 1, 1, 120.0, lambda line: None).outcomes
    assert outcome.failure == ""
    assert outcome.scores[0].headline[0] < 0.5


# Running and measuring


def test_a_process_is_measured_by_itself(tmp_path: Path) -> None:
    ballast = np.ones(40_000_000)  # 320 MB in this process, of which the child must not be accused
    cost = measure([sys.executable, "-I", "-c", "x = bytearray(60_000_000)"], tmp_path / "log", 60)
    assert ballast.nbytes > 3e8
    assert 60 < cost.memory < 200
    assert cost.cpu > 0
    assert cost.wall > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "limit", "complaint"),
    [
        (["no-such-program-anywhere"], 60, "cannot be run"),
        ([sys.executable, "-c", "raise SystemExit('it is broken')"], 60, "code 1: it is broken"),
        ([sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"], 60, "killed by signal 9"),
        ([sys.executable, "-c", "import os; os.kill(os.getppid(), 9)"], 60, "killed by signal 9, with"),
        ([sys.executable, "-c", "import time; time.sleep(60)"], 1, "stopped after 1 s"),
    ],
)
def test_a_process_that_fails_is_one_line(command: list[str], limit: float, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ProcessError, match=complaint) as caught:
        measure(command, tmp_path / "log", limit)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_systems_run_in_turn_and_failures_are_kept(small: BenchLog) -> None:
    class Broken(IcpSlam):
        def installed(self) -> bool:
            return True

        def prepare(self, log: BenchLog, recording: Recording, work: Path) -> list[str]:
            return [sys.executable, "-c", "raise SystemExit(3)"]

    class Absent(IcpSlam):
        def installed(self) -> bool:
            return False

    told: list[str] = []
    result = run_log(small, [Mrtm(), Broken(), Absent()], 1, 1, 300.0, told.append)
    ours, broken, absent = result.outcomes
    assert ours.scores[0].headline[0] < 0.2
    assert ours.stages[0]["start-up"] > 0
    assert sum(ours.stages[0].values()) == pytest.approx(ours.costs[0].wall)
    assert ours.config["frontend"]["particles"] == 40
    assert "ended with code 3" in broken.failure
    assert absent.failure == "not installed"
    assert result.scans == 150
    assert len(told) == 2


def test_stages_leave_nothing_out() -> None:
    assert stages({"mapping": 3.0, "output": 1.0, "total": 4.0}, 5.5) == {
        "mapping": 3.0, "output": 1.0, "start-up": 1.5,
    }  # fmt: skip


# Reports


def _statistics(mean: float) -> Statistics:
    return Statistics(mean, mean / 2, mean, mean, mean)


def _report(log: BenchLog) -> LogReport:
    def errors(mean: float) -> Score:
        return Score(_statistics(mean), _statistics(10 * mean), 100, 3, relative=True)

    ours = Outcome("mrtm", [Cost(4.0, 6.0, 300.0), Cost(5.0, 7.0, 310.0), Cost(4.5, 6.5, 305.0)])
    ours.scores = [errors(0.02), errors(0.02), errors(0.02)]
    ours.stages = [{"mapping": 3.0, "start-up": 1.0}] * 3
    peer = Outcome("MRPT icp-slam", [Cost(9.0, 9.0, 50.0)], [errors(0.1)])
    return LogReport(log, 900, 450.0, errors(3.0), [ours, peer, Outcome("yag-slam (Karto)", failure="not installed")])


def test_the_table_tells_everything() -> None:
    log = BenchLog("intel", Path("intel.clf"), relations=Path("intel.relations"))
    anchors = {"intel": [Anchor("Cartographer", "Hess", (0.0229, 0.0239), 0.453, 179.0)]}
    systems = (Mrtm(), IcpSlam(), YagSlam())
    text = report(SETTING, [_report(log)], systems, anchors, ["seed = 3 (default 0)"], "preliminary", "p.png")
    rows = {line.split(" | ")[0].strip("| *"): line for line in text.splitlines() if line.startswith("|")}
    assert "0.0200 ± 0.0100 | 0.200 | 4.50 (4.00–5.00) | 6.50 (6.00–7.00) | 200 | 100 | 310 |" in rows["mrtm"]  # noqa: RUF001
    assert "0.1000 ± 0.0500 | 1.000 | 9.00 | 9.00 | 100 | 50 | 50 |" in rows["MRPT icp-slam"]
    assert "not installed" in rows["yag-slam (Karto)"]
    assert "0.0229 ± 0.0239 | 0.453 | 179 |  | 5 | 3 |" in rows["Cartographer [1]"]
    assert rows["mapping"].endswith("| 3.00 | 67 |")
    for part in (
        "**preliminary**",
        "a processor, 2 cores, 8 GB",
        "abc1234",
        "2026-01-02",
        "seed = 3",
        "[1] Hess",
        "p.png",
    ):
        assert part in text
    assert "(3 without a scan near)" in text


def test_only_parameters_that_differ_are_listed() -> None:
    default = {"seed": 0, "frontend": {"particles": 40, "motion": {"xy": 0.1}}}
    config = {"seed": 0, "frontend": {"particles": 60, "motion": {"xy": 0.2}}}
    assert list(differences(config, default)) == [
        "frontend.particles = 60 (default 40)",
        "frontend.motion.xy = 0.2 (default 0.1)",
    ]
    assert list(differences(default, default)) == []


def test_spread() -> None:
    assert Spread.of([3.0, 1.0, 2.0, 10.0]) == Spread(2.5, 1.0, 10.0)


def test_the_pictures_are_drawn(tmp_path: Path) -> None:
    log = BenchLog("intel", Path("intel.clf"), relations=Path("intel.relations"))
    plot.draw([_report(log), _report(replace(log, name="aces"))], read_anchors(), tmp_path / "a.png", "preliminary")
    draw_day(Day("a hall", [Hour(10, 1.0, 2.0, 100.0, 3), Hour(10, 1.0, 2.0, 110.0, 0)], 1.0, 0.1), tmp_path / "b.png")
    for picture in ("a.png", "b.png"):
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")


def test_anchors_of_every_log_have_a_source() -> None:
    anchors = read_anchors()
    assert set(anchors) == {"intel", "aces"}
    for rows in anchors.values():
        assert all(0 < row.metres[0] < 1 and len(row.source) > 10 for row in rows)
        assert any(row.measured for row in rows)
        assert any(not row.measured for row in rows)
    cartographer = next(row for row in anchors["intel"] if row.system == "Cartographer")
    assert (cartographer.metres[0], cartographer.degrees, cartographer.wall) == (0.0229, 0.453, 179)


def test_an_anchor_without_a_source_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "anchors.toml"
    file.write_text('[sources]\n[[anchor]]\nlog = "x"\nresults = [{ system = "a", source = "b", metres = [1, 1] }]\n')
    with pytest.raises(KeyError, match="b"):
        read_anchors(file)


def test_logs_are_found_with_their_truth(tmp_path: Path) -> None:
    for name in ("intel.clf.bz2", "intel.relations", "aces.clf.gz", "mit-csail.clf", "mit-csail.reference.tum"):
        (tmp_path / name).touch()
    found = find_logs([tmp_path / "nowhere", tmp_path])
    assert set(found) == {"demo", "intel", "csail"}  # ACES has no relations here
    assert found["intel"].metric == "relations, mean"
    assert found["csail"].reference == tmp_path / "mit-csail.reference.tum"
    assert found["demo"].path.exists()


# Profile and day


@pytest.mark.slow
def test_beam_evaluations_are_counted() -> None:
    scan = next(simulate(hall(), "tour", seed=1).scans())
    points = points_of(scan, 20.0, 181)
    maps = Maps.empty(1, 60.0, 0.05)
    maps.counts[0] = insert(
        maps.log_odds[0], maps.index[0], maps.surfels[0], maps.counts[0], maps.touched[0], maps.resolution,
        np.zeros(3), points.hits, points.clear, points.sensor,
    )  # fmt: skip

    def solve(start: FloatArray) -> None:
        matching.match(
            maps.log_odds[0], maps.index[0], maps.surfels[0], maps.resolution, points.hits, start, np.zeros(3),
            np.eye(3), 0.02, np.empty((3, 3)),
        )  # fmt: skip

    counter = Counter(every=2)
    start, again = np.array([0.05, -0.03, 0.01]), np.array([0.05, -0.03, 0.01])
    with observed(counter):
        solve(start)
        solve(again)
    assert np.array_equal(start, again)  # the repeated call, which is the first one's, left its arguments alone
    assert np.hypot(*start[:2]) < 0.02
    ((problem, passes),) = counter.problems
    assert 2 <= passes <= matching.MAX_ITERATIONS + 1
    assert counter.evaluations == {"match": 2 * passes * len(points.hits)}
    assert {name for _, _, name in counter.matching} == {"match"}
    assert nanoseconds_per_evaluation(counter.problems, 0.01) > 0
    assert nanoseconds_per_lookup(problem, 0.01) > 0
    solve(start)
    assert counter.evaluations == {"match": 2 * passes * len(points.hits)}  # no longer observed


@pytest.mark.slow
def test_profile_accounts_for_stages_kernels_and_matches(small: BenchLog, tmp_path: Path) -> None:
    measured = profile(small.path, [], tmp_path, runs=1)
    assert sum(measured.stages.values()) == pytest.approx(measured.cost.wall)
    kernels = {function.name for function in measured.functions if function.kernel}
    assert any(name.startswith("frontend/") for name in kernels)
    assert {function.name.split(": ")[1] for function in measured.functions if function.matching} == set(
        measured.evaluations
    )
    total = sum(measured.evaluations.values())
    assert 40 * 100 < total < 150 * 40 * 180 * 17
    assert len(measured.bound(2)) == 4


@pytest.mark.slow
def test_a_day_is_measured_hour_by_hour(tmp_path: Path) -> None:
    day = drive_day("hall", 2.0, 0.1, tmp_path)
    assert len(day.hours) == 2
    assert sum(hour.scans for hour in day.hours) == sum(1 for line in (tmp_path / "day.clf").open() if "FLASER" in line)
    assert 350 <= day.hours[0].scans <= 370
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert sum(hour.vertices for hour in day.hours) == sum(e["kind"] == "new vertex" for e in record["events"])
    assert day.ratio(lambda hour: hour.scans) == pytest.approx(1.0)


@pytest.mark.slow
def test_the_command_writes_table_and_picture(tmp_path: Path) -> None:
    arguments = ["--log", "demo", "--runs", "1", "--peer-runs", "0", "--out", str(tmp_path), "--set", "seed=3"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    (table,) = tmp_path.glob("*-benchmark.md")
    assert table.with_suffix(".png").exists()
    assert "seed = 3 (default 0)" in table.read_text()
    assert "## demo: 751 scans" in table.read_text()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [(["--log", "nowhere"], "no log 'nowhere' here"), (["--day", "--building", "castle"], "there is corridor")],
)
def test_what_the_user_got_wrong_is_one_line(arguments: list[str], complaint: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path)])
    assert result.exit_code == 1
    assert complaint in result.output
    assert "Traceback" not in result.output


def test_the_rawlog_is_one_that_mrpt_reads(drive: Recording, tmp_path: Path) -> None:
    if shutil.which("rawlog-edit") is None:
        pytest.skip("not installed: apt-get install mrpt-apps")
    write_rawlog(drive, tmp_path / "x.rawlog")
    measure(["rawlog-edit", "--info", "-i", str(tmp_path / "x.rawlog")], tmp_path / "said.txt", 60)
    said = (tmp_path / "said.txt").read_text()
    assert "Actions/SensoryFrame format       : Yes" in said
    assert "Overall number of objects         : 240" in said
