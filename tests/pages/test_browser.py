"""The page in a browser: everything is drawn, nothing fails, and it fits narrow and wide windows."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

import pytest

from ballfg.pages.given import recognise
from ballfg.pages.show_page import show_page
from ballfg.pages.shown import collect
from tests.browser import needs_browser, opened
from tests.pages.made import Fall, Made, make, write

pytestmark = needs_browser
MEASURE = """
const frame = document.querySelector("iframe");
frame.addEventListener("load", () => setTimeout(() => {
  const inside = frame.contentDocument, root = inside.documentElement;
  const count = query => inside.querySelectorAll(query).length;
  const found = {
    too_wide: root.scrollWidth - root.clientWidth,
    traces: count(".scatterlayer .trace"),
    spaces: count(".gl-container canvas"),
    bars: count(".bars .point"),
    options: count("#shot option"),
    readout: (inside.getElementById("readout") || {}).textContent || "",
    legend: Array.from(inside.querySelectorAll("#space .legendtext")).map(e => e.textContent).join("|"),
  };
  const list = inside.getElementById("shot"), slider = inside.getElementById("moment");
  if (list !== null && list.length > 1) {
    list.selectedIndex = 1;
    list.dispatchEvent(new Event("change"));
    slider.value = 20;
    slider.dispatchEvent(new Event("input"));
    found.moved = inside.getElementById("readout").textContent;
    found.ball = inside.getElementById("space").data.at(-1).x[0];
  }
  document.body.dataset.found = JSON.stringify(found);
}, 3000));
"""


def browsed(page: str, width: int, folder: Path) -> tuple[dict[str, object], str]:
    """What is drawn in a window of a width in px, and the messages of the console."""
    elements, console = opened(page, width, MEASURE, folder)
    (found,) = re.findall(r'<body data-found="([^"]*)"', elements)
    return json.loads(html.unescape(found)), "\n".join(console)


@pytest.mark.parametrize("width", [400, 1200])
def test_everything_is_drawn(made: Made, report: Path, tmp_path: Path, width: int) -> None:
    page = show_page(collect(recognise([made.dataset, made.states, made.predictions, report])))
    found, console = browsed(page, width, tmp_path)
    assert not re.search(r"error|uncaught|exception|warn", console, flags=re.IGNORECASE), console
    assert found["too_wide"] == 0, "the page scrolls sideways"
    # axes 3 x (measured, estimate, prediction and 2 bands), errors 3 x 2, residuals 3 + 3, coverage 3, diagnosis 2
    assert found["traces"] == 15 + 6 + 6 + 3 + 2
    assert found["spaces"]
    assert found["bars"]
    assert found["options"] == 3
    assert str(found["readout"]).startswith("t = 0.000 s · x 0.000 m, y 0.000 m, z 1.080 m (± 1.00 mm")
    assert str(found["moved"]).startswith("t = 0.200 s · x -0.800 m, y 0.100 m, z 1.084 m")  # of the second shot
    assert found["ball"] == -0.8
    for name in ("measured", "estimate", "prediction", "contact", "spin axis, 0.1 m for 100 rad/s"):
        assert name in str(found["legend"]).split("|")


BANDS = """
const frame = document.querySelector("iframe");
frame.addEventListener("load", () => setTimeout(() => {
  const traces = frame.contentDocument.getElementById("axes").data, bands = traces.filter(one => one.fill === "toself");
  document.body.dataset.found = JSON.stringify(bands.map(one => one.x));
}, 3000));
"""


def test_bands_end_at_gaps(tmp_path: Path) -> None:
    made = make(tmp_path, {"a": Fall()})
    for path in (made.dataset / "tracks.csv", made.states, made.predictions):
        head, *rows = path.read_text().splitlines()
        write(path, head.split(","), [r.split(",") for r in rows if not 0.345 < float(r.split(",")[1]) < 0.475])
    page = show_page(collect(recognise([made.dataset, made.states, made.predictions])))
    elements, _ = opened(page, 1200, BANDS, tmp_path)
    (found,) = re.findall(r'<body data-found="([^"]*)"', elements)
    bands = json.loads(html.unescape(found))
    assert len(bands) == 6
    for band in bands:
        before, after = [t for t in band if t is not None and t < 0.4], [t for t in band if t is not None and t > 0.4]
        assert band == [*before, None, *after, None]
        assert (max(before), min(after)) == (0.34, 0.48)


UNKNOWN = """
const frame = document.querySelector("iframe");
frame.addEventListener("load", () => setTimeout(() => {
  const inside = frame.contentDocument, space = inside.getElementById("space"), found = [];
  for (const one of space.data) for (const value of one.x) if (value !== null) found.push(value);
  const {xaxis} = space.layout.scene, readout = inside.getElementById("readout").textContent;
  document.body.dataset.found = JSON.stringify({least: Math.min(...found), range: xaxis.range, readout});
}, 3000));
"""


def test_unknown_states_are_drawn_nowhere(tmp_path: Path) -> None:
    """A ball that flies from x = 3 m on over a table under its middle: an unknown place is not at x = 0."""
    made = make(tmp_path, {"a": Fall()}, extent=False)
    for path, column in ((made.dataset / "tracks.csv", 2), (made.states, 2), (made.predictions, 2)):
        head, *rows = (line.split(",") for line in path.read_text().splitlines())
        moved = [[*row[:column], float(row[column]) + 3.0, *row[column + 1 :]] for row in rows]
        write(path, head, moved)
    head, *rows = (line.split(",") for line in made.states.read_text().splitlines())
    write(
        made.states,
        head,
        [[*row[:2], *["nan"] * 3, *row[5:]] if k in (0, 30, 31) else row for k, row in enumerate(rows)],
    )
    page = show_page(collect(recognise([made.dataset, made.states, made.predictions])))
    elements, console = opened(page, 1200, UNKNOWN, tmp_path)
    assert not re.search(r"error|uncaught|exception", "\n".join(console), flags=re.IGNORECASE), console
    (found,) = re.findall(r'<body data-found="([^"]*)"', elements)
    shown = json.loads(html.unescape(found))
    assert shown["readout"].startswith("t = 0.000 s · x unknown, y unknown, z unknown")
    assert shown["least"] > 2.0
    assert shown["range"][0] > 2.0


def test_a_hostile_name_runs_nothing_and_two_samples_are_drawn(tmp_path: Path) -> None:
    falls = {"<img src=x onerror=document.title='run'>": Fall(samples=2), "</script><b>": Fall()}
    made = make(tmp_path, falls, extent=False)
    found, console = browsed(show_page(collect(recognise([made.dataset, made.states]))), 400, tmp_path)
    assert not re.search(r"error|uncaught|exception|warn", console, flags=re.IGNORECASE), console
    assert (found["too_wide"], found["options"]) == (0, 2)
    assert "measured" in str(found["legend"])


def test_one_row_of_a_table_is_drawn(tmp_path: Path) -> None:
    made = make(tmp_path, {"one": Fall(samples=1)})
    found, console = browsed(show_page(collect(recognise([made.states]))), 400, tmp_path)
    assert not re.search(r"error|uncaught|exception|warn", console, flags=re.IGNORECASE), console
    assert (found["too_wide"], found["options"]) == (0, 1)


def test_a_diagnosis_alone_is_drawn(report: Path, tmp_path: Path) -> None:
    found, console = browsed(show_page(collect(recognise([report]))), 400, tmp_path)
    assert not re.search(r"error|uncaught|exception|warn", console, flags=re.IGNORECASE), console
    assert (found["traces"], found["spaces"]) == (2, 0)
