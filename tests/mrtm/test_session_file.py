"""Team sessions: the real ones, what may be left out, and every mistake in one line that names the place."""

import csv
import math
import random
import unicodedata
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from factors.sighting import Sighting
from mrtm.team.session_file import Member, SessionError, TeamSession, open_session, read_session
from mrtm.team.sightings_file import COLUMNS, LARGEST, TimedSighting, read_sightings
from tools.fuzzing.seeds import LOGS

HEADER = ",".join(COLUMNS)
ROW = "94.0,red,blue,5.7,0.2,-2.1,0.05,0.02,0.05"
TEAM = "robots:\n  red: {log: red.clf}\n  blue: {log: blue.clf}\n"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A directory with the logs of red and blue."""
    for name in ("red.clf", "blue.clf"):
        (tmp_path / name).write_bytes(LOGS["CARMEN"][0])
    return tmp_path


def session(place: Path, text: str) -> TeamSession:
    (place / "team.yaml").write_text(text)
    return open_session(place / "team.yaml")


def sightings(place: Path, text: str) -> tuple[TimedSighting, ...]:
    (place / "seen.csv").write_text(text)
    return read_sightings(place / "seen.csv", ("red", "blue", "green"))


def complaint(place: Path, text: str) -> str:
    """What is said of a session that is refused, after the file's name."""
    with pytest.raises(SessionError) as caught:
        session(place, text)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < 1000
    assert message.startswith(f"{place / 'team.yaml'}:")
    return message.removeprefix(f"{place / 'team.yaml'}:").strip()


def row(**changes: str) -> str:
    cells = dict(zip(COLUMNS, ROW.split(","), strict=True)) | changes
    return f"{HEADER}\n{','.join(cells[column] for column in COLUMNS)}\n"


@pytest.mark.parametrize(("name", "robots", "seen"), [("intel-3robots", 3, 185), ("aces-2robots", 2, 36)])
def test_the_real_sessions(data: Path, name: str, robots: int, seen: int) -> None:
    found = open_session(data / f"{name}.yaml")
    assert (found.name, len(found.members), len(found.sightings)) == (name, robots, seen)
    assert found.relations is not None
    assert found.relations.exists()
    assert found.truth == {}
    first, second, *_ = found.members
    assert (first.name, first.begin, second.begin, second.start) == ("red", 0.0, first.end, 0.0)
    with (data / f"{name}.sightings.csv").open() as file:
        rows = sorted(csv.DictReader(file), key=lambda line: float(line["time"]))
    for line, sighting in zip(rows, found.sightings, strict=True):
        measured = sighting.measurement
        assert (sighting.observer, sighting.observed) == (line["observer"], line["observed"])
        assert (sighting.time, measured.range) == (float(line["time"]), float(line["range"]))
        assert measured.heading is not None
        assert math.remainder(measured.heading - float(line["heading"]), 2 * math.pi) == pytest.approx(0, abs=1e-9)


def test_what_a_session_may_leave_out(place: Path) -> None:
    assert session(place, TEAM) == TeamSession(
        "team",
        (
            Member("red", place / "red.clf", 0.0, math.inf, 0.0),
            Member("blue", place / "blue.clf", 0.0, math.inf, 0.0),
        ),
        (),
        None,
        {},
        (place / "team.yaml", place / "red.clf", place / "blue.clf"),
    )


def test_what_a_session_may_say(place: Path) -> None:
    (place / "seen.csv").write_text(f"{HEADER}\n{ROW}\n")
    found = session(
        place,
        "robots:\n"
        "  red: {log: red.clf, from: 1, to: 2.5, start: 7}\n"
        f"  blue: {{log: {place / 'blue.clf'}, to: 1e3}}\n"  # which PyYAML takes for text
        "sightings: seen.csv\nrelations: true.relations\ntruth: {blue: blue.tum}\n",
    )
    assert found.members == (
        Member("red", place / "red.clf", 1.0, 2.5, 7.0),
        Member("blue", place / "blue.clf", 0.0, 1000.0, 0.0),
    )
    assert found.sightings == (TimedSighting(94.0, "red", "blue", Sighting(5.7, 0.2, -2.1, 0.05, 0.02, 0.05)),)
    assert found.relations == place / "true.relations"
    assert found.truth == {"blue": place / "blue.tum"}
    logs = [place / name for name in ("team.yaml", "red.clf", "blue.clf")]
    assert found.files == (*logs, place / "seen.csv", place / "true.relations", place / "blue.tum")


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("red.clf", "red"),
        ("my log.2004.clf.gz", "my log"),
        ("a:b*.clf", "a_b_"),
        (".clf", "robot"),
        ("a\nb", "a_b"),
        ("\N{ROBOT FACE}" * 17 + ".clf", "\N{ROBOT FACE}" * 16),
        ("a" * 63 + " b", "a" * 63),
    ],
)
def test_a_log_is_a_session_of_one_named_like_the_file(tmp_path: Path, file: str, name: str) -> None:
    path = tmp_path / file
    path.write_bytes(LOGS["CARMEN"][0])
    assert open_session(path) == TeamSession(name, (Member(name, path, 0.0, math.inf, 0.0),), (), None, {}, (path,))


