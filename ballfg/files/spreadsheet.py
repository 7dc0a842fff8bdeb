"""Cells of CSV files that a spreadsheet would take for a formula: an apostrophe before them makes them text.

What is written so is read back as it was. A number is no formula: -1 and +5 stay as they are, as numbers and as names.

Source: OWASP, CSV Injection; Application Security Verification Standard 5, 1.2.10.
"""

import re
from typing import Final

QUOTED: Final = r"^'*[=+\-@\t\r\n＝＋－＠]"
"""A text that needs an apostrophe, or has one already: RE2 and Python alike."""
NUMBER: Final = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
_QUOTED, _NUMBER = re.compile(QUOTED), re.compile(NUMBER, re.ASCII)


def guarded(text: str) -> str:
    """A cell as it is written: with an apostrophe before what would begin a formula."""
    return f"'{text}" if _QUOTED.match(text) and not _NUMBER.match(text) else text


def bare(cell: str) -> str:
    """The text of a cell that `guarded` wrote; any other cell as it is."""
    return cell[1:] if cell[:1] == "'" and _QUOTED.match(cell) else cell
