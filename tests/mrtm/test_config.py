"""Where the configuration's values come from, and what is said of wrong ones."""

import json
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from frontend.parameters import FilterParameters, ParameterError
from mrtm.config import PRESETS, Config, load_config, to_yaml
from mrtm.errors import ConfigError


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "my.yaml"
    path.write_text(text)
    return path


def test_later_sources_win(tmp_path: Path) -> None:
    file = written(tmp_path, "frontend: {particles: 7, map_width: 31}\nseed: 5\n")
    assert load_config() == Config()
    assert load_config(preset="paper").frontend.map_width == PRESETS["paper"]["frontend"]["map_width"]
    config = load_config(file, "paper", ["frontend.particles=60", "frontend.particles=61"])
    assert config.frontend.particles == 61
    assert config.frontend.map_width == 31
    assert config.frontend.sensing_range == PRESETS["paper"]["frontend"]["sensing_range"]
    assert config.seed == 5
    assert config.frontend.resolution == FilterParameters().resolution


@pytest.mark.parametrize("preset", [None, *PRESETS])
def test_what_is_printed_reads_back(tmp_path: Path, preset: str | None) -> None:
    config = load_config(preset=preset, options=["frontend.resolution=1e-2", "seed=9", "frontend.motion.xy_floor=.5"])
    text = to_yaml(config)
    assert load_config(written(tmp_path, text)) == config
    for line in text.splitlines():
        assert line.endswith(":") or "  # " in line


def test_it_goes_into_json_and_back() -> None:
    config = load_config(preset="paper")
    assert Config.model_validate(json.loads(json.dumps(config.model_dump(mode="json")))) == config


