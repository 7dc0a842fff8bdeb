"""Documents whose blocks are run in order, each followed by what it prints.

`python -m tests.tutorials` writes the outputs anew, after a change that moves them.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import sys
import tempfile
from pathlib import Path
from typing import Any

from ballfg.benchmarks.cli import run as bench
from ballfg.cli.main import run as ballfg
from ballfg.learning.cli import run as train
from tests.places import DOCS

TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
BLOCK = re.compile(r"```(python|text|)\n(.*?)```\n", re.DOTALL)
PROGRAMS = {"ballfg": ballfg, "ballfg-bench": bench, "ballfg-train": train}


def run_document(text: str) -> str:
    """The document with the outputs of its blocks as they are now; in the current folder.

    Blocks of commands print nothing here; a `text` block after a `python` block is what that prints.
    """
    names: dict[str, Any] = {"__name__": "tutorial"}
    made, end, printed = [], 0, ""
    for block in BLOCK.finditer(text):
        kind, code = block.groups()
        made.append(text[end : block.start()])
        if kind == "text":
            made.append(f"```text\n{printed}```\n")
        else:
            made.append(block[0])
            printed = _run_python(code, names) if kind == "python" else _run_commands(code)
        end = block.end()
    return "".join((*made, text[end:]))


def _run_python(code: str, names: dict[str, Any]) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(compile(code, "tutorial", "exec"), names)
    return out.getvalue()


def _run_commands(code: str) -> str:
    for line in code.splitlines():
        words = shlex.split(line, comments=True)
        if not words:
            continue
        if words[0] == "echo":  # echo TEXT > FILE
            Path(words[3]).write_text(words[1] + "\n", encoding="utf-8")
            continue
        where = words[words.index(">") + 1] if ">" in words else os.devnull
        arguments = words[1 : words.index(">")] if ">" in words else words[1:]
        with open(where, "w", encoding="utf-8") as file, contextlib.redirect_stdout(file):
            try:
                PROGRAMS[words[0]](arguments)
            except SystemExit as end:
                if end.code:
                    raise RuntimeError(f"{line} ended with status {end.code}") from None
    return ""


def main() -> None:
    """Writes the outputs of all documents anew."""
    for document in TUTORIALS:
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            text = run_document(document.read_text(encoding="utf-8"))
        document.write_text(text, encoding="utf-8")
        print(document.name, file=sys.stderr)


if __name__ == "__main__":
    main()
