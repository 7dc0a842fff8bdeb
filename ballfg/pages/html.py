"""Builds the elements of a page: escaped text, tables, lists, pictures, bars, explained words."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 110  # Dots per inch of pictures, which then fill a page on a common screen
READABLE = 78
"""Least pixels on the screen for each inch of a picture: words of 10 points are then 11 pixels high. On a narrower
screen a picture scrolls within its own box."""


class Html(str):
    """HTML text. All other text is escaped when it enters a page."""

    __slots__ = ()


def text(words: str) -> Html:
    """Escaped words; `Html` stays.

    Minus signs, squares in units and powers of ten are typeset: 3e-12 as 3·10 with −12 raised.
    """
    if isinstance(words, Html):
        return words
    escaped = html.escape(words).replace("/s^2", "/s²").replace("m^2", "m²")
    raised = re.sub(r"\b(\d[\d.]*)e([+-]\d+)\b", _power, escaped)
    return Html(re.sub(r"(?<![\w>.)-])-(?=\d)", "−", raised))


def _power(match: re.Match[str]) -> str:
    exponent = f"{int(match[2])}".replace("-", "−")
    base = "" if match[1] == "1" else f"{match[1]}·"
    return f"{base}10<sup>{exponent}</sup>"


def tag(name: str, *content: str, kind: str = "", **attributes: str) -> Html:
    """An element with escaped content.

    Args:
        name: of the element.  content: text or HTML inside it.  kind: its CSS class.
        attributes: others, by name; an underscore stands for a hyphen.
    """
    given = ({"class": kind} if kind else {}) | attributes
    words = "".join(f' {key.replace("_", "-")}="{html.escape(value)}"' for key, value in given.items())
    return Html(f"<{name}{words}>{''.join(text(part) for part in content)}</{name}>")


def section(title: str, *content: str) -> Html:
    """A part of the page with its heading; empty without content."""
    parts = [part for part in content if part]
    return tag("section", tag("h2", title), *parts) if parts else Html()


def items(lines: Iterable[str]) -> Html:
    """A list; empty without lines."""
    rows = [tag("li", line) for line in lines]
    return tag("ul", *rows) if rows else Html()


def doubtful(doubts: Iterable[str]) -> Html:
    """What is not sure about the tracks, for the top of a page; empty without doubts."""
    line = "; ".join(doubts)
    return tag("p", f"Doubtful: {line}.", kind="unsure") if line else Html()


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Html:
    """A table that scrolls within itself on a narrow screen; empty without rows."""
    lines = [tag("tr", *(tag("td", cell) for cell in row)) for row in rows]
    if not lines:
        return Html()
    top = tag("thead", tag("tr", *(tag("th", cell) for cell in head)))
    return tag("div", tag("table", top, tag("tbody", *lines)), kind="scroll")


def typed(words: str) -> Html:
    """Text for copying into a terminal, to the letter: a typeset minus sign would not work there."""
    return Html(f"<code>{html.escape(words)}</code>")


def explained(word: str, meaning: str, kind: str = "") -> Html:
    """A word whose explanation appears under the pointer, and below it on touch or keyboard focus."""
    return tag("abbr", word, kind=kind, title=meaning, tabindex="0")


def meanings(words: Mapping[str, str]) -> Html:
    """A list of words with their meanings."""
    return tag("dl", *(part for name, meaning in words.items() for part in (tag("dt", name), tag("dd", meaning))))


def bar(share: float, colour: str) -> Html:
    """A horizontal bar. Args: share: of the full width, 0 to 1. colour: a CSS class of the page."""
    return tag("span", tag("span", kind=f"bar {colour}", style=f"width:{100 * share:.1f}%"), kind="track")


def picture(figure: Figure, caption: str) -> Html:
    """A figure as a PNG inside the page.

    Args: figure: of matplotlib.  caption: below it, and its text for screen readers.
    """
    memory = io.BytesIO()
    figure.savefig(memory, dpi=DPI, format="png")
    data = base64.b64encode(memory.getvalue()).decode("ascii")
    least = f"--least: {READABLE * figure.get_figwidth():.0f}px"
    image = Html(f'<img alt="{html.escape(caption)}" style="{least}" src="data:image/png;base64,{data}">')
    return tag("figure", tag("div", image, kind="scroll"), tag("figcaption", caption))
