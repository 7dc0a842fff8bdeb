"""A report in a browser: no error in its console, and no sideways scrolling on a phone."""

from __future__ import annotations

import html
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from ballfg.diagnosis.report.origin import Origin
from ballfg.diagnosis.report.page import page
from tests.diagnosis.made_diagnosis import found

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PHONE = 400
MEASURE = (
    "const root = contentDocument.documentElement;"
    "document.title = `${root.scrollWidth} of ${root.clientWidth} in ${contentWindow.innerWidth}`"
)
"""Runs when the page has been laid out in a frame: a window has a least width, a frame has not."""


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_a_report_fits_a_phone_and_has_no_errors(tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    made = page(found(), Origin(f"ballfg diagnose {'windy' * 30} --out d", ("windy" * 30,), "", "d"))
    frame = f'<iframe style="width: {PHONE}px; border: 0" onload="{MEASURE}" srcdoc="{html.escape(made)}"></iframe>'
    file.write_text(f'<meta charset="utf-8"><title>?</title>{frame}', encoding="utf-8")
    assert CHROMIUM is not None
    words = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    words += ["--enable-logging=stderr", "--v=0", "--dump-dom", file.as_uri()]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    assert "CONSOLE" not in done.stderr
    measured = re.search(r"<title>(\d+) of (\d+) in (\d+)</title>", done.stdout)
    assert measured is not None
    needed, there, frame_width = map(int, measured.groups())
    assert needed == there
    assert frame_width == PHONE
