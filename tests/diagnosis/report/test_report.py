"""The report of a diagnosis: strict JSON with the agreed keys, a page that stands alone, a model; all or none."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from ballfg.diagnosis.budget import PARTS
from ballfg.diagnosis.report import report
from ballfg.diagnosis.report.headline import Origin, headline
from ballfg.diagnosis.report.page import page
from ballfg.diagnosis.report.report import content, write_report
from ballfg.diagnosis.result import Diagnosis, Errors, Fallback
from ballfg.dynamics import Architecture, build, load_model, nominal_model
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.model_file import model_to_dict
from ballfg.dynamics.networks.learned import LearnedModel
from tests.diagnosis.made_diagnosis import found, silent, unexplained
from tests.html_page import HtmlPage


@pytest.fixture(scope="module")
def found_page() -> HtmlPage:
    return HtmlPage(page(found()))


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page of one sentence, for tests that are about files."""
    monkeypatch.setattr(report, "page", lambda diagnosis, origin: f"<html>{diagnosis.sentence}</html>")


def refuse(word: str) -> None:
    raise AssertionError(f"{word} is not JSON")


def test_json_has_the_agreed_keys_and_numbers() -> None:
    diagnosis = found()
    text = json.dumps(content(diagnosis), allow_nan=False)
    read = json.loads(text, parse_constant=refuse)
    assert read["verdict"] == "effect found"
    (effect,) = read["effects"]
    assert effect["name"] == "wind"
    assert effect["kind"] == "flight"
    assert effect["parameters"]["x"] == {"value": 0.2, "sigma": 0.012, "unit": "m/s"}
    assert (effect["p_value"], effect["delta_bic"]) == (3e-131, -598.3)
    assert effect["indistinguishable_from"] == ["gust_region"]
    before = read["error"]["before"]
    assert before["prediction_rmse_mm"] == diagnosis.before.prediction_rmse_mm
    assert before["apex_rmse_mm"] == diagnosis.before.apex_rmse_mm
    assert (before["nis"], before["log_likelihood"]) == (diagnosis.before.nis, diagnosis.before.log_likelihood)
    assert (before["intervals_held"], before["nis_median"]) == (0.87, 2.6)
    assert before["by_track_mm"] == diagnosis.before.by_track.tolist()
    assert read["error"]["after"]["apex_rmse_mm"] is None
    assert read["error"]["tracks_judged_on"] == 25
    squares = [read["budget"][name] * abs(read["budget"][name]) for name in PARTS]
    assert sum(squares) == pytest.approx(before["prediction_rmse_mm"] ** 2, rel=1e-12)
    assert read["budget"]["measured"] == pytest.approx(read["error"]["after"]["prediction_rmse_mm"], rel=1e-12)
    assert (read["budget"]["floor"], read["budget"]["tracks"]) == (pytest.approx(9.0), 24)
    assert content(silent())["budget"] is None
    assert read["unexplained"]["where"] == ""
    assert read["unexplained"]["share_of_residual"] == 0.02
    assert read["calibrated"]["flight.drag.k"] == {"value": 0.1213, "sigma": 0.0011, "unit": "1/m", "declared": 0.12}
    assert [row["standing"] for row in read["rounds"][0][:2]] == ["added", "cannot be told from the one added"]
    assert read["rounds"][0][3]["delta_bic"] is None


def test_json_of_a_fallback() -> None:
    read = content(unexplained())
    assert read["verdict"] == "unexplained"
    fallback = read["unexplained"]["fallback"]
    assert fallback["kind"] == "sparse terms"
    made = unexplained().unexplained.fallback
    assert fallback["error"]["after"]["prediction_rmse_mm"] == made.after.prediction_rmse_mm


def test_the_page_stands_alone_and_is_whole(found_page: HtmlPage) -> None:
    assert len(found_page.addresses) == 9
    assert all(address.startswith("data:image/png;base64,") for address in found_page.addresses)


def test_the_page_says_what_was_found(found_page: HtmlPage) -> None:
    assert found_page.headings[0] == headline(found())
    for words in (
        "shots <in a draught>",
        "0.200 ± 0.012 m/s",
        "falls by 598",
        "adds 5.8 of log likelihood per track; probability of that by chance: 2·10−7.",
        "all candidates counted: less than 10−99.",
        "Cannot be told from gust_region.",
        "These data cannot tell a wind and a wind in one part of the room apart. What would decide it:",
        "a wind: Shoot in the opposite direction, or across",
        "fitted to 25 tracks, and with that strength it had to help on the other 25",
        "flight.drag.k 0.12 1/m 0.1213 ± 0.0011 1/m",
        "shot 7 has no free flight of 10 samples.",
        "error of the apex 12.1 mm – nothing to compare small",
    ):
        spaced = re.sub(r"\s+", "", words)
        assert spaced in found_page.text.replace(" ", ""), words
    shown = found_page.text[found_page.text.index("What these data cannot show") :]
    assert (
        shown.index("spin labels wrong by a factor")
        < shown.index("a wind that grows with height")
        < shown.index("Coefficients and noise")
    )


def test_the_page_shows_the_parts_of_the_error(found_page: HtmlPage) -> None:
    budget = found().budget
    assert budget is not None
    assert budget.sentence in found_page.text
    for name, words in PARTS.items():
        assert f"{words}{getattr(budget, name):.2f}".replace("-", "−") in found_page.text
    assert "What the error consists of" not in HtmlPage(page(silent())).text