def test_every_parameter_says_what_it_is() -> None:
    text = to_yaml(Config())
    assert "particles: 40" in text
    assert "# particles of the filter; paper: 40" in text
    assert "# m; width of a grid cell" in text
    assert yaml.safe_load(text).keys() == Config().model_dump().keys()


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("frontend.particels=3", "unknown key frontend.particels; did you mean frontend.particles?"),
        ("particles=3", "unknown key particles; did you mean frontend.particles?"),
        ("frontend.particles=many", "frontend.particles is 'many': must be a valid integer"),
        ("frontend.particles=2.5", "frontend.particles is 2.5: must be a valid integer"),
        ("frontend.particles=true", "frontend.particles is true: must not be true or false"),
        ("frontend.particles=", "frontend.particles is None: must be a valid integer"),
        ("frontend.particles=[1]", "frontend.particles is [1]: must be a valid integer"),
        ("frontend.particles=[", "not YAML: "),
        ("frontend.particles=0", "frontend.particles is 0: must be at least 1"),
        ("frontend.resolution=-1", "frontend.resolution is -1: must be at least 0.005 m"),
        ("frontend.resolution=.nan", "frontend.resolution is nan: must be finite"),
        ("frontend.resolution=.inf", "frontend.resolution is inf: must be finite"),
        ("frontend.motion.xy_floor=0", "frontend.motion.xy_floor is 0: must be at least 1e-05 m"),
        ("frontend=3", "frontend is a section and cannot be 3"),
        ("topology.projection=maybe", "topology.projection is 'maybe': must be 'joint' or 'dijkstra'"),
        ("topology.omega=often", "topology.omega is 'often': must be a valid number, unable to parse"),
        ("topology.omega=[1]", "topology.omega is [1]: must be a valid number or be 'optimal'"),
        ("topology.omega=2", "topology.omega is 2: must be at most 1"),
        ("topology.projection=true", "topology.projection is true: must not be true or false"),
        (
            "frontend.map_width=1e6",
            "frontend.map_width is '1e6': with 40 particles and 0.05 m a cell it takes 1.6e+16 cells",
        ),
        ("frontend.map_width=1e300", "frontend.map_width is "),
        ("frontend.sigma=1e-300", "must be at least 0.001 m"),
        ("frontend.motion.xy_floor=1e300", "must be at most 10 m"),
        ("seed=-1", "seed is -1: must be at least 0"),
        ("seed", "give it as section.key=value"),
    ],
)
def test_a_wrong_option_is_named(option: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(options=["frontend.map_width=30", option])
    assert str(caught.value).startswith(f"--set {option}: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_bound_on_several_values_together_names_what_was_given_and_the_value() -> None:
    said = r"--set frontend\.particles=10000: frontend\.map_width is 70\.0: with 10000 particles"
    with pytest.raises(ConfigError, match=said):
        load_config(options=["seed=1", "frontend.particles=10000"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frontend: {particels: 3}", ": unknown key frontend.particels; did you mean frontend.particles?"),
        ("fronted: {particles: 3}", ": unknown key fronted; did you mean "),
        ("frontend: {particles: none}", ": frontend.particles is 'none': must be a valid integer"),
        ("frontend:", ": frontend is a section and cannot be None"),
        ("3: 4", ": unknown key 3; did you mean "),
        ("seed: 1\nfrontend: [\n", ":3: not YAML: "),
        ("- seed", ": holds no sections"),
    ],
)
def test_a_wrong_file_is_named(tmp_path: Path, text: str, said: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert str(caught.value).startswith(f"{path}{said}")
    assert "\n" not in str(caught.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    assert load_config(written(tmp_path, "# nothing\n")) == Config()
    with pytest.raises(ConfigError, match=r"missing\.yaml: cannot be read: No such file"):
        load_config(tmp_path / "missing.yaml")
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_config(tmp_path)
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not a text file in UTF-8"):
        load_config(tmp_path / "binary")


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(ConfigError, match="--preset papper: no such preset; there is: paper"):
        load_config(preset="papper")


def test_bounds_hold_without_the_configuration() -> None:
    with pytest.raises(ParameterError, match="particles is 0: must be at least 1"):
        FilterParameters(particles=0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seed: 2001-99-99", "'2001-99-99' is not a valid timestamp"),
        (f"seed: {'9' * 5000}", f"'{'9' * 39}... is not a valid int"),
        (f"seed: 0x{'9' * 5000}", f"'0x{'9' * 37}... is not a valid int"),
        (f"seed: 1{'0' * 400}", "seed is 1000"),
        (f"frontend: {{sigma: 1{'0' * 400}}}", "frontend.sigma is 1000"),
        ("seed: !!int ''", "'' is not a valid int"),
        ("seed: !!timestamp now", "'now' is not a valid timestamp"),
        ("seed: !!python/name:os.system x", "could not determine a constructor"),
        (f"seed: {'[' * 50000}", "nested deeper than 20"),
        ("\n".join(" " * depth + "a:" for depth in range(300)), "nested deeper than 20"),
        (f"seed: {'x' * 10**6}", "longer than 65536 characters"),
        (f"{'x' * 1000}: 1", f"unknown key {'x' * 100}...; did you mean "),
        (f"frontend: [{'1, ' * 10000}]", "frontend is a section and cannot be [1, 1,"),
        (f"frontend: {{particles: [{'1, ' * 10000}]}}", "frontend.particles is [1, 1,"),
        ("seed: &a [1, *a]", "an alias (*); write out what it means"),
        ('"a\\nb": 1', "unknown key a b; did you mean "),
    ],
)
def test_a_hostile_file_costs_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert said in message
    assert "\n" not in message
    assert len(message) < len(str(path)) + 400


def test_a_few_lines_cannot_stand_for_gigabytes(tmp_path: Path) -> None:
    levels = "abcdefghijklmnopqrst"
    rows = ["a: &a [x, x, x, x]"]
    rows += [f"{this}: &{this} [{', '.join([f'*{before}'] * 9)}]" for before, this in pairwise(levels)]
    with pytest.raises(ConfigError, match="alias"):
        load_config(written(tmp_path, "\n".join([*rows, "frontend: *t"])))
