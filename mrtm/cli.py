"""The command ``mrtm``: parse, call, print. Everything heavy is imported by the command that needs it."""

import io
import os
import signal
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from frontend.errors import FrontendError
from mrtm import __version__
from mrtm.errors import MrtmError, OutputError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from mrtm.config import Config

app = typer.Typer(
    name="mrtm",
    help="Joint 2D laser maps from a team of robots.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _place(text: str) -> Path:
    if not text:  # which a Path takes for the current directory: an unset variable in a script
        raise OutputError('the place to write to is ""; give a path, or . for the current directory')
    return Path(text)


ConfigFile = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="YAML; `mrtm config` prints one.")]
Options = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="One parameter, e.g. frontend.particles=60. Repeatable."),
]
Preset = Annotated[str | None, typer.Option(metavar="NAME", help='"paper": the values of the paper.')]
Session = Annotated[Path, typer.Argument(help="A team's YAML, or one robot's log of any known format.")]
Seed = Annotated[int | None, typer.Option(help="Seed of all random numbers; as --set seed=N.")]
Threads = Annotated[int | None, typer.Option(min=1, help="Cores to use; all if not given.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]


@app.callback(invoke_without_command=True)
def _main(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        typer.echo(f"mrtm {__version__}")
        raise typer.Exit


@app.command()
def run(
    session: Session,
    out: Annotated[Path, typer.Option(metavar="DIR", parser=_place, help="Directory for map, trajectories and graph.")],
    config: ConfigFile = None,
    options: Options = None,
    preset: Preset = None,
    seed: Seed = None,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Map a building with a team of robots, or from one robot's log."""
    parameters = _parameters(config, preset, options, seed)
    from mrtm.progress import showing
    from mrtm.session import run_session

    with showing(quiet) as progress:
        result = run_session(session, out, parameters, progress, threads, [config] if config else [])
    if not quiet:
        from mrtm.output.report import run_report

        _print([*run_report(result), f"the map is {out / 'map.png'}, everything else in {out}"])


@app.command()
def compare(
    session: Session,
    out: Annotated[Path, typer.Option(metavar="DIR", parser=_place, help="Directory for the table and the figures.")],
    config: ConfigFile = None,
    options: Options = None,
    preset: Preset = None,
    seed: Seed = None,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Make the joint map three ways: before optimisation, by the paper's off-line EM, and on line."""
    parameters = _parameters(config, preset, options, seed)
    from mrtm.progress import showing
    from mrtm.session import compare_session

    with showing(quiet) as progress:
        scores = compare_session(session, out, parameters, progress, threads, [config] if config else [])
    if not quiet:
        from mrtm.compare import rows, table

        _print([table(rows(scores)), f"the table and the paper's figures are in {out}"])


@app.command()
def evaluate(
    out: Annotated[Path, typer.Argument(metavar="DIR", parser=_place, help="What `mrtm run` left behind.")],
    relations: Annotated[Path | None, typer.Option(metavar="FILE", help="True relative poses.")] = None,
    truth: Annotated[Path | None, typer.Option(metavar="TUM", help="True or reference trajectory.")] = None,
    session: Annotated[
        Path | None, typer.Option(metavar="YAML", help="A team's session: its relations and truth, where not given.")
    ] = None,
) -> None:
    """Measure a run against the truth."""
    references: Mapping[str, Path] | Path | None = truth
    if session is not None:
        from mrtm.team.session_file import read_session

        team = read_session(session)
        relations, references = relations or team.relations, truth or team.truth
    if not (relations or references):
        given = "give" if session is None else f"{session} names neither relations nor truth; give"
        raise typer.BadParameter(f"{given} --relations FILE, --truth TUM, or a --session YAML that names them")
    from mrtm.evaluation import evaluate_output
    from mrtm.output.report import evaluation_report

    _print(evaluation_report(evaluate_output(out, relations, references)))


@app.command()
def info(log: Annotated[Path, typer.Argument(help="A robot's log of any known format.")]) -> None:
    """Tell what a log holds, without mapping it."""
    from mrtm.info import describe, log_info

    for line in describe(log_info(log)):
        typer.echo(line)


@app.command()
def convert(
    log: Annotated[Path, typer.Argument(help="A robot's log of any known format.")],
    out: Annotated[
        Path,
        typer.Argument(metavar="OUT", parser=_place, help="The CARMEN log; .gz, .bz2 or .xz at the end compresses it."),
    ],
) -> None:
    """Write a log as CARMEN."""
    from frontend.readers import open_log
    from frontend.writers import write_carmen
    from mrtm.output.place import check_outputs, file_output

    source = open_log(log)
    check_outputs(file_output(out), [log])
    out.parent.mkdir(parents=True, exist_ok=True)
    typer.echo(f"{out}: {write_carmen(source.scans(), out)} scans")
    if source.report.sightings:
        typer.echo(f"left out: {source.report.sightings} sightings, which CARMEN has no message for")
    for blemish in source.report.blemishes():
        typer.echo(blemish)


@app.command("config")
def show_config(config: ConfigFile = None, options: Options = None, preset: Preset = None) -> None:
    """Print every parameter with its unit, meaning and the paper's value; the output is a file for --config."""
    from mrtm.config import to_yaml

    typer.echo(to_yaml(_load(config, preset, options or [])), nl=False)


@app.command()
def fetch(
    name: Annotated[str | None, typer.Argument(help="A public log; without one, what there is.")] = None,
    to: Annotated[Path, typer.Option(metavar="DIR", help="Where the files go.")] = Path("data/cache"),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print paths and errors only.")] = False,
) -> None:
    """Download a public log, or list those there are."""
    from mrtm.fetch import fetch as download
    from mrtm.fetch import registry, table

    if name is None:
        typer.echo(table(), nl=False)
        return
    from mrtm.progress import showing

    with showing(quiet) as progress:
        fetched = list(download(name, to, progress))
    for file in fetched:
        how = "as registered" if file.checked else "not in the registry to compare with"
        typer.echo(file.path if quiet else f"{file.path}: sha256 {file.sha256} ({how})")
    if not quiet:
        log = registry()[name]
        typer.echo(f"licence: {log.licence}; cite: {log.citation}; described at {log.page}")


def _print(parts: "Sequence[RenderableType]") -> None:
    from rich.console import Console

    console = Console(soft_wrap=True, highlight=False)
    for part in parts:
        console.print(part)


def _parameters(file: Path | None, preset: str | None, options: Sequence[str] | None, seed: int | None) -> "Config":
    """The parameters of a run."""
    return _load(file, preset, [*(options or ()), *([] if seed is None else [f"seed={seed}"])])


def _load(file: Path | None, preset: str | None, options: Sequence[str]) -> "Config":
    from mrtm.config import load_config

    return load_config(file, preset, options)


def main() -> None:
    """Run the command line.

    An error that is the user's to mend is one line on stderr and exit code 2, where the machine fails exit code 1. To
    be terminated is like being interrupted: what was begun is put in order, and the exit code tells.
    """
    signal.signal(signal.SIGTERM, _terminate)
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # they are for programmers; what a user must know is said in words
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a screen that cannot show a robot's name still shows the rest
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except (MrtmError, FrontendError) as error:
        _fail(str(error), 2)
    except UnicodeEncodeError as error:
        _fail(f"{error.object}: not a name of a file in this locale; set LC_ALL=C.UTF-8", 1)
    except MemoryError as error:
        why = f" ({error})" if str(error) else ""
        _fail(f"out of memory{why}; set fewer frontend.particles, or --threads 1 for one robot at a time", 1)
    except OSError as error:
        if error.filename is None:  # every file has its name: it is the screen, or what has taken its place
            _discard_output()
        if not isinstance(error, BrokenPipeError):  # whoever read has seen enough
            _fail(f"{error.filename or 'cannot go on'}: {error.strerror or error}", 1)
        sys.exit(1)


def _terminate(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_IGN)  # once is enough: what has begun to end must not be disturbed
    sys.exit(128 + number)


def _discard_output() -> None:
    """So that nothing tries again, at exit, to write what could not be written."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())


def _fail(message: str, code: int) -> None:
    line = " ".join(message.split())  # a hostile file name must not break the line
    typer.secho(f"error: {line}", fg="red", err=True)
    sys.exit(code)
