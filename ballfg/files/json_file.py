"""Reading JSON that anybody may have written: one kind of error for all that keeps it from being read."""

import json
from pathlib import Path
from typing import Any


def read_json(path: Path) -> Any:
    """The content of a file.

    Raises: ValueError: it is no JSON in UTF-8, or beyond what can be read; the caller names the file. OSError.
    """
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError:
        raise ValueError("not readable as JSON: no text in UTF-8") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"not readable as JSON: {error.msg} in line {error.lineno}") from None


def parse_json(text: str) -> Any:
    """The content of JSON. Raises: JSONDecodeError: it is none, or beyond what can be read."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        raise
    except RecursionError:
        raise json.JSONDecodeError("values are nested too deep", text, 0) from None
    except ValueError:  # whole numbers beyond 4300 digits
        raise json.JSONDecodeError("a number has too many digits", text, 0) from None
