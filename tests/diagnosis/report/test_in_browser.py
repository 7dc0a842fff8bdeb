"""A report in a browser: no error in its console, and no sideways scrolling on a phone."""

from __future__ import annotations

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
MEASURE = "<script>document.title = `${document.documentElement.scrollWidth} of ${window.innerWidth}`</script>"


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_a_report_fits_a_phone_and_has_no_errors(tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    made = page(found(), Origin(f"ballfg diagnose {'windy' * 30} --out d", ("windy" * 30,), "", "d"))
    file.write_text(made.replace("</body>", f"{MEASURE}</body>"), encoding="utf-8")
    assert CHROMIUM is not None
    words = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    words += ["--enable-logging=stderr", "--v=0", f"--window-size={PHONE},900", "--dump-dom", file.as_uri()]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    assert "CONSOLE" not in done.stderr
    measured = re.search(r"<title>(\d+) of (\d+)</title>", done.stdout)
    assert measured is not None
    assert int(measured[2]) <= 500  # some versions have a least width of a window
    assert int(measured[1]) <= int(measured[2])
