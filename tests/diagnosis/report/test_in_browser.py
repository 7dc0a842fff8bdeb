"""A report in a browser: no error in its console, and no sideways scrolling on a phone."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ballfg.diagnosis.report.headline import Origin
from ballfg.diagnosis.report.page import page
from ballfg.pages.html import DPI
from tests.browser import needs_browser, opened
from tests.diagnosis.made_diagnosis import found

PHONE = 400
MEASURE = """
const frame = document.querySelector("iframe");
frame.addEventListener("load", () => {
  const root = frame.contentDocument.documentElement, words = frame.contentDocument.querySelectorAll("abbr");
  const found = [frame.contentWindow.innerWidth];
  for (const word of [null, ...words]) {
    if (word !== null) word.focus();
    found.push(root.scrollWidth - root.clientWidth);
  }
  document.body.dataset.found = found.join(" ");
  const images = [...frame.contentDocument.querySelectorAll("img")];
  document.body.dataset.images = images.map((i) => (i.clientWidth / i.naturalWidth).toFixed(3)).join(" ");
});
"""
"""The width of the window, then by how much the page is wider, as it is and with each explained word chosen; and the
width of each picture as shown, over its own."""


@needs_browser
def test_a_report_fits_a_phone_and_has_no_errors(tmp_path: Path) -> None:
    made = page(found(), Origin(f"ballfg diagnose {'windy' * 30} --out d", ("windy" * 30,), "", "d"))
    elements, console = opened(made, PHONE, MEASURE, tmp_path)
    assert not console
    measured = re.search(r'data-found="([^"]*)"', elements)
    assert measured is not None
    width, *wider = map(int, measured[1].split())
    assert width == PHONE
    assert len(wider) > 10
    assert not any(wider)
    shares = re.search(r'data-images="([^"]*)"', elements)
    assert shares is not None
    points = 10.0 / 72.0 * DPI * np.array(shares[1].split(), dtype=float)
    assert len(points) == 9
    assert (points >= 10.0).all(), points  # pixels on the phone of words of 10 points
