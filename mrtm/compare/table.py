"""A table with a line for everything measured and a column for every way."""

from collections.abc import Sequence
from typing import NamedTuple

from rich.table import Table


class Row(NamedTuple):
    """What was measured, and the value each way."""

    name: str
    values: tuple[str, ...]


def markdown(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table, the first one its head."""
    cells = [[row.name, *row.values] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["| " + " | ".join(map(str.ljust, line, widths)) + " |" for line in cells]
    rule = " | ".join(["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])])
    return "\n".join([lines[0], f"| {rule} |", *lines[1:]]) + "\n"


def table(rows: Sequence[Row]) -> Table:
    """The rows for the terminal."""
    head, *body = rows
    drawn = Table(head.name)
    for way in head.values:
        drawn.add_column(way, justify="right")
    for row in body:
        drawn.add_row(row.name, *row.values)
    return drawn
