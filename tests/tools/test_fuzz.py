"""The fuzzer itself: it reaches every reader, repeats itself, and notices what it is there to notice."""

import subprocess
import sys
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from frontend.errors import LogError
from frontend.readers import _formats as formats
from frontend.readers import open_log
from frontend.records import LaserScan
from tools.fuzz import fuzz
from tools.fuzzing import seeds
from tools.fuzzing.mutate import LARGEST, mutate
from tools.fuzzing.targets import Target, targets

pytestmark = pytest.mark.slow  # thousands of damaged inputs

ROOT = Path(__file__).parents[2]
TARGETS = {target.name: target for target in targets()}


def found(read: Callable[[Path], None], out: Path, seconds: float = 2.0) -> Counter[str]:
    """What the fuzzer says of a reader like this, after three inputs."""
    return fuzz(Target("odd", [b"seed"], read), range(3), 0, seconds, 64, out)[0]


def test_every_format_of_logs_has_seeds_that_are_clean_logs_of_it(tmp_path: Path) -> None:
    assert seeds.LOGS.keys() == {reader.NAME for reader in formats()}
    for name, logs in seeds.LOGS.items():
        for content in logs:
            (tmp_path / "log").write_bytes(content)
            log = open_log(tmp_path / "log")
            assert log.format == name
            assert sum(isinstance(record, LaserScan) for record in log.records()) >= 4
            assert log.report.skipped == 0
            assert log.report.damage == ""


@pytest.mark.parametrize("name", TARGETS)
def test_the_seeds_are_read(name: str, tmp_path: Path) -> None:
    for content in TARGETS[name].seeds:
        (tmp_path / "input").write_bytes(content)
        TARGETS[name].read(tmp_path / "input")


@pytest.mark.parametrize("name", TARGETS)
def test_every_reader_withstands_mutated_files(name: str, tmp_path: Path) -> None:
    findings, _ = fuzz(TARGETS[name], range(300), 1, 10.0, 512, tmp_path)
    assert not findings


@pytest.mark.parametrize("name", TARGETS)
def test_the_same_number_is_the_same_input_and_inputs_differ(name: str) -> None:
    def made(number: int) -> bytes:
        return mutate(Random(f"{name}/{number}"), TARGETS[name].seeds)

    inputs = [made(number) for number in range(200)]
    assert inputs == [made(number) for number in range(200)]
    assert len(set(inputs)) > 150
    assert not set(inputs) <= set(TARGETS[name].seeds)
    assert max(map(len, inputs)) <= LARGEST


def test_an_error_of_the_project_is_no_finding(tmp_path: Path) -> None:
    def refuse(file: Path) -> None:
        raise LogError(f"{file}: is not for me")

    assert not found(refuse, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_another_error_is_a_finding_with_its_input(tmp_path: Path) -> None:
    def stumble(file: Path) -> None:
        raise KeyError(file.name)

    findings = found(stumble, tmp_path)
    assert list(findings.values()) == [3]
    assert "KeyError in test_fuzz.py" in next(iter(findings))
    kept = tmp_path / "odd-0-0"
    assert kept.read_bytes() == mutate(Random("odd/0/0"), [b"seed"])
    assert "KeyError" in (tmp_path / "odd-0-0.txt").read_text()


def test_a_message_of_two_lines_is_a_finding(tmp_path: Path) -> None:
    def ramble(file: Path) -> None:
        raise LogError("one\ntwo")

    assert "not one printable line" in next(iter(found(ramble, tmp_path)))


def test_a_warning_is_a_finding(tmp_path: Path) -> None:
    def warn(file: Path) -> None:
        warnings.warn("overflow", RuntimeWarning, stacklevel=1)

    assert "RuntimeWarning" in next(iter(found(warn, tmp_path)))


def test_a_hang_is_a_finding(tmp_path: Path) -> None:
    def hang(file: Path) -> None:
        while True:
            try:
                file.stat()
            except Exception:  # a reader that catches too much
                continue

    assert "more than 0.1 s" in next(iter(found(hang, tmp_path, seconds=0.1)))


def test_memory_is_a_finding(tmp_path: Path) -> None:
    def hoard(file: Path) -> None:
        bytearray(1 << 28)

    assert "MemoryError" in next(iter(found(hoard, tmp_path)))
    assert len(bytearray(1 << 28)) == 1 << 28  # and the bound is gone afterwards


def test_on_the_command_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tools.fuzz", "--count", "20", "--out", str(tmp_path)]

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*command, *arguments], capture_output=True, text=True, timeout=120, check=False, cwd=ROOT
        )

    done = call("--target", "option", "--target", "relations")
    assert done.returncode == 0
    assert done.stdout.count(" 20 inputs in ") == done.stdout.count(" 0 findings") == 2
    assert call("--target", "nothing").returncode == 2
