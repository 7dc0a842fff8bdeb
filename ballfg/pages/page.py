"""Writes one self-contained HTML file, with style, scripts and data inside."""

import html
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from ballfg.pages.html import tag


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
