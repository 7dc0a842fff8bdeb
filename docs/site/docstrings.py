"""Docstrings as griffe reads them: it wants a section's title on a line of its own, and one name a line."""

import re
from typing import Any

import griffe

TITLED = re.compile(r"^(Args|Returns|Raises|Attributes): (?=\S)")
NAMED = re.compile(r"[a-z_]\w*(?:, [a-z_]\w*)*: ")
NEXT = re.compile(r"(?:  |(?<=\.) )(?=(?:[a-z_]\w*(?:, [a-z_]\w*)*|[A-Z]\w*Error): )")


class OneNameALine(griffe.Extension):
    """Takes sections such as `Args: a: shape.  b: unit.` apart."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Every module, class, function and attribute."""
        if obj.docstring is not None:
            obj.docstring.value = _apart(obj.docstring.value)


def _apart(text: str) -> str:
    lines: list[str] = []
    gathered: list[str] | None = None  # the one-line section that is being read
    for line in [*text.splitlines(), ""]:
        if gathered is not None and line.startswith("    "):
            gathered.append(line.strip())
            continue
        if gathered is not None:
            title, words = gathered[0], " ".join(gathered[1:])
            if title == "Args" and not NAMED.match(words):  # "as for `other`"
                lines += [f"Arguments {words}", ""]
            else:
                lines += [f"{title}:", *(f"    {part.strip()}" for part in NEXT.split(words)), ""]
            gathered = None
        found = TITLED.match(line)
        if found:
            gathered = [found[1], line[found.end() :]]
        else:
            lines.append(line)
    return "\n".join(lines).rstrip()