@pytest.mark.usefixtures("blank_pictures")
def test_pages_without_a_finding() -> None:
    quiet = HtmlPage(page(silent()))
    assert quiet.headings[:3] == [headline(silent()), "What to do next", "How well the model predicts"]
    assert "→" not in quiet.text
    assert "No pattern is left" in quiet.text
    assert len(quiet.addresses) == 6  # no errors side by side, no contacts, no second round
    assert not any("contact" in caption for caption in quiet.captions)
    left = HtmlPage(page(unexplained()))
    assert "What is left unexplained" in left.headings
    assert "That is 80 % of the pattern that was there at the start." in left.text
    assert "20.1 mm without, 11.8 mm with it" in left.text


@pytest.mark.usefixtures("blank_pictures")
def test_the_three_files_appear_and_the_model_can_be_read(tmp_path: Path) -> None:
    out = tmp_path / "diagnosis"
    write_report(silent(), out)
    assert sorted(path.name for path in out.iterdir()) == ["model.yaml", "report.html", "report.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["diagnosis"]
    model = load_model(out / "model.yaml")
    assert isinstance(model, AnalyticModel)
    assert model_to_dict(model) == model_to_dict(nominal_model())
    assert json.loads((out / "report.json").read_text(encoding="utf-8"))["verdict"] == "nothing lacking"
    assert HtmlPage((out / "report.html").read_text(encoding="utf-8")).headings[0] == headline(silent())


@pytest.mark.usefixtures("no_page")
def test_an_earlier_report_is_replaced_and_other_files_stay(tmp_path: Path) -> None:
    out = tmp_path / "diagnosis"
    write_report(with_learned_fallback(), out)
    learned = [path.name for path in out.glob("model.learned-*")]
    assert len(learned) == 1
    assert isinstance(load_model(out / "model.yaml"), LearnedModel)
    (out / "notes.txt").write_text("mine")
    write_report(with_learned_fallback(), out)
    assert [path.name for path in out.glob("model.learned-*")] == learned
    (out / "best.yaml").write_bytes((out / "model.yaml").read_bytes())
    write_report(silent(), out)
    others = ["best.yaml", "model.yaml", "notes.txt", "report.html", "report.json"]
    assert sorted(p.name for p in out.iterdir()) == sorted([*others, *learned])
    assert isinstance(load_model(out / "best.yaml"), LearnedModel)
    assert silent().sentence in (out / "report.html").read_text(encoding="utf-8")
    assert [path.name for path in tmp_path.iterdir()] == ["diagnosis"]


def with_learned_fallback() -> Diagnosis:
    small = Architecture(kind="mnn+gs", width_flight=4, width_contact=4, depth=1, residual=True)
    learned = build(small, radius=0.02, base=nominal_model())
    left = unexplained().unexplained
    assert isinstance(left.fallback, Fallback)
    fallback = replace(left.fallback, kind="learned residual", model=learned)
    return replace(unexplained(), model=learned, unexplained=replace(left, fallback=fallback))


EARLIER = '{"program": "ballfg diagnose", "files": ["report.json"]}'


@pytest.mark.parametrize("there", [False, True])
def test_a_failure_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: bool) -> None:
    out = tmp_path / "diagnosis"

    def fail(diagnosis: Diagnosis, origin: Origin | None) -> str:
        raise KeyboardInterrupt

    if there:
        out.mkdir()
        (out / "report.json").write_text(EARLIER)
    monkeypatch.setattr(report, "page", fail)
    with pytest.raises(KeyboardInterrupt):
        write_report(silent(), out)
    left = {str(path.relative_to(tmp_path)): path.read_text() for path in tmp_path.rglob("*") if path.is_file()}
    assert left == ({"diagnosis/report.json": EARLIER} if there else {})


@pytest.mark.usefixtures("no_page")
def test_folders_that_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "model.yaml").write_text("mine")
    with pytest.raises(ValueError, match=r"out must be a folder; .*file is a file"):
        write_report(silent(), tmp_path / "file")
    with pytest.raises(ValueError, match=r"out must be new, empty or hold an earlier report; .*work holds other files"):
        write_report(silent(), tmp_path / "work")
    with pytest.raises(FileNotFoundError, match=r"out must be in an existing folder; .*nowhere is none"):
        write_report(silent(), tmp_path / "nowhere" / "diagnosis")
    assert (tmp_path / "work" / "model.yaml").read_text() == "mine"


@pytest.mark.usefixtures("no_page")
def test_files_of_other_programs_are_not_replaced(tmp_path: Path) -> None:
    run = tmp_path / "calibration"  # a calibration writes a report.json and a model.yaml too
    run.mkdir()
    (run / "report.json").write_text('{"verdict": "better"}')
    (run / "model.yaml").write_text("calibrated")
    with pytest.raises(ValueError, match=r"hold an earlier report; .*calibration holds other files"):
        write_report(silent(), run)
    assert (run / "model.yaml").read_text() == "calibrated"
    out = tmp_path / "diagnosis"
    write_report(silent(), out)
    (out / "model.level.yaml").write_text("mine")
    with pytest.raises(ValueError, match=r"model\.level\.yaml is none of the earlier report\. Move it away"):
        write_report(silent(), out, {"level": nominal_model()})
    write_report(silent(), out)
    assert (out / "model.level.yaml").read_text() == "mine"


@pytest.mark.usefixtures("no_page")
def test_the_same_diagnosis_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        write_report(found(), tmp_path / name)
    for name in ("report.json", "model.yaml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_infinite_numbers_become_null() -> None:
    errors = Errors(1.0, math.inf, math.nan, -math.inf, found().before.by_track)
    read = content(replace(found(), after=errors))["error"]["after"]
    assert [read[k] for k in ("prediction_rmse_mm", "apex_rmse_mm", "nis", "log_likelihood")] == [1.0, None, None, None]
