"""Reads untrusted JSON, with a single kind of error."""

import json
from pathlib import Path
from typing import Any, Final

from ballfg.files.damaged import whole_content

MAX_VALUES: Final = 8_000_000  # of a text, weighted by `_COSTS`: some 300 MB; a capture of 30 MB has 5 to 7 million
_COSTS: Final = {",": 1, ":": 2, "[": 4, "{": 4}  # of a value, a name, a list, a mapping: in proportion to their memory
TOO_MANY: Final = f"it must hold at most {MAX_VALUES} values, a name counted as 2, a list or mapping as 4"


def read_json(path: Path) -> Any:
    """The content of a file. Raises: ValueError: no JSON, or too large; the caller names the file. OSError."""
    try:
        return parse_json(whole_content(path).decode("utf-8"))
    except UnicodeDecodeError:
        raise ValueError("not readable as JSON: no text in UTF-8") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"not readable as JSON: {error.msg} in line {error.lineno}") from None


def has_too_many(text: str) -> bool:
    """True if JSON holds more than `MAX_VALUES`, without parsing it."""
    return 4 * len(text) > MAX_VALUES and sum(text.count(sign) * cost for sign, cost in _COSTS.items()) > MAX_VALUES


def parse_json(text: str) -> Any:
    """The content of JSON. Raises: JSONDecodeError: not JSON, or too large."""
    if has_too_many(text):
        raise json.JSONDecodeError(TOO_MANY, text, 0)
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        raise
    except RecursionError:
        raise json.JSONDecodeError("values are nested too deep", text, 0) from None
    except ValueError:  # whole numbers beyond 4300 digits
        raise json.JSONDecodeError("a number has too many digits", text, 0) from None
