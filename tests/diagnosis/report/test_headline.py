"""The first lines of a report, its words and its pictures, against planted cases."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from ballfg.diagnosis.generic_test import GenericTest, LabelCheck, LabelVerdict
from ballfg.diagnosis.report.headline import Origin, advice, answer, certainty, further, headline, where
from ballfg.diagnosis.report.page import page
from ballfg.diagnosis.report.pictures import beyond_histogram
from ballfg.diagnosis.report.predictions import distances, error_map, meaning, median_shot
from ballfg.diagnosis.report.report import content
from ballfg.diagnosis.report.wording import OF_A_TRACKER, OUTCOMES, TERMS, in_plain_words, plain_name
from ballfg.diagnosis.residual_tests.label_check import label_test
from ballfg.diagnosis.result import Diagnosis, Outcome, Unexplained, Value, Verdict
from ballfg.dynamics import EFFECTS
from ballfg.estimation.noise.tracker_errors import NUMBERS
from tests.diagnosis.made_diagnosis import found, residuals, rounds, silent, unexplained
from tests.html_page import HtmlPage

ORIGIN = Origin("ballfg diagnose 'my shots' --out out", ("my shots",), "", "out")
WIND = replace(found().findings[0], indistinguishable_from=())
WRONG_LABEL = LabelVerdict("a", 0.975, 120.0, 17.0)
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


def test_of_many_effects_that_cannot_be_told_apart_the_first_three_are_listed():
    others = ("gust_region", "frame_tilt", "gravity", "scale", "time_scale")
    many = replace(found(), findings=(replace(WIND, indistinguishable_from=others),))
    assert "one part of the room or axes that are not level or the ball's weight or one of 2 others:" in headline(many)
    hints = [words for words, command in advice(many, ORIGIN) if words.startswith("To find out")]
    assert [words.partition(": ")[0].rpartition(" it is ")[2] for words in hints] == [
        "a wind", "a wind in one part of the room", "axes that are not level", "the ball's weight",
    ]  # fmt: skip


def test_one_track_that_misses_the_table_does_not_speak_for_all():
    errors = np.append(np.full(19, 5.0), 2000.0)
    off = replace(silent().after, by_track=errors, prediction_rmse_mm=float(np.sqrt((errors**2).mean())))
    assert "half of the tracks are predicted to 5.0 mm or better" in headline(replace(silent(), after=off, before=off))


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
    one = tuple(replace(c, outcome=Outcome.INVISIBLE) if i < 1 else c for i, c in enumerate(silent().rounds[-1]))
    assert "nothing about 1 more effect, which" in list(certainty(replace(silent(), rounds=(one,))))[-1]
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
    assert headline(many).endswith(" mm. Something else is missing too.")
    assert list(further(many)) == [
        "The air moves at 0.2 m/s along x.",
        "Air drag differs between groups of tracks: top 0.100 ± 0.010 1/m, back 0.200 ± 0.010 1/m.",
        "Not an effect on the ball but noise of the measurements: the time stamps jitter by 0.42 ms from sample to "
        "sample.",
        "What else is missing no known effect explains: in flight, acceleration is off everywhere.",
    ]
    assert next(certainty(many)).startswith("A wind: practically certain. Chance makes a trace so strong with prob")
    weaker = replace(many, findings=(replace(WIND, held_out_p=1e-4),))
    assert next(certainty(weaker)).startswith("A wind: very likely. ")
    assert headline(replace(many, findings=(jitter,), verdict=Verdict.FOUND)).startswith("No effect on the ball")
    described = replace(many, unexplained=replace(left, fallback=unexplained().unexplained.fallback))
    alone = unexplained().unexplained.fallback.before.prediction_rmse_mm
    assert "With them and a description of the rest that names no cause, predictions are off by" in headline(described)
    assert f" mm. With them alone, by {alone:.1f} mm. Something else is missing too." in headline(described)


def test_a_pattern_without_a_name() -> None:
    said = headline(replace(unexplained(), unexplained=replace(unexplained().unexplained, where="time: drifts")))
    assert said.startswith(
        "Something is missing from the model that no known effect explains: from sample to sample, drifts."
    )
    assert where("In flight: something") == "in flight: something"


@pytest.mark.parametrize(
    ("p_value", "word"), [(1e-8, "practically certain"), (1e-4, "very likely"), (0.02, "likely"), (0.2, "possible")]
)
def test_how_sure_it_is_that_something_is_left(p_value: float, word: str) -> None:
    left = unexplained().unexplained
    assert left.tests
    tests = tuple(replace(test, p_value=p_value) for test in left.tests)
    said = list(certainty(replace(unexplained(), unexplained=replace(left, tests=tests))))
    assert any(line.startswith(f"That something is left: {word}. ") for line in said)


def test_every_effect_of_the_catalogue_has_plain_words_with_its_numbers() -> None:
    own = {name: effect for name, effect in EFFECTS.items() if effect.__module__.startswith("ballfg.")}
    assert set(NUMBERS) == set(OF_A_TRACKER)
    names = [plain_name(name) for name in (*own, *OF_A_TRACKER)]
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
    right = tuple(LabelVerdict(f"{i}", 0.01, 20.0, 15.0) for i in range(8))
    assert LabelCheck(0.8, right).where.startswith("label: none of 8 spin labels contradicts its flight")
    assert "1 of 9 spin labels contradict" in LabelCheck(1e-9, (WRONG_LABEL, *right)).where


@pytest.mark.usefixtures("blank_pictures")
def test_wrong_labels_are_told_with_their_probability() -> None:
    check = LabelCheck(2e-7, (WRONG_LABEL, LabelVerdict("b", 0.4, 50.0, 20.0)))
    tests = (label_test(check), GenericTest("time", "time: samples err alike", 0.4, 1.0))
    left = Unexplained(check.where, 1.0, tests, None)
    made = replace(unexplained(), unexplained=left, labels=check)
    assert "each of these is wrong with a probability of at least 97 %" in headline(made)
    sure = list(certainty(made))
    assert "That some spin labels are wrong: practically certain. All of them are right with probability 2e-7." in sure
    assert not any("something is left" in line for line in sure)
    shown = page(made)
    assert "the label is wrong" in shown
    assert "<td>120 rad/s</td><td>17 rad/s</td><td>97 %</td>" in shown
    assert "<td>50 rad/s</td>" not in shown
    in_file = content(made)["labels"]
    assert in_file["contradicted"] == ["a"]
    assert in_file["p_all_right"] == 2e-7
    assert in_file["verdicts"][1] == {"track": "b", "probability": 0.4, "off": 50.0, "sigma": 20.0}
    assert content(unexplained())["labels"] is None


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
    text = page(found())
    assert "1970-01-02 00:00 UTC" in text
    assert page(found()) == text


@pytest.mark.parametrize(
    ("nis", "error", "said"),
    [
        (0.64, 0.05, "is below 1: predictions are better than they claim. The noise behind them is stated too large; "
         "their standard deviations are 25 % larger than the errors. 90 % intervals hold 87.0 % of the measured"),
        (4.0, 0.5, "is above 1: predictions are worse than they claim. The noise behind them is stated too small; "
         "their standard deviations are 50 % smaller than the errors."),
        (0.81, 0.12, "A NIS of 0.81 ± 0.12 differs from 1 by no more than chance"),
        (1.3, math.nan, "A NIS of 1.30 is above 1"),
    ],
)  # fmt: skip
def test_a_nis_is_said_in_words(nis: float, error: float, said: str) -> None:
    errors = replace(found().after, nis=nis, nis_error=error)
    assert said in meaning(replace(found(), after=errors))[0]


@pytest.mark.usefixtures("blank_pictures")
@pytest.mark.usefixtures("blank_pictures")
def test_an_error_stands_beside_its_floor() -> None:
    error = found().after.prediction_rmse_mm
    far = HtmlPage(page(replace(found(), floor_mm=error / 2.0)))
    assert f"near {error / 2.0:.1f} mm" in far.text
    assert f"The error is {error:.1f} mm, so that predictions are 2.0 times as far off as they could be." in far.text
    assert far.explained["floor"] == TERMS["floor"]
    near = HtmlPage(page(replace(silent(), floor_mm=silent().after.prediction_rmse_mm / 1.1)))
    assert "so that a better model would gain little" in near.text
    assert "a better model" not in HtmlPage(page(silent())).text


def with_sizes(made: Diagnosis) -> Diagnosis:
    """The last round with the sizes that it would have noticed."""
    last = (
        replace(rounds()[0][0], outcome=Outcome.NOT_NEEDED, seen_from={"x": 0.052, "y": 0.11, "z": 0.03}),
        replace(rounds()[0][3], outcome=Outcome.NOT_NEEDED, seen_from={"share": 0.0011}),
        replace(rounds()[0][4], outcome=Outcome.NOT_NEEDED, seen_from={"x": math.inf}),
        replace(rounds()[0][5], outcome=Outcome.WEAKER, seen_from={"slope": 0.2}),
        replace(rounds()[0][0], name="wind_drift", outcome=Outcome.NOT_NEEDED, seen_from={"x": 0.2}),
    )
    return replace(made, rounds=(last,))


@pytest.mark.usefixtures("blank_pictures")
def test_a_silence_says_how_small_an_effect_it_would_have_noticed() -> None:
    sure = list(certainty(with_sizes(silent())))
    assert sure[1] == (
        "These would have been noticed in 9 of 10 recordings like this one, from such a size on: a wind (0.11 m/s "
        "along any axis) and a clock that runs wrong (0.11 %)."
    )
    shown = HtmlPage(page(with_sizes(silent()))).text
    listed = shown[shown.index("How small an effect would have been noticed") :]
    listed = listed[: listed.index("Coefficients and noise")]
    assert "A wind windx 0.052 m/s, y 0.11 m/s, z 0.03 m/s" in listed
    assert "time_scaleshare 0.0011" in listed
    assert "frame_tilt" not in listed
    assert "magnus_saturation" not in listed
    assert "wind_drift" not in listed
    assert "How small an effect" not in page(with_sizes(unexplained()))


def test_of_several_datasets_each_gets_its_own_model_and_file() -> None:
    both = Origin("", ("a b", "c/d"), "m.yaml", "out", ("model.hall_A.yaml", "model.B.yaml"))
    (_, estimate), (_, predict), *_ = advice(with_wind(x=0.3), both)
    assert estimate.splitlines() == [
        "ballfg estimate 'a b' --model out/model.hall_A.yaml --out states.hall_A.csv",
        "ballfg estimate c/d --model out/model.B.yaml --out states.B.csv",
    ]
    assert [line.split()[-1] for line in predict.splitlines()] == ["predictions.hall_A.csv", "predictions.B.csv"]
    *_, (words, again) = advice(unexplained(), both)
    assert again == "ballfg diagnose 'a b' c/d --model m.yaml --effects-file my_effects.py --out out_again"
    assert "record tracks in which it varies more" in words
    left = replace(
        unexplained().unexplained, where="flight: acceleration vertically is off everywhere, up to 0.7 m/s^2"
    )
    *_, (words, _) = advice(replace(unexplained(), unexplained=left), both)
    assert "record tracks at other speeds, spins and places than these" in words
    left = replace(left, where="label: 9 of 60 spin labels contradict their flights")
    *_, (words, _) = advice(replace(unexplained(), unexplained=left), both)
    assert "check the axes and the unit of the labels" in words


def test_noise_alone_is_no_effect() -> None:
    jitter = replace(WIND, name="stamp_jitter", parameters={"sigma": Value(0.00042, 1e-5, "s")})
    assert answer(replace(found(), findings=(jitter,))) == "noise found"
    assert answer(replace(found(), findings=(WIND, jitter))) == "effect found"
    assert answer(silent()) == "nothing lacking"


@pytest.mark.usefixtures("blank_pictures")
def test_a_test_that_found_a_pattern_is_not_called_silent() -> None:
    tests = (GenericTest("flight", "flight: off", 1e-9, 0.5), GenericTest("flight", "", 0.8, 0.0))
    left = Unexplained("flight: off", 0.5, (*tests, GenericTest("contact", "", 0.7, 0.0)), None)
    assert "Tests that find nothing beyond noise: contact." in page(replace(unexplained(), unexplained=left))


@pytest.mark.usefixtures("blank_pictures")
def test_position_noise_is_told_in_mm() -> None:
    assert "x3 mm3.10 ± 0.02 mm" in "".join(HtmlPage(page(found())).words).replace("3.100 ± 0.020", "3.10 ± 0.02")


def test_the_caption_of_the_histogram_counts_what_it_leaves_out() -> None:
    left, right = residuals(0.0, 4), residuals(0.0, 5)
    left.measurement.position[:7, 1] = 30.0
    size = left.measurement.position.size
    alone = beyond_histogram({"the fitted model": left})
    assert alone == f"The axis ends at ±6: 7 of {size} residuals lie beyond it and are not shown."
    both = beyond_histogram({"before": left, "after": right})
    assert f"7 of {size} residuals before and 0 of {size} residuals after lie beyond" in both


def test_a_gain_that_a_few_tracks_make_is_told_with_the_median_track() -> None:
    made = found()
    tracks = made.before.by_track.copy()
    tracks[tracks.argmax()] = 400.0
    whole = float(np.sqrt((tracks**2).mean()))
    skewed = replace(made, before=replace(made.before, by_track=tracks, prediction_rmse_mm=whole))
    before, after = np.median(tracks), np.median(made.after.by_track)
    said = f"the median track is off by {before:.1f} mm before and {after:.1f} mm after."
    assert any(said in line for line in meaning(skewed))
    assert f"predicted to {after:.1f} mm or better; before, to {before:.1f} mm." in headline(skewed)
    assert "instead of" in headline(made)
    assert not any("median track" in line for line in meaning(made))
