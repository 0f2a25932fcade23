import lzma
import re
from pathlib import Path

import gtsam
import numpy as np
import numpy.typing as npt
import pytest
from typer.testing import CliRunner

from factors import AnchoredSighting, Sighting, UncertainPose, VertexId
from frontend import se2
from mrtm.evaluation import nees
from tools import mrclam
from tools.mrclam_data.dataset import DatasetError, read_dataset
from tools.mrclam_data.joining import agreeing
from tools.mrclam_data.odometry import LAG, PER_METRE, PER_RADIAN, PER_SECOND, Odometry
from tools.mrclam_data.run import play
from tools.mrclam_data.team import select

FloatArray = npt.NDArray[np.float64]

STEP = 0.1
BARCODES = {1: 5, 2: 14, 3: 41, 6: 63}
SIGMA_RANGE, SIGMA_BEARING = 0.10, 0.02


def commands(rng: np.random.Generator, seconds: float) -> FloatArray:
    """(n, 3) a command each STEP: driving forward, turning now and then, standing now and then."""
    count = int(seconds / STEP)
    modes = rng.choice(4, size=count // 20 + 1, p=[0.5, 0.2, 0.2, 0.1]).repeat(20)[:count]
    forward = np.choose(modes, [0.10, 0.08, 0.08, 0.0])
    angular = np.choose(modes, [0.0, 0.35, -0.35, 0.0])
    return np.column_stack([np.arange(count) * STEP, forward, angular])


def drive(rng: np.random.Generator, given: FloatArray, start: FloatArray) -> FloatArray:
    """(n, 3) true poses at the times of the commands plus LAG, off by the noise that the model states."""
    poses = [start]
    for _, v, w in given[:-1]:
        chord = v * STEP * np.sinc(0.5 * w * STEP / np.pi)
        step = np.array([chord * np.cos(0.5 * w * STEP), chord * np.sin(0.5 * w * STEP), w * STEP])
        variance = np.abs([v * STEP, w * STEP, STEP]) @ np.stack([PER_METRE, PER_RADIAN, PER_SECOND])
        noise = gtsam.Pose2.Expmap(rng.normal(0.0, np.sqrt(variance)))
        poses.append(se2.compose(se2.compose(poses[-1], step), np.array([noise.x(), noise.y(), noise.theta()])))
    return np.array(poses)


def write(path: Path, name: str, rows: FloatArray, packed: bool) -> None:
    text = "# made up\n" + "".join(" \t ".join(f"{value:.6f}" for value in row) + " \n" for row in rows)
    if packed:
        with lzma.open(path / f"{name}.dat.xz", "wt") as file:
            file.write(text)
    else:
        (path / f"{name}.dat").write_text(text)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three robots for four minutes, each seeing the others each second if near and ahead; every tenth is misread."""
    path, rng = tmp_path_factory.mktemp("mrclam"), np.random.default_rng(5)
    starts = {1: np.array([0.0, 0.0, 0.3]), 2: np.array([2.0, 1.0, -2.5]), 3: np.array([0.5, 2.5, -1.0])}
    given = {robot: commands(rng, 240.0) for robot in starts}
    true = {robot: drive(rng, given[robot], starts[robot]) for robot in starts}
    write(path, "Barcodes", np.array(list(BARCODES.items()), dtype=np.float64), packed=True)
    for robot, odometry in given.items():
        seen = [[12.0, 63, 3.0, 0.1]]  # a landmark, of no use
        for k in range(10, len(odometry), 10):
            for other in starts.keys() - {robot}:
                x, y, _ = se2.between(true[robot][k], true[other][k])
                if np.hypot(x, y) < 6.0 and abs(np.arctan2(y, x)) < 1.0:
                    misread = rng.random() < 0.1
                    barcode = BARCODES[6 - robot - other if misread else other]
                    r, b = rng.normal([np.hypot(x, y), np.arctan2(y, x)], [SIGMA_RANGE, SIGMA_BEARING])
                    seen.append([odometry[k, 0] + LAG, barcode, r, b])
        write(path, f"Robot{robot}_Odometry", odometry, packed=robot == 1)
        write(path, f"Robot{robot}_Measurement", np.array(seen), packed=robot == 2)
        truth = np.column_stack([odometry[:, 0] + LAG, true[robot]])
        write(path, f"Robot{robot}_Groundtruth", truth, packed=robot == 3)
    return path


def test_reads_plain_and_packed_files_and_leaves_landmarks_out(dataset: Path) -> None:
    logs = read_dataset(dataset)
    assert list(logs) == [1, 2, 3]
    assert logs[1].odometry.shape == (2400, 3)
    assert set(logs[1].sightings[:, 1]) == {2.0, 3.0}
    np.testing.assert_allclose(logs[1].truth.poses[0], [0.0, 0.0, 0.3])


def test_refuses_what_is_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"Barcodes.dat: not there"):
        read_dataset(tmp_path)
    (tmp_path / "Barcodes.dat").write_text("1 5\n")
    with pytest.raises(DatasetError, match=r"no Robot\*_Odometry.dat here"):
        read_dataset(tmp_path)
    for name, text, why in (
        ("Odometry", "0.0 x 0.1\n", "could not convert"),
        ("Odometry", "0.0 0.1\n", "expected 3 finite numbers a line"),
        ("Groundtruth", "0.0 nan 0.0 0.0\n", "expected 4 finite numbers a line"),
    ):
        for kind, good in (("Odometry", "0 0 0\n"), ("Measurement", "0 5 1 0\n"), ("Groundtruth", "0 0 0 0\n")):
            (tmp_path / f"Robot1_{kind}.dat").write_text(good)
        (tmp_path / f"Robot1_{name}.dat").write_text(text)
        with pytest.raises(DatasetError, match=rf"Robot1_{name}.dat: .*{why}"):
            read_dataset(tmp_path)
    result = CliRunner().invoke(mrclam.app, [str(tmp_path)])
    assert result.exit_code == 1
    assert "Robot1_Groundtruth.dat" in result.stderr


@pytest.mark.slow
def test_odometry_is_the_arc_and_its_covariance_that_of_the_noise() -> None:
    rng = np.random.default_rng(1)
    given = commands(rng, 20.0)
    measured = Odometry(given).motion(LAG, given[-1, 0] + LAG)
    quiet = np.array([[0.0, 0.5, np.pi / 4], [4.0, 0.0, 0.0]])
    arc = Odometry(quiet).motion(0.0, 9.0).pose  # half a circle of radius 2 / pi
    assert arc.equals(gtsam.Pose2(0.0, 4.0 / np.pi, np.pi), 1e-9)
    ends = np.array([drive(rng, given, np.zeros(3))[-1] for _ in range(400)])
    pose = np.array([measured.pose.x(), measured.pose.y(), measured.pose.theta()])
    values = nees(ends, np.tile(pose, (400, 1)), np.tile(measured.covariance, (400, 1, 1)))
    assert values.mean() == pytest.approx(1.0, abs=0.2)


def test_odometry_in_parts_is_odometry_at_once() -> None:
    wheels = Odometry(commands(np.random.default_rng(2), 30.0))
    times = np.array([0.5, 3.33, 3.34, 17.0, 25.25])
    path = wheels.path(times)
    whole = wheels.motion(0.5, 25.25).pose
    np.testing.assert_allclose(path[-1, :2], [whole.x(), whole.y()], atol=1e-9)
    assert np.cos(path[-1, 2] - whole.theta()) == pytest.approx(1.0)


def test_agreeing_sightings_leave_out_the_false_ones() -> None:
    rng, truth = np.random.default_rng(3), gtsam.Pose2(2.0, -1.0, 2.0)
    first, second = VertexId("1", 0), VertexId("2", 0)
    sightings, false = [], []
    for i in range(10):
        anchor = UncertainPose(gtsam.Pose2(0.3 * i, 0.1 * i, 0.2 * i), np.diag([1e-4, 1e-4, 1e-4]))
        seen = truth.compose(anchor.pose)
        r, b = rng.normal([np.hypot(seen.x(), seen.y()), np.arctan2(seen.y(), seen.x())], [0.1, 0.02])
        r += 2.0 if i in (2, 7) else 0.0
        at = UncertainPose(gtsam.Pose2(), np.zeros((3, 3)))
        sightings.append(AnchoredSighting(Sighting(r, b, None, 0.1, 0.02, None), first, second, at, anchor))
        false += [sightings[-1]] if i in (2, 7) else []
    found = agreeing(sightings)
    assert not set(found) & set(false)
    assert len(found) >= 7
    assert agreeing(sightings[:3]) == []
    assert agreeing([*sightings[:4], *false, *false]) == []


def test_sightings_thin_out_by_pair() -> None:
    rows = np.array([[0.0, 2, 1, 0], [0.5, 2, 1, 0], [0.6, 3, 1, 0], [1.1, 2, 1, 0]])
    seen = select({1: rows, 2: np.array([[0.0, 3, 1, 0]])}, 1.0, 0.1, 0.02)
    assert [(s.time, s.observer, s.observed) for s in seen] == [(0.0, 1, 2), (0.0, 2, 3), (0.6, 1, 3), (1.1, 1, 2)]


@pytest.mark.slow
def test_simulated_team_finds_itself(dataset: Path) -> None:
    """With every tenth barcode misread the robots come into one frame, and err half as much as by odometry."""
    logs = read_dataset(dataset)
    seen = select({r: log.sightings for r, log in logs.items()}, 1.0, SIGMA_RANGE, SIGMA_BEARING)
    outcome = play(logs, seen, 30.0)
    assert sorted(outcome.robots) == [1, 2, 3]
    assert outcome.joined < 100.0
    joint, alone = outcome.ate(outcome.joint), outcome.ate(outcome.true_start)
    assert joint.translation.rmse < 0.5 * alone.translation.rmse
    assert outcome.ate(outcome.online).translation.rmse < 0.5 * alone.translation.rmse
    assert 0.3 < outcome.honesty["joint vertex poses"].mean() < 3.0
    assert outcome.honesty["odometry edges"].mean() == pytest.approx(1.0, abs=0.25)
    assert np.median(outcome.honesty["sightings"]) == pytest.approx(0.69, abs=0.2)  # the mean is the false ones'
    assert outcome.false_sightings > 0.03 * len(seen)


def test_command_writes_table_and_picture(dataset: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(mrclam.app, [str(dataset), "--interval", "4", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert "| joint map, at the end |" in (tmp_path / "mrclam.md").read_text()
    assert (tmp_path / "mrclam.png").stat().st_size > 10_000


@pytest.mark.slow
def test_dataset_7(data: Path) -> None:
    """Five real robots: at most a quarter of the error of odometry alone, and covariances to be believed."""
    folder = data / "mrclam" / "MRCLAM_Dataset7"
    if not folder.is_dir():
        pytest.skip(f"no MRCLAM data set in {data}")
    result = CliRunner().invoke(mrclam.app, [str(folder), "--interval", "5"])
    assert result.exit_code == 0, result.output
    assert "robots 1, 2, 3, 4, 5" in result.stdout
    ratio = re.search(r"from the true start: ([\d.]+)\.\n", result.stdout)
    assert ratio is not None
    assert float(ratio[1]) < 0.25
    honest = re.search(r"\| joint vertex poses \| \d+ \| ([\d.]+)", result.stdout)
    assert honest is not None
    assert 0.5 < float(honest[1]) < 2.0