def test_a_session_is_known_by_its_content_too(place: Path) -> None:
    (place / "team").write_text(f"# our team\n{TEAM}")
    assert len(open_session(place / "team").members) == 2
    (place / "team.YML").write_text("{robots: {red: {log: red.clf}}}")
    assert len(open_session(place / "team.YML").members) == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no session; give at least robots:"),
        ("- red\n", "holds no session"),
        ("robots:\n", "robots is None: must be keys with values, as in red: {log: red.clf}"),
        ("robots: {}\n", "robots is {}: "),
        ("sightings: seen.csv\n", "robots is missing"),
        ("robot: {red: {log: red.clf}}\n", "robots is missing"),
        ("robots: {red: red.clf}\n", "robots.red is 'red.clf': must be keys with values"),
        ("robots: {red: {from: 1}}\n", "robots.red.log is missing"),
        ("robots: {red: {log: red.clf, form: 1}}\n", "unknown key robots.red.form; did you mean from?"),
        (f"{TEAM}sighting: a.csv\n", "unknown key sighting; did you mean sightings?"),
        ("robots: {red: {log: [red.clf]}}\n", "robots.red.log is ['red.clf']: must be a valid string"),
        ("robots: {red: {log: ''}}\n", "robots.red.log is ''"),
        ('robots: {red: {log: "a\\u2028b"}}\n', "robots.red.log: must be printable"),
        ("robots: {red: {log: rot.clf}}\n", "rot.clf: no such file; paths are relative to"),
        ("robots: {red: {log: team.yaml}}\n", "team.yaml: not a log of a known format"),
        ("robots: {red: {log: red.clf, from: 5, to: 5}}\n", "robots.red: from 5 must be before to 5"),
        ("robots: {red: {log: red.clf, from: -1}}\n", "robots.red.from is -1: must be greater than or equal to 0"),
        ("robots: {red: {log: red.clf, start: -0.5}}\n", "robots.red.start is -0.5: must be greater"),
        ("robots: {red: {log: red.clf, to: .nan}}\n", "robots.red.to is nan: must be "),
        ("robots: {red: {log: red.clf, to: .inf}}\n", "robots.red.to is inf: must be less"),
        ("robots: {red: {log: red.clf, from: true}}\n", "robots.red.from: must not be true or false"),
        ("robots: {red: {log: red.clf, from: soon}}\n", "robots.red.from is 'soon': must be a valid number"),
        ("robots: {red: {log: red.clf, from: }}\n", "robots.red.from is None: must be a valid number"),
        ("robots:\n  red: {log: red.clf}\n  red: {log: blue.clf}\n", "the key red is there twice"),
        ("robots: {red: {log: red.clf, log: blue.clf}}\n", "the key log is there twice"),
        ("robots:\n  red: {log: red.clf}\n  Red: {log: blue.clf}\n", "robots.Red and robots.red are one file name"),
        ("robots: {a/b: {log: red.clf}}\n", "robots.a/b: a robot's name must do as a file's"),
        ("robots: {..: {log: red.clf}}\n", "robots...: a robot's name must do as a file's"),
        ("robots: {'': {log: red.clf}}\n", "a robot's name must do as a file's"),
        ("robots: {'red ': {log: red.clf}}\n", "a robot's name must do as a file's"),
        (f"robots: {{{'r' * 65}: {{log: red.clf}}}}\n", "a robot's name must do as a file's"),
        ('robots: {"r\\x1b": {log: red.clf}}\n', "a robot's name must do as a file's"),
        ("robots: {1: {log: red.clf}}\n", "robots.1: a robot's name must be text; put it in quotes"),
        ("robots: {no: {log: red.clf}}\n", "a robot's name must be text; put it in quotes"),
        (f"{TEAM}truth: {{rad: red.tum}}\n", "truth.rad: no such robot in the session; did you mean red?"),
        (f"{TEAM}truth: red.tum\n", "truth is 'red.tum': must be keys with values"),
        ("robots: {red: {log: red.clf}\n", "not YAML"),
        (f"{TEAM}#{'x' * 70_000}\n", "longer than"),
    ],
)
def test_a_bad_session_is_one_clear_line(place: Path, text: str, said: str) -> None:
    assert said in complaint(place, text)


