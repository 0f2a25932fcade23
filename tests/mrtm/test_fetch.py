"""Fetching public logs, against a server on this machine that misbehaves as servers do."""

import hashlib
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from mrtm import fetch as module
from mrtm.fetch import FetchError, PublicLog, RemoteFile, download, fetch, parts, registry

ROOT = Path(__file__).parents[2]
CONTENT = bytes(range(256)) * 3000
SUM = hashlib.sha256(CONTENT).hexdigest()


@dataclass
class Site:
    """What the server serves, and how.

    Attributes:
        cuts: after how many bytes the answers break off, one entry an answer, the last one for all that follow; -1:
            never.
        version: value of the header that names the version of the content; None for no such header.
        ranges: whether it honours Range; if not it sends everything.
        asked: (Range, bytes sent) of every answer.
    """

    address: str = ""
    content: bytes = CONTENT
    cuts: list[int] = field(default_factory=lambda: [-1])
    version: tuple[str, str] | None = ("ETag", '"one"')
    ranges: bool = True
    encoding: str = ""
    asked: list[str] = field(default_factory=list)

    @property
    def file(self) -> RemoteFile:
        return RemoteFile(url=f"{self.address}/logs/some%20robot.clf", sha256=SUM)


@pytest.fixture
def site() -> Iterator[Site]:
    site = Site()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range", "")
            site.asked.append(wanted)
            if not self.path.startswith("/logs/"):
                self.send_error(404)
                return
            current = site.version is not None and self.headers.get("If-Range") == site.version[1]
            start = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and current and site.ranges else 0
            cut = site.cuts.pop(0) if len(site.cuts) > 1 else site.cuts[0]
            body = site.content[start:]
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(site.content) - 1}/{len(site.content)}")
            if site.version is not None:
                self.send_header(*site.version)
            if site.encoding:
                self.send_header("Content-Encoding", site.encoding)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            with suppress(OSError):  # the client may have seen enough
                self.wfile.write(body if cut < 0 else body[:cut])
            if cut >= 0:
                self.close_connection = True

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    site.address = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    yield site
    server.shutdown()
    server.server_close()
    thread.join()


def refused(file: RemoteFile, to: Path) -> str:
    """What is said of a file that cannot be had."""
    with pytest.raises(FetchError) as caught:
        download(file, to)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(file.url)
    assert not (to / file.name).exists()
    return message


def test_a_file_comes_whole(site: Site, tmp_path: Path) -> None:
    told: list[tuple[float, str]] = []
    got = download(site.file, tmp_path / "new" / "folder", lambda fraction, doing: told.append((fraction, doing)))
    assert got.path == tmp_path / "new" / "folder" / "some robot.clf"
    assert got.path.read_bytes() == CONTENT
    assert (got.sha256, got.checked, got.new) == (SUM, True, True)
    assert told[-1] == (1.0, "some robot.clf: 0.8 of 0.8 MB")
    assert [path.name for path in got.path.parent.iterdir()] == ["some robot.clf"]


def test_a_file_that_is_there_is_not_asked_for_again(site: Site, tmp_path: Path) -> None:
    assert download(site.file, tmp_path).new
    site.asked.clear()
    assert not download(site.file, tmp_path).new
    assert site.asked == []


def test_a_file_that_is_not_the_registrys_is_replaced(site: Site, tmp_path: Path) -> None:
    (tmp_path / "some robot.clf").write_bytes(b"something else")
    assert download(site.file, tmp_path).path.read_bytes() == CONTENT


def test_without_a_known_sum_the_sum_is_told(site: Site, tmp_path: Path) -> None:
    got = download(RemoteFile(url=site.file.url), tmp_path)
    assert (got.sha256, got.checked) == (SUM, False)


@pytest.mark.parametrize("version", [("ETag", '"one"'), ("Last-Modified", "Sat, 01 Feb 2003 04:05:06 GMT")])
def test_after_a_cut_it_goes_on_from_there(site: Site, tmp_path: Path, version: tuple[str, str]) -> None:
    site.version, site.cuts = version, [100_000, -1]
    assert download(site.file, tmp_path).path.read_bytes() == CONTENT
    assert site.asked == ["", "", "bytes=100000-"]
    assert parts(tmp_path / "some robot.clf") == []


def test_a_later_call_goes_on_where_the_first_gave_up(site: Site, tmp_path: Path) -> None:
    site.cuts = [1000]
    said = refused(site.file, tmp_path)
    have = parts(tmp_path / "some robot.clf")[0].stat().st_size
    assert f"the connection broke off; {have} bytes are kept, the same command goes on from there" in said
    site.cuts, site.asked = [-1], []
    assert download(site.file, tmp_path).path.read_bytes() == CONTENT
    assert site.asked == ["", f"bytes={have}-"]


def test_a_part_that_is_already_whole_is_used(site: Site, tmp_path: Path) -> None:
    site.cuts = [1000]
    refused(site.file, tmp_path)
    parts(tmp_path / "some robot.clf")[0].write_bytes(CONTENT)
    site.asked = []
    assert download(site.file, tmp_path).path.read_bytes() == CONTENT
    assert site.asked == [""]


