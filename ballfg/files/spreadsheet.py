"""Quotes cells of CSV files by an apostrophe, if a spreadsheet would take them for a formula.

Reading restores the text. A number is no formula: -1 and +5 stay as they are, as numbers and as names.

Source: OWASP, CSV Injection; Application Security Verification Standard 5, 1.2.10.
"""

import re
from typing import Final

QUOTED: Final = r"^'*[=+\-@\t\r\n＝＋－＠]"  # text with an apostrophe, or in need of one: for RE2 and Python alike
NUMBER: Final = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
_QUOTED, _NUMBER = re.compile(QUOTED), re.compile(NUMBER, re.ASCII)


def guarded(text: str) -> str:
    """A cell for writing: with an apostrophe before the beginning of a formula."""
    return f"'{text}" if _QUOTED.match(text) and not _NUMBER.match(text) else text


def bare(cell: str) -> str:
    """The text of a cell from `guarded`; any other cell unchanged."""
    return cell[1:] if cell[:1] == "'" and _QUOTED.match(cell) else cell
