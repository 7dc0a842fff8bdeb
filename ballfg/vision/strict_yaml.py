"""Reading YAML that people write: a mapping, every key known."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from ballfg.files.strict_yaml import read_yaml
from ballfg.tracks.fields import kind
from ballfg.tracks.hints import did_you_mean


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
        got = "an empty one" if content == {} else kind(content)
        raise ValueError(f"{what} must be a mapping; got {got}. Write it as 'key: value'.")
    return content


def check_keys(where: str, content: dict[Any, Any], known: Collection[str], needed: Collection[str]) -> None:
    """Raises: ValueError: a key that is not known, or a needed one that is missing; `where` begins the message."""
    absent = [key for key in known if key not in content]
    for key in content:
        if key not in known:
            hint = did_you_mean(str(key), absent)
            raise ValueError(
                f"{where}: fields must be among {', '.join(known)}; got {key!r}.{hint} Rename or delete it."
            )
    for key in needed:
        if content.get(key) is None:
            got = ", ".join(map(str, content)) or "nothing"
            raise ValueError(f"{where}: field {key!r} is required; got {got}. Add it.")