def test_a_session_that_cannot_be_read_is_named(place: Path) -> None:
    with pytest.raises(SessionError, match=r"missing\.yaml: cannot be read: No such file"):
        open_session(place / "missing.yaml")
    (place / "team.yaml").write_bytes(b"robots: {r\xe9d: {log: red.clf}}\n")
    with pytest.raises(SessionError, match=r"team\.yaml: not a text file in UTF-8"):
        open_session(place / "team.yaml")


def test_a_session_can_be_read_where_the_logs_are_not(tmp_path: Path) -> None:
    (tmp_path / "team.yaml").write_text(TEAM)
    assert [member.name for member in read_session(tmp_path / "team.yaml").members] == ["red", "blue"]


def test_sightings_that_cannot_be_read_are_named(place: Path) -> None:
    with pytest.raises(SessionError, match=r"seen\.csv: cannot be read: No such file"):
        session(place, f"{TEAM}sightings: seen.csv\n")


def test_columns_in_any_order_blank_headings_blank_lines_and_what_excel_adds(place: Path) -> None:
    names = list(COLUMNS)
    random.Random(1).shuffle(names)
    cells = dict(zip(COLUMNS, ROW.split(","), strict=True))
    lines = [", ".join(names), ",".join(cells[name] for name in names), "", " , ,"]
    cells |= {"time": "3", "heading": " ", "sigma_heading": "", "bearing": "5.5"}
    lines.append(", ".join(cells[name] for name in names))
    late, early = TimedSighting(94.0, "red", "blue", Sighting(5.7, 0.2, -2.1, 0.05, 0.02, 0.05)), None
    for text in ("\n".join(lines), "\ufeff" + "\r\n".join(lines) + "\r\n"):
        early, second = sightings(place, text)
        assert second == late
        assert early == TimedSighting(3.0, "red", "blue", Sighting(5.7, 5.5 - 2 * math.pi, None, 0.05, 0.02, None))


def test_no_sightings_are_sightings(place: Path) -> None:
    assert sightings(place, HEADER) == ()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "seen.csv: is empty; its first line must be time,observer,"),
        ("\n\n", "seen.csv: is empty"),
        ("time,observer\n", "seen.csv:1: no column observed; the columns must be time,"),
        (f"{HEADER},comment\n", "seen.csv:1: unknown column 'comment'; did you mean"),
        (HEADER.replace("sigma_range", "sigma_rnage"), "did you mean sigma_range?"),
        (f"{HEADER},time\n", "seen.csv:1: column time is there twice"),
        (f"{HEADER}\n\n{ROW}\n{ROW},1\n", "seen.csv:4: 10 fields for 9 columns; give time,"),
        (f"{HEADER}\n{ROW}\n\n{ROW}\n", "seen.csv:4: the same as line 2"),
        (f'{HEADER}\n"94', "seen.csv:2: not CSV"),
        (row(observer="rad"), "seen.csv:2: no robot 'rad' in the session; did you mean red?"),
        (row(observed="grene"), "did you mean green?"),
        (row(observed=""), "no robot '' in the session"),
        (row(observed="red"), "seen.csv:2: red sees itself"),
        (row(time="-1"), "seen.csv:2: time is '-1': must be greater than or equal to 0"),
        (row(time="nan"), "time is 'nan': must be "),
        (row(time="noon"), "time is 'noon': must be a valid number"),
        (row(range="0"), "range is '0': must be greater than 0"),
        (row(range="inf"), "range is 'inf': must be less than"),
        (row(range=""), "range is '': must be a valid number"),
        (row(bearing="163.2"), "bearing is '163.2': must be less than"),
        (row(heading="nan"), "heading is 'nan': must be "),
        (row(heading=""), "go together"),
        (row(sigma_heading=""), "go together"),
        (row(sigma_range="-0.05"), "sigma_range is '-0.05': must be greater"),
        (row(sigma_bearing="0"), "sigma_bearing is '0': must be greater"),
        (row(sigma_bearing="x" * 5000), "sigma_bearing is 'xxx"),
        (row(observer='"' + "x" * 200_000 + '"'), "seen.csv:2: not CSV: field larger than"),
    ],
)
def test_bad_sightings_are_one_clear_line(place: Path, text: str, said: str) -> None:
    with pytest.raises(SessionError) as caught:
        sightings(place, text)
    assert said in str(caught.value)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000


