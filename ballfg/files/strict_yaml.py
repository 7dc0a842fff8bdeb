"""Reading YAML files: safe loader only, no key twice."""

from pathlib import Path
from typing import Any

import yaml

from ballfg.checks import type_name


class YamlError(ValueError):
    """A file that is not YAML, or has a key twice. Its text is one line with the file and the place.

    Attributes:
        problem: what is wrong, without the place.
        line: its number, from 1; None where it is not known.
        repeated: the key that stands twice, with the keys above it and dots between; None for another problem.
    """

    def __init__(self, path: Path, problem: str, line: int | None = None, repeated: str | None = None) -> None:
        self.problem, self.line, self.repeated = " ".join(problem.split()), line, repeated
        place = "" if line is None else f" in its line {line}"
        super().__init__(f"{path}: not readable as YAML ({self.problem}{place})")


def read_yaml(path: Path) -> Any:
    """The content of a YAML file; None if it is empty.

    Raises: ValueError: if it is not YAML, or has a key twice (a `YamlError`).
    """
    try:
        loader = yaml.SafeLoader(path.read_text(encoding="utf-8-sig"))
        try:
            node = loader.get_single_node()
            _check_keys(path, node, "", set())
            return None if node is None else loader.construct_document(node)
        finally:
            loader.dispose()
    except UnicodeDecodeError as error:
        raise YamlError(path, f"it must be UTF-8 text; {error.reason}") from None
    except yaml.MarkedYAMLError as error:
        problem = ", ".join(part for part in (error.context, error.problem) if part)
        mark = error.problem_mark or error.context_mark
        raise YamlError(path, problem, None if mark is None else mark.line + 1) from None
    except yaml.YAMLError as error:
        raise YamlError(path, getattr(error, "reason", str(error))) from None


def read_mapping(path: Path) -> dict[Any, Any]:
    """The content of a YAML file that must be a mapping.

    Raises: FileNotFoundError: no such file. ValueError: not YAML, a key twice, no mapping; the message names the file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a file that exists. Correct the path.")
    return mapping(f"{path}: the content", read_yaml(path))


def mapping(what: str, content: Any) -> dict[Any, Any]:
    """The content itself. Raises: ValueError: if it is not a mapping with something in it."""
    if not isinstance(content, dict) or not content:
        got = "an empty one" if content == {} else type_name(content)
        raise ValueError(f"{what} must be a mapping; got {got}. Write it as 'key: value'.")
    return content


def _check_keys(path: Path, node: yaml.Node | None, prefix: str, seen: set[yaml.Node]) -> None:
    """Refuses a mapping, at any depth, with a key twice: the safe loader would take the last one in silence."""
    if node is None or node in seen:  # an alias leads to a node again
        return
    seen.add(node)
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_keys(path, item, prefix, seen)
    elif isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            name = f"{prefix}{key.value}"
            if name in lines:
                raise YamlError(path, f"{key.value!r} stands twice", lines[name], name)
            lines[name] = key.start_mark.line + 1
            _check_keys(path, value, f"{name}.", seen)
