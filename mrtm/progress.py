"""How far a run is, for somebody who watches."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[float, str], None]
"""Called with the fraction done, 0 to 1, and what is being done, in a few words."""


@contextmanager
def showing(quiet: bool) -> Iterator[Progress]:
    """A bar on stderr while the block runs; with ``quiet`` nothing is shown."""
    if quiet:
        yield lambda fraction, doing: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Bar(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda fraction, doing: bar.update(task, completed=fraction, description=doing)
