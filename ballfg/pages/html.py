"""The elements of a page: escaped text, tables, lists, terms with an explanation."""

import html
import re
from collections.abc import Iterable, Sequence


class Html(str):
    """Text that is HTML already. All other text is escaped where it enters a page."""

    __slots__ = ()


def text(words: str) -> Html:
    """Escaped words; `Html` stays. Minus signs and powers of ten are typeset: 3e-12 as 3·10 with −12 raised.

    Args: words: plain text, or HTML.
    """
    if isinstance(words, Html):
        return words
    escaped = html.escape(words)
    raised = re.sub(r"\b(\d[\d.]*)e([+-]\d+)\b", _power, escaped)
    return Html(re.sub(r"(?<![\w>.)-])-(?=\d)", "−", raised))


def _power(match: re.Match[str]) -> str:
    exponent = f"{int(match[2])}".replace("-", "−")
    base = "" if match[1] == "1" else f"{match[1]}·"
    return f"{base}10<sup>{exponent}</sup>"


def tag(name: str, *content: str, kind: str = "", **attributes: str) -> Html:
    """An element with escaped content.

    Args:
        name: of the element.  content: text or HTML inside it.
        kind: its CSS class.
        attributes: others, by name; an underscore stands for a hyphen.
    """
    given = ({"class": kind} if kind else {}) | attributes
    words = "".join(f' {key.replace("_", "-")}="{html.escape(value)}"' for key, value in given.items())
    return Html(f"<{name}{words}>{''.join(text(part) for part in content)}</{name}>")


def section(title: str, *content: str) -> Html:
    """A part of the page with its heading; empty where there is no content.

    Args: title: of the part.  content: text or HTML under it.
    """
    parts = [part for part in content if part]
    return tag("section", tag("h2", title), *parts) if parts else Html()


def items(lines: Iterable[str]) -> Html:
    """A list; empty without lines.

    Args: lines: text or HTML of each item.
    """
    rows = [tag("li", line) for line in lines]
    return tag("ul", *rows) if rows else Html()


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Html:
    """A table that scrolls within itself on a narrow screen; empty without rows.

    Args: head: names of the columns.  rows: text or HTML of the cells.
    """
    lines = [tag("tr", *(tag("td", cell) for cell in row)) for row in rows]
    if not lines:
        return Html()
    top = tag("thead", tag("tr", *(tag("th", cell) for cell in head)))
    return tag("div", tag("table", top, tag("tbody", *lines)), kind="scroll")


def term(word: str, explanation: str) -> Html:
    """A word whose explanation appears under the pointer, or when it is touched or reached by the keyboard.

    Args: word: as it stands in the sentence.  explanation: one sentence.
    """
    return tag("span", word, tag("span", explanation, kind="tip", role="tooltip"), kind="term", tabindex="0")
