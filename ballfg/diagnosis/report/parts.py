"""The pieces of the page: escaped text, tables, pictures inside the page, bars, and how all of it looks."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Iterable, Sequence

from matplotlib.figure import Figure

DPI = 110
"""Pictures are then about as many pixels wide as a page on a common screen."""


class Html(str):
    """Text that is HTML already: whatever is not is escaped where it enters a page."""

    __slots__ = ()


def text(words: str) -> Html:
    """Escaped words; what is HTML stays. Minus signs and powers of ten are set: 3e-12 as 3·10 with −12 raised."""
    if isinstance(words, Html):
        return words
    escaped = html.escape(words)
    raised = re.sub(r"\b(\d[\d.]*)e([+-]\d+)\b", _power, escaped)
    return Html(re.sub(r"(?<![\w>.)-])-(?=\d)", "−", raised))


def _power(match: re.Match[str]) -> str:
    exponent = f"{int(match[2])}".replace("-", "−")
    base = "" if match[1] == "1" else f"{match[1]}·"
    return f"{base}10<sup>{exponent}</sup>"


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
    return tag("figure", image, tag("figcaption", caption))


STYLE = """
:root { color-scheme: light dark; --paper: #fbfaf7; --card: #ffffff; --ink: #1d2430; --quiet: #5d6675; --line: #dcdfe4;
  --blue: #0072b2; --orange: #c65300; --green: #00795a; }
@media (prefers-color-scheme: dark) { :root { --paper: #14181f; --card: #1d232d; --ink: #e9ecf1; --quiet: #9aa5b5;
  --line: #343d4b; --blue: #5db5e8; --orange: #f0914a; --green: #45c79f; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.55 system-ui, "Segoe UI", sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
header p { margin: 0; color: var(--quiet); }
h1 { font-size: clamp(1.5rem, 3.6vw, 2.3rem); line-height: 1.25; font-weight: 650; margin: .7rem 0 1.6rem;
  max-width: 34em; }
h2 { font-size: 1.3rem; margin: 3rem 0 .9rem; padding-top: 1rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.1rem; margin: 0 0 .35rem; }
p { max-width: 46em; margin: .4rem 0 .8rem; }
ul { padding-left: 1.2rem; max-width: 46em; }
.quiet, figcaption { color: var(--quiet); font-size: .92rem; }
.badge { display: inline-block; padding: .1rem .65rem; border-radius: 1rem; font-size: .86rem; font-weight: 600;
  border: 1.5px solid currentColor; white-space: nowrap; }
.found, .added { color: var(--blue); } .nothing { color: var(--green); } .unexplained, .alike { color: var(--orange); }
.other { color: var(--quiet); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(190px, 1fr)); gap: .9rem; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: .7rem; padding: 1rem 1.15rem;
  margin-bottom: .9rem; }
.cards .card { margin: 0; }
.big { display: block; font-size: 1.5rem; font-weight: 650; font-variant-numeric: tabular-nums; }
.big .was { color: var(--quiet); font-weight: 400; }
sup { line-height: 0; }
.beside { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 400px), 1fr));
  gap: .9rem 1.4rem; align-items: start; }
.beside figure { margin: 0; }
figure { margin: 1.1rem 0; } figcaption { max-width: 60em; margin-top: .35rem; }
img { max-width: 100%; height: auto; display: block; background: #fff; border: 1px solid var(--line);
  border-radius: .5rem; padding: .5rem; }
.scroll { overflow-x: auto; margin: .6rem 0 1rem; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; font-variant-numeric: tabular-nums; }
th { text-align: left; color: var(--quiet); font-weight: 600; border-bottom: 1.5px solid var(--line); }
th, td { padding: .32rem .8rem .32rem 0; vertical-align: top; } td { border-bottom: 1px solid var(--line); }
.track { display: inline-block; width: 8rem; height: .65rem; background: var(--line); border-radius: .3rem;
  margin-right: .6rem; }
.bar { display: block; height: 100%; border-radius: .3rem; min-width: 2px; background: var(--quiet); }
.bar.added { background: var(--blue); } .bar.alike { background: var(--orange); }
table + h3, .scroll + h3, details + h3, figure + h3 { margin-top: 1.6rem; }
summary { cursor: pointer; color: var(--quiet); margin: .3rem 0; }
code { font-family: ui-monospace, Consolas, monospace; font-size: .93em; }
"""
"""Follows the reader's light or dark setting; pictures keep their white ground."""