def test_bytes_and_sizes_that_are_no_sightings(place: Path) -> None:
    (place / "seen.csv").write_bytes(b"\xff\xfe" + HEADER.encode("utf-16"))
    with pytest.raises(SessionError, match=r"seen\.csv: not a text file in UTF-8"):
        read_sightings(place / "seen.csv", ("red", "blue"))
    with (place / "seen.csv").open("wb") as file:
        file.truncate(100 * LARGEST)  # takes no room on the disk
    with pytest.raises(SessionError, match=r"seen\.csv: larger than 64 MiB"):
        read_sightings(place / "seen.csv", ("red", "blue"))


_NAMES = st.text(st.characters(categories=["L", "N", "Zs"], include_characters="-_. "), min_size=1, max_size=64)
_ROBOTS = st.dictionaries(
    _NAMES.filter(lambda name: name.isprintable() and name == name.strip(" .")),
    st.tuples(st.floats(0, 1e9), st.none() | st.floats(1e-3, 1e9), st.floats(0, 1e9)),
    min_size=1,
    max_size=6,
).filter(lambda robots: len({unicodedata.normalize("NFKC", name).casefold() for name in robots}) == len(robots))


@given(_ROBOTS)
@settings(max_examples=50)
def test_sessions_survive_being_written(
    tmp_path_factory: pytest.TempPathFactory, robots: dict[str, tuple[float, float | None, float]]
) -> None:
    path = tmp_path_factory.getbasetemp() / "written.yaml"
    members, expected = {}, []
    for name, (begin, length, start) in robots.items():
        end = None if length is None else begin + length
        members[name] = {"log": f"{name}.clf", "from": begin, "start": start} | ({} if end is None else {"to": end})
        expected.append(Member(name, path.parent / f"{name}.clf", begin, math.inf if end is None else end, start))
    path.write_text(yaml.safe_dump({"robots": members}, allow_unicode=True, sort_keys=False), encoding="utf-8")
    assert read_session(path).members == tuple(expected)


_ANGLES = st.floats(-2 * math.pi, 2 * math.pi)
_SIGMAS = st.floats(1e-6, 1e3)
_SIGHTINGS = st.builds(
    lambda time, pair, range, bearing, heading, sr, sb: TimedSighting(
        time, pair[0], pair[1], Sighting(range, bearing, heading and heading[0], sr, sb, heading and heading[1])
    ),
    st.floats(0, 1e9),
    st.permutations(["red", "blue", "green"]),
    st.floats(1e-6, 9999),
    _ANGLES,
    st.none() | st.tuples(_ANGLES, _SIGMAS),
    _SIGMAS,
    _SIGMAS,
)


@given(st.lists(_SIGHTINGS, unique=True, max_size=8), st.permutations(COLUMNS))
@settings(max_examples=50)
def test_sightings_survive_being_written(
    tmp_path_factory: pytest.TempPathFactory, seen: list[TimedSighting], columns: list[str]
) -> None:
    path = tmp_path_factory.getbasetemp() / "written.csv"
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        for one in seen:
            cells = {"time": one.time, "observer": one.observer, "observed": one.observed}
            cells |= {column: getattr(one.measurement, column) for column in COLUMNS[3:]}
            table.writerow(["" if cells[column] is None else repr(cells[column]).strip("'") for column in columns])
    found = read_sightings(path, ("red", "blue", "green"))
    assert [one.time for one in found] == sorted(one.time for one in seen)
    for one, again in zip(sorted(seen, key=lambda sighting: sighting.time), found, strict=True):
        assert (again.observer, again.observed) == (one.observer, one.observed)
        for column in COLUMNS[3:]:
            value, read = getattr(one.measurement, column), getattr(again.measurement, column)
            assert (value is None) == (read is None)
            if value is not None:
                assert read == pytest.approx(value, abs=1e-9)  # an angle is wrapped again
