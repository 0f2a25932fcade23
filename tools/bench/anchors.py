"""The numbers to compare with, from ``anchors.toml``."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

FILE = Path(__file__).with_name("anchors.toml")


@dataclass(frozen=True, slots=True)
class Anchor:
    """What somebody else reached on a log.

    Attributes:
        system: the program.
        source: where the number is from, in full.
        metres: mean of the relations' translation errors, and their standard deviation.
        degrees: mean of the rotation errors, if known.
        wall: seconds for the whole log, if known.
        memory: peak, MB, if known.
        measured: run on a machine of our kind, not published.
    """

    system: str
    source: str
    metres: tuple[float, float]
    degrees: float | None = None
    wall: float | None = None
    memory: float | None = None
    measured: bool = False


def read_anchors(path: Path = FILE) -> dict[str, list[Anchor]]:
    """The anchors by log.

    Raises:
        KeyError: an entry names a source that the file does not give, or lacks one of its parts.
    """
    data = tomllib.loads(path.read_text())
    return {
        entry["log"]: [
            Anchor(
                result["system"],
                data["sources"][result["source"]],
                (float(result["metres"][0]), float(result["metres"][1])),
                result.get("degrees"),
                result.get("wall"),
                result.get("memory"),
                measured=result["source"] == "measured",
            )
            for result in entry["results"]
        ]
        for entry in data["anchor"]
    }
