"""Pages in a browser without a window."""

from __future__ import annotations

import html
import shutil
import subprocess
from pathlib import Path

import pytest

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def opened(page: str, width: int, script: str, folder: Path) -> tuple[str, list[str]]:
    """The elements of a document that holds a page in a frame, and the messages of the console.

    Args:
        page: its text.
        width: of the frame, px.
        script: JavaScript of the document; it finds the frame by its element, `iframe`.
        folder: for files.
    """
    # a window cannot be made narrower than 500 px, but a frame can; its text comes with it, so that it can be measured
    frame = f'<iframe srcdoc="{html.escape(page)}" style="width:{width}px;height:900px;border:0"></iframe>'
    # without its encoding Chromium guesses one from the first part that it has read, which may be ASCII alone
    (folder / "frame.html").write_text(
        f'<!DOCTYPE html><meta charset="utf-8"><body>{frame}<script>{script}</script></body>', encoding="utf-8"
    )
    command = [str(BROWSER), *FLAGS, "--enable-logging=stderr", "--v=0", "--virtual-time-budget=12000"]
    command += [f"--user-data-dir={folder / 'profile'}", "--window-size=1400,1000", "--dump-dom"]
    done = subprocess.run(
        [*command, (folder / "frame.html").as_uri()], capture_output=True, encoding="utf-8", timeout=120, check=True
    )
    return done.stdout, [x for x in done.stderr.splitlines() if "CONSOLE" in x and "GL Driver Message" not in x]
