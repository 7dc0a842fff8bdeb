"""Docstrings in Google's style: their sections, and the shapes and units that they give."""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass

SECTIONS = ("Args", "Returns", "Yields", "Raises", "Attributes", "Source", "Example", "Examples", "Note", "Notes")

DIMENSION = (
    r"(?:\.\.\.|\*?[A-Za-z0-9_]{1,3}(?: ?[-+*/^] ?[A-Za-z0-9_]{1,3})*|\*?(?:height|width|batch|samples)|len\(\w+\))"
)
SHAPE = re.compile(rf"(?<![\w`])\((?:|\.\.\.|{DIMENSION},|{DIMENSION}(?:, {DIMENSION})+)\)")
COORDINATES = re.compile(r"\((?:[xyzuv](?:, )?)+\)")
"""Looks like a shape and names coordinates."""
OTHER_SHAPE = re.compile(r"(?:same|any|own|their|its|whose) shapes?\b|shapes? (?:of|as)\b|shaped? (?:as|like)\b|scalar")

SYMBOL = r"(?:kg|mm|cm|km|m|ms|us|s|rad|deg|px|Hz|N|Pa|J|W)(?:\^?-?\d|[²³])?"
UNIT = re.compile(
    rf"(?<![\w'’`.^-])(?:(?:1/)?{SYMBOL}(?:[/ ·]{SYMBOL})*)(?![\w'’`^])"
    r"|\b(?:dimensionless|whitened|standard normal|chi-square|ind(?:ex|ices)|bool(?:ean)?s?|whether|masks?|flags?"
    r"|codes?|counts?|numbers? of|shares?|ratios?|probabilit\w+|weights?|unit vectors?|grey levels?|Quality"
    r"|pixels?|degrees?|metres?|seconds?|radians?|units?)\b"
)
"""A unit of measurement, or the word that says why there is none."""
AS_ELSEWHERE = re.compile(r"\bas (?:for|in|of|by|from|with|given to|that of|those of|those in) (?:the )?`")
"""Sends the reader to the docstring where shape and unit stand."""
ONE_FOR_ALL = re.compile(rf"\b(?:each|both|pairs?|same)\b|{AS_ELSEWHERE.pattern}")
"""Lets one shape speak for several arrays."""


@dataclass(frozen=True)
class Text:
    """A docstring, cut into its sections; the key "" holds what stands before them."""

    whole: str
    sections: dict[str, str]

    @classmethod
    def parse(cls, docstring: str | None) -> Text:
        """Cuts a docstring in Google's style; a section may begin on the line of its title."""
        sections: dict[str, list[str]] = {"": []}
        current = ""
        for line in inspect.cleandoc(docstring or "").splitlines():
            title = re.match(rf"({'|'.join(SECTIONS)}):(?: |$)", line)
            if title:
                current = title[1]
                line = line[title.end() :]
            elif line and not line[0].isspace() and current and not sections[current][-1].strip():
                current = ""  # prose goes on after a section and an empty line
            sections.setdefault(current, []).append(line)
        return cls(docstring or "", {title: "\n".join(lines) for title, lines in sections.items()})

    def entry(self, name: str, names: set[str]) -> str | None:
        """What `Args:` or `Attributes:` say of one name; entries may share a line, names may share an entry."""
        for title in ("Args", "Attributes"):
            text = "\n" + self.sections.get(title, "")
            heads = [
                (match, {n.lstrip("*") for n in match[1].split(", ")})
                for match in re.finditer(
                    r"(?:(?<=\n)|(?<=\s\s)|(?<=^))\s*((?:\*{0,2}\w+, )*\*{0,2}\w+)(?: \([^)]*\))?: ?", text
                )
            ]
            heads = [(match, found) for match, found in heads if found <= names]
            for i, (match, found) in enumerate(heads):
                if name in found:
                    end = heads[i + 1][0].start() if i + 1 < len(heads) else len(text)
                    return f"{', '.join(found)}: {text[match.end() : end]}"
            if not heads and AS_ELSEWHERE.search(text):
                return text
        return None


def shapes(text: str) -> list[re.Match[str]]:
    """All shapes in a text."""
    return [match for match in SHAPE.finditer(text) if not COORDINATES.fullmatch(match[0])]


def has_shape(text: str) -> bool:
    """Whether a shape is given, or the words that say where it comes from."""
    return bool(shapes(text) or OTHER_SHAPE.search(text) or AS_ELSEWHERE.search(text))


def has_unit(text: str) -> bool:
    """Whether a unit, or the word for none, is given; a state's units are those of docs/conventions.md."""
    state = re.search(r"\bstates?\b|\bcovariances?\b", text) and re.search(r"\(.*\b9\b.*\)|dim|\bd\b", text)
    return bool(UNIT.search(SHAPE.sub("()", text)) or state or AS_ELSEWHERE.search(text))


def mention(text: str, name: str) -> re.Match[str] | None:
    """The shape that stands beside a name, in its singular or plural, in a sentence."""
    stem = re.escape(name.rstrip("s").replace("_", " "))
    for match in re.finditer(rf"\b(?:{re.escape(name)}|{stem}s?)\b", text, re.IGNORECASE):
        near = [shape for shape in shapes(text) if 0 <= shape.start() - match.end() < 40]
        near += [shape for shape in shapes(text) if 0 <= match.start() - shape.end() < 25]
        if near:
            return near[0]
    return None
