"""Pages for people, each one self-contained file, and their elements: escaped text, tables, pictures, bars, terms."""

import base64
import html
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files

from matplotlib.figure import Figure

DPI = 110
"""Dots per inch of pictures, which are then about as wide as a page on a common screen."""

WIDE = 8.0
"""Inches. Wider pictures keep their size on a phone and scroll sideways, so that their words can be read."""


class Html(str):
    """Text that is HTML already. All other text is escaped where it enters a page."""

    __slots__ = ()


def text(words: str) -> Html:
    """Escaped words; `Html` stays.

    Minus signs, squares of units and powers of ten are typeset: 3e-12 as 3·10 with −12 raised.
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


def whole_page(title: str, *content: str) -> str:
    """A self-contained page with the style of all pages; title: of the browser's window."""
    style = files(__package__).joinpath("page.css").read_text(encoding="utf-8")
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(title)}</title><style>\n{style}</style>"
    )
    body = tag("main", *content)
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>{body}</body></html>\n'


def explained(word: str, meaning: str, kind: str = "") -> Html:
    """A word whose meaning shows on hover; kind: a class of the page."""
    css = f' class="{kind}"' if kind else ""
    return Html(f'<abbr{css} title="{html.escape(meaning)}">{text(word)}</abbr>')


def meanings(words: Mapping[str, str]) -> Html:
    """A list of words with their meanings."""
    return tag("dl", *(part for name, meaning in words.items() for part in (tag("dt", name), tag("dd", meaning))))


def tag(name: str, *content: str, kind: str = "") -> Html:
    """An element of a CSS class with escaped content."""
    start = f'{name} class="{kind}"' if kind else name
    return Html(f"<{start}>{''.join(text(part) for part in content)}</{name}>")


def section(title: str, *content: str) -> Html:
    """A part of the page with its heading; empty where there is no content."""
    parts = [part for part in content if part]
    return tag("section", tag("h2", title), *parts) if parts else Html()


def items(lines: Iterable[str]) -> Html:
    """A list; empty without lines."""
    rows = [tag("li", line) for line in lines]
    return tag("ul", *rows) if rows else Html()


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Html:
    """A table that scrolls sideways on a narrow screen; empty without rows."""
    lines = [tag("tr", *(tag("td", cell) for cell in row)) for row in rows]
    if not lines:
        return Html()
    top = tag("thead", tag("tr", *(tag("th", cell) for cell in head)))
    return tag("div", tag("table", top, tag("tbody", *lines)), kind="scroll")


def bar(share: float, colour: str) -> Html:
    """A horizontal bar; share: of the full width, 0 to 1. colour: a class of the page."""
    return Html(f'<span class="track"><span class="bar {colour}" style="width:{100 * share:.1f}%"></span></span>')


def picture(figure: Figure, caption: str) -> Html:
    """A figure as a PNG inside the page, with its caption."""
    memory = io.BytesIO()
    figure.savefig(memory, dpi=DPI, format="png")
    data = base64.b64encode(memory.getvalue()).decode("ascii")
    image = Html(f'<img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">')
    wide = "wide" if figure.get_figwidth() > WIDE else ""
    return tag("figure", tag("div", image, kind="scroll"), tag("figcaption", caption), kind=wide)
