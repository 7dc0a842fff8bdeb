"""Reads untrusted YAML files: plain values only, no repeated key, within bounds.

A first pass looks at the text as a stream of events. It takes no recursion and builds nothing, so that nesting, aliases
that multiply, tags and long numbers are refused before they cost time or memory.
"""

import math
from pathlib import Path
from typing import Any, Final

import yaml

from ballfg.checks import shown, type_name

MAX_BYTES: Final = 16_000_000
MAX_NODES: Final = 250_000  # largest number of values and keys with all aliases expanded; they take 2 s
MAX_DEPTH: Final = 40
MAX_DIGITS: Final = 100  # largest number of characters in a number
MAX_KEY: Final = 1000  # largest number of characters in a key, which messages quote in full
_TAG: Final = "tag:yaml.org,2002:"
_NUMBERS: Final = (f"{_TAG}int", f"{_TAG}float")
_PARSER: Final = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's is ten times as fast
_TEXT_LOADER: Final = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


class _Loader(_PARSER):  # type: ignore[misc, valid-type]
    """Keys are text: the track 007 is not the number 7."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[str, Any]:
        self.flatten_mapping(node)
        return {str(key.value): self.construct_object(value, deep=deep) for key, value in node.value}


class YamlError(ValueError):
    """A file that is not YAML, exceeds a bound, or repeats a key. Its text is one line with file and place.

    Attributes:
        problem: the error, without the place.
        line: its number, from 1; None if unknown.
        repeated: the repeated key, after the keys above it and dots; None for another problem.
    """

    def __init__(self, where: str, problem: str, line: int | None = None, repeated: str | None = None) -> None:
        self.problem, self.line, self.repeated = " ".join(problem.split()), line, repeated
        place = "" if line is None else f" in its line {line}"
        super().__init__(f"{where}: not readable as YAML ({self.problem}{place})")


def read_yaml(path: Path) -> Any:
    """The content of a file; None if it is empty. Raises: YamlError: no YAML, out of bounds, or a repeated key."""
    if path.stat().st_size > MAX_BYTES:
        raise YamlError(str(path), f"it must have at most {MAX_BYTES / 1e6:g} MB")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise YamlError(str(path), f"it must be UTF-8 text; {error.reason}") from None
    return parse_yaml(text, str(path))


def parse_yaml(text: str, where: str, *, text_only: bool = False) -> Any:
    """The content of YAML text, None if empty; `text_only` keeps values as text. Raises: YamlError: by `where`."""
    try:
        sizes = _Sizes()  # refuses deep nesting, aliases that multiply or contain themselves, tags
        for event in yaml.parse(text, Loader=_PARSER):
            if problem := sizes.add(event):
                mark = event.start_mark
                raise YamlError(where, problem, None if mark is None else mark.line + 1)
        loader = (_TEXT_LOADER if text_only else _Loader)(text)
        try:
            node = loader.get_single_node()
            _check_values(where, loader, node, "", set())
            return None if node is None else loader.construct_document(node)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        problem = ", ".join(part for part in (error.context, error.problem) if part)
        place = error.problem_mark or error.context_mark
        raise YamlError(where, problem, None if place is None else place.line + 1) from None
    except yaml.YAMLError as error:
        raise YamlError(where, getattr(error, "reason", str(error))) from None


def read_mapping(path: Path) -> dict[Any, Any]:
    """The mapping in a YAML file. Raises: FileNotFoundError. ValueError: no YAML, a repeated key, no mapping."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a file that exists. Correct the path.")
    return mapping(f"{path}: the content", read_yaml(path))


def mapping(what: str, content: Any) -> dict[Any, Any]:
    """The content itself. Raises: ValueError: if it is not a non-empty mapping."""
    if not isinstance(content, dict) or not content:
        got = "an empty one" if content == {} else type_name(content)
        raise ValueError(f"{what} must be a mapping; got {got}. Write it as 'key: value'.")
    return content


class _Sizes:
    """Counts the values of a stream of events with all aliases expanded, without expanding them."""

    def __init__(self) -> None:
        self.nodes = 0
        self.open: list[tuple[str | None, int]] = []  # anchor of each open collection, and number of nodes before it
        self.anchors: dict[str, int | None] = {}  # size of an anchor's value; None while it is open

    def add(self, event: yaml.Event) -> str:
        """Counts an event. Returns: the error; empty without one."""
        if isinstance(event, yaml.AliasEvent):
            size = self.anchors.get(event.anchor or "", 1)  # the composer refuses an unknown anchor
            if size is None:
                return f"alias {shown(event.anchor)} must not stand within what it names"
            self.nodes += size
        elif isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent):
            self.nodes += 1
            if event.tag is not None and event.tag != f"{_TAG}str":
                return f"values must be written without a tag; got {shown(event.tag)}"
            collection = isinstance(event, yaml.CollectionStartEvent)
            if collection:
                self.open.append((event.anchor, self.nodes - 1))
            if event.anchor:
                self.anchors[event.anchor] = None if collection else 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = self.open.pop()
            if anchor:
                self.anchors[anchor] = self.nodes - before
        if len(self.open) > MAX_DEPTH:
            return f"values must be nested at most {MAX_DEPTH} deep"
        return f"it must hold at most {MAX_NODES} values, aliases written out" if self.nodes > MAX_NODES else ""


def _check_values(where: str, loader: Any, node: yaml.Node | None, prefix: str, seen: set[yaml.Node]) -> None:
    """Refuses, at any depth, a malformed value and a repeated key, of which a loader would take the last."""
    if node is None or node in seen:  # an alias leads to a known node
        return
    seen.add(node)
    if isinstance(node, yaml.ScalarNode):
        _check_scalar(where, loader, node)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_values(where, loader, item, prefix, seen)
    elif isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            line = key.start_mark.line + 1
            if not isinstance(key, yaml.ScalarNode):
                raise YamlError(where, "a key must be a word", line)
            if len(key.value) > MAX_KEY:
                raise YamlError(where, f"a key must have at most {MAX_KEY} characters; got {shown(key.value)}", line)
            _check_scalar(where, loader, key)
            if key.value in lines:
                raise YamlError(where, f"{shown(key.value)} stands twice", lines[key.value], f"{prefix}{key.value}")
            lines[key.value] = line
            _check_values(where, loader, value, f"{prefix}{key.value}.", seen)


def _check_scalar(where: str, loader: Any, node: yaml.ScalarNode) -> None:
    """Refuses a malformed number or date, or one beyond the range of machines."""
    line = node.start_mark.line + 1
    if node.tag in _NUMBERS and len(node.value) > MAX_DIGITS:
        raise YamlError(where, f"a number must have at most {MAX_DIGITS} digits; got {len(node.value)}", line)
    if node.tag == f"{_TAG}merge":
        return
    try:
        plain = loader.construct_object(node)
    except (ValueError, OverflowError) as error:  # a 30th of February
        raise YamlError(where, f"{shown(node.value)} cannot be read; {error}", line) from None
    if isinstance(plain, int) and abs(plain) > 2**63 - 1:
        raise YamlError(where, f"whole numbers must lie within +-2^63; got {shown(node.value)}", line)
    if isinstance(plain, float) and math.isinf(plain) and "inf" not in node.value.lower():
        raise YamlError(where, f"{shown(node.value)} is larger than any number of double precision", line)
