"""The first lines of a report, its words and its pictures, against planted cases."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from ballfg.diagnosis.remains.label_check import LabelCheck
from ballfg.diagnosis.report.glossary import OUTCOMES, TERMS
from ballfg.diagnosis.report.headline import advice, certainty, further, headline, where
from ballfg.diagnosis.report.origin import Origin
from ballfg.diagnosis.report.page import page
from ballfg.diagnosis.report.plain_effects import PLAIN, in_plain_words, plain_name
from ballfg.diagnosis.report.shots import distances, error_map, median_shot
from ballfg.diagnosis.result import Diagnosis, GenericTest, Outcome, Unexplained, Value, Verdict
from ballfg.dynamics import EFFECTS
from ballfg.estimation.noise.tracker import NUMBERS
from tests.diagnosis.made_diagnosis import found, silent, unexplained
from tests.html_page import HtmlPage

ORIGIN = Origin("ballfg diagnose 'my shots' --out out", ("my shots",), "", "out")
WIND = replace(found().findings[0], indistinguishable_from=())
OWN = replace(WIND, name="tide", sentence="The sea pulls. It has two.", parameters={"a": Value(0.2, 0.01, "m")})


def with_wind(**components: float) -> Diagnosis:
    """The diagnosis of a wind that nothing else explains."""
    values = {axis: Value(value, 0.01, "m/s") for axis, value in components.items()}
    return replace(found(), findings=(replace(WIND, parameters=values),))


def test_a_wind_is_named_with_its_strength_and_direction() -> None:
    before, after = found().before.prediction_rmse_mm, found().after.prediction_rmse_mm
    gain = f"With it, predictions are off by {after:.1f} instead of {before:.1f} mm."
    assert headline(with_wind(x=0.31, y=0.004, z=0.0)) == f"The air moves at 0.31 m/s along x. {gain}"
    assert headline(with_wind(x=0.0, y=-2.0, z=0.1)).startswith("The air moves at 2 m/s along -y.")
    assert headline(with_wind(x=0.3, y=0.4, z=0.0)).startswith("The air moves at 0.5 m/s with x 0.3, y 0.4, z 0.")


def test_what_cannot_be_told_apart_is_said_with_the_experiment_that_decides() -> None:
    assert "It may also be a wind in one part of the room: these tracks cannot tell." in headline(found())
    steps = list(advice(found(), ORIGIN))
    assert steps[0][0] == "Estimate the states with the corrected model:"
    assert steps[0][1] == "ballfg estimate 'my shots' --model out/model.yaml --out states.csv"
    said = [words for words, command in steps if not command]
    assert said[0] == f"To find out whether it is a wind: {WIND.decide}"
    assert said[1] == f"To find out whether it is a wind in one part of the room: {EFFECTS['gust_region'].decide}"


def test_nothing_found_says_so_and_what_that_rests_on() -> None:
    said = headline(silent())
    assert said.startswith("Nothing that the model lacks was found: its predictions are off by ")
    assert f"{silent().after.prediction_rmse_mm:.1f} mm" in said
    sure = list(certainty(silent()))
    tested = sum(c.outcome is not Outcome.INVISIBLE for c in silent().rounds[-1])
    assert sure[0].startswith(f"{tested} effects were tested, one by one, and none of them stands out from chance.")
    assert len(sure) == 1
    hidden = tuple(replace(c, outcome=Outcome.INVISIBLE) if i < 2 else c for i, c in enumerate(silent().rounds[-1]))
    sure = list(certainty(replace(silent(), rounds=(hidden,))))
    assert sure[0].startswith(f"{tested - 2} effects")
    assert sure[1] == "These tracks say nothing about 2 more effects, which may be there or not."
    assert [c for _, c in advice(silent(), replace(ORIGIN, model="m.yaml"))][1] == (
        "ballfg diagnose 'my shots' --model m.yaml --out out_again"
    )


def test_several_effects_are_counted_and_listed() -> None:
    jitter = replace(WIND, name="stamp_jitter", parameters={"sigma": Value(0.00042, 1e-5, "s")})
    by_group = replace(
        WIND, name="drag_by_group", parameters={"k[top]": Value(0.1, 0.01, "1/m"), "k[back]": Value(0.2, 0.01, "1/m")}
    )
    left = Unexplained("flight: acceleration is off everywhere", 0.4, (GenericTest("flight", "", 1e-9, 0.4),), None)
    many = replace(found(), verdict=Verdict.UNEXPLAINED, findings=(WIND, by_group, jitter), unexplained=left)
    assert headline(many).startswith("Two effects are missing from the model. With them, predictions are off by ")
    assert list(further(many)) == [
        "The air moves at 0.2 m/s along x.",
        "Air drag differs between groups of tracks: top 0.100 ± 0.010 1/m, back 0.200 ± 0.010 1/m.",
        "Not an effect on the ball but noise of the measurements: the time stamps jitter by 0.42 ms from sample to "
        "sample.",
        "Something else is missing too, which no known effect explains: in flight, acceleration is off everywhere.",
    ]
    assert next(certainty(many)).startswith("A wind: practically certain. Chance makes a trace so strong with prob")
    weaker = replace(many, findings=(replace(WIND, held_out_p=1e-4),))
    assert next(certainty(weaker)).startswith("A wind: very likely. ")
    assert headline(replace(many, findings=(jitter,), verdict=Verdict.FOUND)).startswith("Nothing that the model lacks")


def test_a_pattern_without_a_name() -> None:
    said = headline(replace(unexplained(), unexplained=replace(unexplained().unexplained, where="time: drifts")))
    assert said.startswith(
        "Something is missing from the model that no known effect explains: from sample to sample, drifts."
    )
    assert where("In flight: something") == "in flight: something"


def test_every_effect_of_the_catalogue_has_plain_words_with_its_numbers() -> None:
    own = {name: effect for name, effect in EFFECTS.items() if effect.__module__.startswith("ballfg.")}
    assert set(own) | set(NUMBERS) == set(PLAIN)
    names = [plain.name for plain in PLAIN.values()]
    assert len(set(names)) == len(names)
    for name, effect in own.items():
        values = {c.name: Value(0.0123, 0.001, c.unit) for c in effect.coefficients}
        for sign in (1.0, -1.0):
            signed = {n: replace(v, value=sign * v.value) for n, v in values.items()}
            said = in_plain_words(replace(WIND, name=name, parameters=signed))
            assert said.endswith("."), said
            assert not re.search(r"\bnan\b|\(\)|_", said), said


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("table_height", {"offset": -0.004}, "The table is 4 mm lower than the dataset says."),
        ("table_tilt", {"x": 0.0, "y": math.radians(0.5)}, "The table is not level: it leans by 0.5°."),
        ("time_offset", {"x": 0.002, "y": -0.001, "z": 0.0}, "different moments, up to 3 ms apart."),
        ("velocity_lag", {"lag": 0.005}, "Positions are reported 5 ms too late."),
        ("spin_decay", {"rate": math.log(2.0)}, "by 50 % in one second."),
        ("scale", {"x": 0.02, "y": 0.001}, "Measured lengths are 2 % too long along x."),
        ("restitution_speed", {"slope": 0.02}, "Faster impacts bounce less: "),
    ],
)
def test_sizes_and_signs_of_effects(name: str, values: dict[str, float], said: str) -> None:
    made = {n: Value(v, 0.001, "1") for n, v in values.items()}
    assert said in in_plain_words(replace(WIND, name=name, parameters=made))


def test_an_effect_of_a_user_is_said_in_its_own_words() -> None:
    assert plain_name("moon_pull") == "moon pull"
    assert in_plain_words(OWN) == "The sea pulls (a 0.200 ± 0.010 m)."
    assert in_plain_words(replace(OWN, parameters={})) == "The sea pulls."


@pytest.mark.usefixtures("blank_pictures")
@pytest.mark.parametrize("made", [found, silent, unexplained])
def test_a_page_has_no_nan_no_empty_parentheses_and_explains_its_terms(made) -> None:
    read = HtmlPage(page(made(), ORIGIN))
    words = " ".join(read.words)
    assert not re.search(r"\bnan\b|\(\s*\)", words)
    assert "made on" in words
    assert "ballfg " in words[words.index("Where this report comes from") :]
    listed = words[words.index("What the words mean") :]
    assert all(name in listed for name in TERMS)
    assert set(OUTCOMES) == set(Outcome)
    for word in ("NIS", "log likelihood", "prediction error"):
        assert read.explained[word] == TERMS[word]
    if made is found:
        assert read.explained["added"] == OUTCOMES[Outcome.ADDED]


@pytest.mark.usefixtures("blank_pictures")
def test_tests_without_a_finding_show_no_share() -> None:
    quiet = Unexplained("", 0.0, (GenericTest("label", "nothing", 0.9, 1.0),), None)
    text = page(replace(found(), unexplained=quiet))
    shown = text[text.index("What is left unexplained") : text.index("What the model leaves")]
    assert "Tests that find nothing beyond noise: label." in shown
    assert "%" not in shown


def test_labels_that_all_fit_are_no_contradiction() -> None:
    assert LabelCheck(0.8, (), 100, float("nan")).where == "label: none of 100 spin labels contradicts its flight"
    assert "1 of 9 spin labels contradict" in LabelCheck(1e-9, ("a",), 9, 120.0).where


def test_the_shot_shown_is_the_one_with_the_median_gain() -> None:
    before, after = found().before, found().after
    shot = median_shot(before, after, True)
    assert shot is not None
    assert shot.before.name == shot.after.name
    gains = np.sort(before.by_track - after.by_track)
    assert shot.errors[0] - shot.errors[1] == pytest.approx(gains[12])
    alone = median_shot(before, before, False)
    assert alone is not None
    assert 1e3 * distances(alone.after).max() == pytest.approx(np.median(before.by_track))
    assert median_shot(replace(before, paths=()), after, True) is None


def test_the_map_holds_the_mean_square_of_each_cell() -> None:
    after = found().after
    axes = error_map(after, after, False).axes[0]
    shown = {text.get_text() for text in axes.texts}
    places = np.concatenate([path.measured[:, :2] for path in after.paths])
    squares = np.concatenate([distances(path) ** 2 for path in after.paths])
    low, high = np.quantile(places, 0.01, axis=0) - 1e-6, np.quantile(places, 0.99, axis=0) + 1e-6
    edges = [np.linspace(low[0], high[0], 7), np.linspace(low[1], high[1], 5)]
    count = np.histogram2d(*places.T, bins=edges)[0]
    total = np.histogram2d(*places.T, bins=edges, weights=squares)[0]
    seen = count >= 5
    assert seen.sum() == len(axes.texts)
    assert shown == {f"{1e3 * np.sqrt(value):.0f}" for value in total[seen] / count[seen]}


@pytest.mark.usefixtures("blank_pictures")
def test_the_date_of_a_page_can_be_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert "1970-01-02 00:00 UTC" in page(found())
    assert page(found()) == page(found())
