"""YAML as people write it by hand: what could make a small file cost much time or memory is refused.

No aliases (a few nested ones stand for gigabytes), no deep nesting, no large files. A key that stands twice, of which
PyYAML would take the last and say nothing, is refused too.
"""

from pathlib import Path
from typing import Any

import yaml

from mrtm.errors import ConfigError

LARGEST = 1 << 16  # characters
DEEPEST = 20


def read_yaml(file: Path) -> Any:
    """What a YAML file holds.

    Raises:
        ConfigError: it cannot be read, is no text, too large, or not YAML.
    """
    try:
        with file.open("rb") as stream:
            content = stream.read(4 * LARGEST + 1)
        return parse_yaml(content.decode("utf-8"), str(file))
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: not a text file in UTF-8") from error


def parse_yaml(text: str, source: str) -> Any:
    """What a YAML text says; ``source`` names where it is from.

    Raises:
        ConfigError: it is too large, or not YAML.
    """
    if len(text) > LARGEST:
        raise ConfigError(f"{source}: longer than {LARGEST} characters, which is no file written by hand")
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}" if mark is not None and "\n" in text else ""
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "unreadable"
        raise ConfigError(f"{source}{where}: not YAML: {shorten(str(reason))}") from error


def shorten(text: str, length: int = 100) -> str:
    """The text as one printable line, or its beginning if it is long."""
    text = " ".join(text.split())
    text = "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)
    return text if len(text) <= length else f"{text[:length]}..."


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, with bounds, and every error with its place."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0

    def fetch_flow_collection_start(self, token: Any) -> None:
        # Here, because the scanner itself slows down with every bracket that is open.
        self._check_depth(self.flow_level)
        super().fetch_flow_collection_start(token)

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(None, None, "an alias (*); write out what it means", self.get_mark())
        self._check_depth(self._depth)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, yaml.MappingNode):
            _check_keys(node)
        return node

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        try:
            value = super().construct_object(node, deep)
            if isinstance(value, int):
                str(value)  # fails for 5000 hexadecimal digits too, which Python reads and cannot print
            return value
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            # What PyYAML lets through: 2001-99-99, an integer of 5000 digits, !!int without one.
            kind = node.tag.rpartition(":")[2]
            raise yaml.constructor.ConstructorError(
                None, None, f"{shorten(repr(node.value), 40)} is not a valid {kind} ({error})", node.start_mark
            ) from error

    def _check_depth(self, depth: int) -> None:
        if depth >= DEEPEST:
            raise yaml.scanner.ScannerError(None, None, f"nested deeper than {DEEPEST}", self.get_mark())


def _check_keys(mapping: yaml.MappingNode) -> None:
    seen = set()
    for key, _ in mapping.value:
        if isinstance(key, yaml.ScalarNode):
            if (key.tag, key.value) in seen:
                problem = f"the key {shorten(key.value, 40)} is there twice; remove one"
                raise yaml.composer.ComposerError(None, None, problem, key.start_mark)
            seen.add((key.tag, key.value))
