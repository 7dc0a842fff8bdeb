"""The page as a file: its data, its size, hostile names, and nothing that is loaded from elsewhere."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ballfg.pages.given import recognise
from ballfg.pages.show_page import show_page
from ballfg.pages.shown import collect
from tests.pages.made import Fall, Made, make, write


def data_of(page: str) -> dict[str, Any]:
    """What the page's script reads; NaN and infinity are no JSON."""
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, flags=re.DOTALL)

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} in the data")

    content = json.loads(text, parse_constant=refuse)
    assert isinstance(content, dict)
    return content


def own_part(page: str) -> str:
    """The page without plotly.js."""
    parts = re.split(r"(?s)<script>/\*\*?\n\* plotly\.js.*?</script>", page)
    assert len(parts) == 2, "plotly.js must be in the page once"
    return "".join(parts)


def test_the_data_are_those_of_the_files(made: Made, report: Path) -> None:
    page = show_page(collect(recognise([made.dataset, made.states, made.predictions, report])))
    data = data_of(page)
    assert [shot["name"] for shot in data["shots"]] == list(made.falls)
    for shot, fall in zip(data["shots"], made.falls.values(), strict=True):
        np.testing.assert_allclose(np.array(shot["states"]).T[:, :3], fall.states()[:, :3], atol=6e-6)
        np.testing.assert_allclose(shot["t"], fall.times, atol=1e-6)
        assert [mark["kind"] for mark in shot["marks"]] == ["contact"]
    assert data["table"]["net"][0] == pytest.approx([1.37, -0.7625 - 0.1525, 0.76])
    assert data["diagnosis"]["after"] is not None
    assert "The model lacks wind" in page


def test_no_number_has_more_digits_than_trackers_resolve(made: Made) -> None:
    """Ten micrometres and microseconds of the shots, a micrometre of standard deviations: pages stay small."""
    data = data_of(show_page(collect(recognise([made.dataset, made.states, made.predictions]))))
    shots = [{key: columns for key, columns in shot.items() if key != "marks"} for shot in data["shots"]]
    numbers = re.findall(r"\d\.(\d+)", json.dumps([shots, data["coverage"]]))
    assert len(numbers) > 1000
    assert max(map(len, numbers)) <= 6


def test_nothing_is_loaded_and_plotly_is_there_once(made: Made) -> None:
    page = own_part(show_page(collect(recognise([made.dataset]))))
    assert not re.search(r"(src|href)\s*=|https?://|@import|url\(|fetch\(|XMLHttpRequest", page)


def test_hostile_names_are_text(made: Made) -> None:
    page = own_part(show_page(collect(recognise([made.dataset, made.states]))))
    assert "<script>alert" not in page
    assert "<option>&lt;script&gt;alert(1)&lt;/script&gt;</option>" in page
    assert "made &lt;shots&gt; &amp; more" in page


def test_few_samples_and_infinite_sigmas(tmp_path: Path) -> None:
    made = make(tmp_path, {"long": Fall(), "one ahead": Fall(samples=27), "short": Fall(samples=2)}, extent=False)
    head, *rows = (line.split(",") for line in made.predictions.read_text().splitlines())
    write(made.predictions, head, [[*row[:5], "inf", *row[6:]] for row in rows])
    shown = collect(recognise([made.dataset, made.states, made.predictions]))
    data = data_of(show_page(shown))
    assert [len(shot["predicted_t"]) for shot in data["shots"]] == [34, 1, 0]
    assert set(data["shots"][0]["predicted_sigmas"][0]) == {None}
    x0, x1, y0, y1 = data["table"]["extent"]
    assert (x1 - x0, y1 - y0, data["table"]["net"]) == (pytest.approx(2.74), pytest.approx(1.525), None)
    assert any("does not state where the table's ends are" in note for note in shown.notes)


def test_a_diagnosis_alone(report: Path) -> None:
    page = show_page(collect(recognise([report])))
    assert data_of(page)["shots"] == []
    assert 'id="space"' not in own_part(page)


def test_a_page_of_forty_shots_is_small(tmp_path: Path) -> None:
    made = make(tmp_path, {f"{i:03}": Fall(samples=120) for i in range(45)})
    page = show_page(collect(recognise([made.dataset, made.states, made.predictions])))
    assert len(page.encode()) < 8e6
    assert "40 of 45 shots (--track chooses others)" in page


def test_same_data_same_bytes(made: Made) -> None:
    paths = [made.dataset, made.states, made.predictions]
    assert show_page(collect(recognise(paths))) == show_page(collect(recognise(paths)))