def test_a_part_of_another_version_is_never_continued(site: Site, tmp_path: Path) -> None:
    site.content, site.cuts = b"old" * len(CONTENT), [5000]
    refused(site.file, tmp_path)
    site.content, site.cuts, site.version = CONTENT, [-1], ("ETag", '"two"')
    assert download(site.file, tmp_path).path.read_bytes() == CONTENT
    assert parts(tmp_path / "some robot.clf") == []


@pytest.mark.parametrize(
    ("version", "ranges"), [(("ETag", '"one"'), False), (None, True), (("ETag", 'W/"weak"'), True)]
)
def test_a_server_that_cannot_resume_sends_all_again(
    site: Site, tmp_path: Path, version: tuple[str, str] | None, ranges: bool
) -> None:
    site.version, site.ranges, site.cuts = version, ranges, [100_000, -1]
    assert download(site.file, tmp_path).path.read_bytes() == CONTENT


def test_a_file_stays_compressed_whatever_the_server_calls_it(site: Site, tmp_path: Path) -> None:
    site.encoding = "x-gzip"
    assert download(site.file, tmp_path).path.read_bytes() == CONTENT


def test_a_wrong_sum_leaves_nothing(site: Site, tmp_path: Path) -> None:
    site.content = CONTENT + b"!"
    said = refused(site.file, tmp_path)
    assert f"what came is not the file of the registry, whose sha256 is {SUM}; nothing was kept" in said
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_not_on_the_server(site: Site, tmp_path: Path) -> None:
    said = refused(RemoteFile(url=f"{site.address}/gone/a.clf"), tmp_path)
    assert said.endswith("the server says 404 Not Found")
    assert list(tmp_path.iterdir()) == []
    assert len(site.asked) == 1


def test_no_server(tmp_path: Path) -> None:
    with socket.socket() as taken:  # bound, not listening: every connection is refused
        taken.bind(("127.0.0.1", 0))
        said = refused(RemoteFile(url=f"http://127.0.0.1:{taken.getsockname()[1]}/a.clf"), tmp_path)
    assert said.endswith("no connection to the server; is there a network?")
    assert list(tmp_path.iterdir()) == []


def test_a_server_that_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_TIMEOUT", (0.2, 0.2))
    with socket.create_server(("127.0.0.1", 0)) as silent:
        said = refused(RemoteFile(url=f"http://127.0.0.1:{silent.getsockname()[1]}/a.clf"), tmp_path)
    assert said.endswith("the server does not answer; try again later")
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written(site: Site, tmp_path: Path) -> None:
    (tmp_path / "occupied").touch()
    with pytest.raises(FetchError, match=r"occupied/some robot\.clf: cannot be written: Not a directory"):
        download(site.file, tmp_path / "occupied")


def test_names_that_cannot_be_fetched(tmp_path: Path) -> None:
    with pytest.raises(FetchError, match=r"intell: no such log in the registry; there is: intel, aces"):
        list(fetch("intell", tmp_path))
    with pytest.raises(FetchError, match=r"no address is known .* described at http://cres\.usc\.edu"):
        list(fetch("ap_hill_07b", tmp_path))


def test_the_registry_holds_what_it_should() -> None:
    logs = registry()
    assert {"intel", "aces", "fr079", "mit-killian", "mit-csail", "ap_hill_07b"} <= logs.keys()
    names = [file.name for log in logs.values() for file in log.files]
    assert len(names) == len(set(names))  # they may all go into one folder
    assert all(re.fullmatch(r"[\w.-]+", name) for name in names)
    assert (ROOT / "data" / "registry.toml").samefile(ROOT / "mrtm" / "registry.toml")


def test_fetch_on_the_command_line(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = f"""
import sys, mrtm.fetch
log = mrtm.fetch.PublicLog(what="a hall", licence="CC0", citation="nobody", page="here",
                           files=[dict(url={site.file.url!r})])
mrtm.fetch.registry = lambda: dict(hall=log)
sys.argv = ["mrtm", "fetch", *sys.argv[1:]]
from mrtm.cli import main
main()
"""

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", script, *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, cwd=ROOT)

    listed = call()
    assert (listed.returncode, listed.stderr) == (0, "")
    assert "hall" in listed.stdout
    done = call("hall", "--to", str(tmp_path), "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{tmp_path}/some robot.clf\n", "")
    loud = call("hall", "--to", str(tmp_path))
    assert f"sha256 {SUM} (not in the registry to compare with)" in loud.stdout
    assert "licence: CC0; cite: nobody; described at here" in loud.stdout
    (tmp_path / "some robot.clf").unlink()
    site.cuts = [10]
    failed = call("hall", "--to", str(tmp_path), "--quiet")
    assert (failed.returncode, failed.stdout, failed.stderr.count("\n")) == (2, "", 1)
    assert failed.stderr.startswith("error: http://127.0.0.1")


def test_an_entry_is_checked() -> None:
    with pytest.raises(ValueError, match="licence"):
        PublicLog.model_validate({"what": "", "citation": "", "page": "", "files": []})
    with pytest.raises(ValueError, match="sha256"):
        RemoteFile(url="http://a/b", sha256="beef")
    with pytest.raises(ValueError, match="url"):
        RemoteFile(url="ftp://a/b")
