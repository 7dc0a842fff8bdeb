"""Writes one self-contained HTML file of escaped text, tables, lists, pictures, bars, explained words."""

import base64
import html
import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from typing import TYPE_CHECKING, Any

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


def picture(figure: "Figure", caption: str) -> Html:
    """A figure as a PNG inside the page.

    Args: figure: of matplotlib.  caption: below it, and its text for screen readers.
    """
    memory = io.BytesIO()
    figure.savefig(memory, dpi=DPI, format="png")
    data = base64.b64encode(memory.getvalue()).decode("ascii")
    least = f"--least: {READABLE * figure.get_figwidth():.0f}px"
    image = Html(f'<img alt="{html.escape(caption)}" style="{least}" src="data:image/png;base64,{data}">')
    return tag("figure", tag("div", image, kind="scroll"), tag("figcaption", caption))


def whole_page(
    title: str,
    *content: str,
    style: str = "",
    data: Mapping[str, Any] | None = None,
    scripts: Sequence[str] = (),
    plotly: bool = False,
) -> str:
    """The text of a page that adapts to wide and narrow screens and to paper.

    Args:
        title: of the window.  content: text or HTML of the page, part by part.
        style: CSS rules of this page, added to those of all pages.
        data: for the scripts, as JSON in the element `data`; without NaN and infinity.
        scripts: JavaScript, run in this order after the page has loaded.
        plotly: embed plotly.js before them; it has 4.8 MB.
    Raises: ValueError: data with NaN or infinity.
    """
    parts = ['<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">']
    parts += [f"<title>{html.escape(title)}</title>", f"<style>\n{own('style.css')}{style}</style>"]
    end = []
    if data is not None:
        plain = json.dumps(data, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
        for sign in "<>&\u2028\u2029":  # a name such as `</script>` must not end the element
            plain = plain.replace(sign, f"\\u{ord(sign):04x}")
        end.append(f'<script type="application/json" id="data">{plain}</script>')
    if plotly:
        from plotly.offline import get_plotlyjs

        end.append(f"<script>{get_plotlyjs()}</script>")
    end += [f"<script>\n{script}</script>" for script in scripts]
    body = tag("main", *content)
    return f'<!DOCTYPE html>\n<html lang="en"><head>{"".join(parts)}</head>\n<body>{body}{"".join(end)}</body></html>\n'


def own(name: str) -> str:
    """The text of a style or a script of this room."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")
