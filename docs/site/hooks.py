"""What the site does with pages before they are built: formulas become MathML, rooms list their public names."""

import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

PACKAGE = Path("build/typed")
"""The package as installed, which `make docs` puts there."""
CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)
BLOCK = re.compile(r"\$\$(.+?)\$\$", re.DOTALL)
INLINE = re.compile(r"(?<![\\$\w])\$(?!\s)([^$\n]+?)(?<!\s)\$(?!\w)")
ROOM = re.compile(r"^::: (ballfg[\w.]*)$", re.MULTILINE)
PUBLIC = re.compile(r"\b(\w+) as \1\b")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page as it is built."""
    parts = CODE.split(ROOM.sub(_names, markdown))
    return "".join(part if number % 2 else _with_formulas(part) for number, part in enumerate(parts))


def _with_formulas(text: str) -> str:
    """Browsers draw MathML by themselves: the site loads nothing from the net."""
    text = BLOCK.sub(lambda found: "\n\n" + convert(" ".join(found[1].split()), display="block") + "\n\n", text)
    return INLINE.sub(lambda found: f"<span>{convert(found[1])}</span>", text)  # a bare <math> would begin a block


def _names(found: re.Match[str]) -> str:
    """One entry for each name that the stub of a room lists."""
    stub = PACKAGE.joinpath(*found[1].split("."), "__init__.pyi").read_text(encoding="utf-8")
    names = sorted(PUBLIC.findall(stub), key=str.lower)
    if not names:
        raise ValueError(f"{found[1]} lists no public names")
    return "\n\n".join(f"::: {found[1]}.{name}" for name in names)
