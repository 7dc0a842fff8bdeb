"""Reports the predictions before and after: errors on held-out tracks, one shot, and a map of the errors."""

import math
from typing import Final

from ballfg.diagnosis.budget import EXPECTED, PARTS
from ballfg.diagnosis.report import pictures, shots
from ballfg.diagnosis.report.headline import of_population, skewed_medians
from ballfg.diagnosis.report.wording import NONE, change, fixed, term
from ballfg.diagnosis.result import Diagnosis, Errors
from ballfg.pages.html import Html, bar, items, picture, section, table, tag, text

BY_CHANCE: Final = 2.0  # Standard errors within which a NIS counts as 1
NEAR_FLOOR: Final = 1.2  # Ratio to the floor below which a model can hardly be improved


def errors(diagnosis: Diagnosis) -> Html:
    """Errors of predictions on the held-out half, before and after, with their ideal values."""
    before, after, changed = diagnosis.before, diagnosis.after, diagnosis.after is not diagnosis.before
    changed = changed and (bool(diagnosis.findings) or diagnosis.unexplained.fallback is not None)
    near = f"near {diagnosis.floor_mm:.1f} mm" if math.isfinite(diagnosis.floor_mm) else "small"
    held = (100 * before.intervals_held, 100 * after.intervals_held)
    numbers = (
        (term("prediction error"), before.prediction_rmse_mm, after.prediction_rmse_mm, " mm", near),
        (term("apex", "error of the apex"), before.apex_rmse_mm, after.apex_rmse_mm, " mm", "small"),
        (term("NIS"), before.nis, after.nis, "", "1"),
        (term("90 % intervals", "90 % intervals hold"), *held, " %", "90 %"),
        (term("log likelihood"), before.log_likelihood, after.log_likelihood, "", "large"),
    )
    said = " the first 40 % was observed. The rest was predicted and compared with the measured positions. "
    said += "Both models were" if changed else "The model was"
    said += " fitted to the other tracks" + (", the declared one without what was added." if changed else ".")
    words = tag("p", f"Of {diagnosis.tracks_judged_on} ", term("held-out tracks"), said)
    words = tag("p", diagnosis.evaluation) if diagnosis.evaluation else words
    if not changed:
        rows = [(name, _fixed(now, unit), goal) for name, _, now, unit, goal in numbers]
        shown = table(("", "value", "should be"), rows)
        return section("How well the model predicts", words, shown, items(meaning(diagnosis)))
    head = ("", "declared model (before)", "corrected model (after)", "change", "should be")
    lines = [
        (name, _fixed(was, unit), _fixed(now, unit), _changed(was, now, unit), goal)
        for name, was, now, unit, goal in numbers
    ]
    caption = "Each line is one of these tracks; diamonds pool them all."
    paired = picture(pictures.errors_by_track(before, after), caption)
    shown = tag("div", tag("div", table(head, lines)), paired, kind="beside")
    return section("How much predictions gain", words, shown, items(meaning(diagnosis)))


def meaning(diagnosis: Diagnosis) -> list[Html]:
    """The meaning of the table: the distance of the errors from the floor, and whether their stated size is right."""
    after, floor = diagnosis.after, diagnosis.floor_mm
    error, said = after.prediction_rmse_mm, list[Html]()
    if math.isfinite(floor + error):
        how = (
            "so that a better model would gain little"
            if error <= NEAR_FLOOR * floor
            else f"so that predictions are {error / floor:.1f} times as far off as they could be"
        )
        least = (
            f" is about {floor:.1f} mm: so much the noise of the measurements and what the observed part leaves open "
            f"of the release cost even an exact model. The error is {error:.1f} mm, {how}."
        )
        said.append(tag("span", "The ", term("floor"), least))
    if told := of_population(diagnosis):
        said.append(text(told))
    if medians := skewed_medians(diagnosis.before, after):
        was = f"{medians[0]:.1f} mm before and " if after is not diagnosis.before else ""
        off = f"{was}{medians[1]:.1f} mm{' after' if was else ''}"
        said.append(text(f"A few tracks make most of the prediction error: the median track is off by {off}."))
    if math.isfinite(after.nis) and after.nis > 0.0:
        said.append(text(_about_nis(after)))
    return said


def _about_nis(errors: Errors) -> str:
    """The meaning of a NIS for the stated uncertainty, and its deviation."""
    error = f" ± {fixed(errors.nis_error, 2)}" if math.isfinite(errors.nis_error) else ""
    begin, held = f"A NIS of {fixed(errors.nis, 2)}{error}", ""
    if math.isfinite(errors.intervals_held):
        held = f" 90 % intervals hold {100 * errors.intervals_held:.1f} % of the measured coordinates."
    if math.isfinite(errors.nis_error) and abs(errors.nis - 1.0) <= BY_CHANCE * errors.nis_error:
        return f"{begin} differs from 1 by no more than chance: predictions state their uncertainty rightly.{held}"
    share = 100 * abs(1.0 / math.sqrt(errors.nis) - 1.0)
    below = errors.nis < 1.0
    side, claim, size, ratio = (
        ("below", "better", "large", "larger") if below else ("above", "worse", "small", "smaller")
    )
    return (
        f"{begin} is {side} 1: predictions are {claim} than they claim. The noise behind them is stated too {size}; "
        f"their standard deviations are {share:.0f} % {ratio} than the errors.{held}"
    )


def _fixed(value: float, unit: str) -> str:
    return f"{fixed(value, 1 if unit else 2)}{unit}" if math.isfinite(value) else NONE


def _changed(was: float, now: float, unit: str) -> str:
    """The change of a length in percent; empty for numbers without a meaningful ratio."""
    if not math.isfinite(was + now):
        return "nothing to compare"
    return change(was, now) if unit == " mm" else ""


def parts_of_error(diagnosis: Diagnosis) -> Html:
    """The parts of the prediction error, as a table and bars; empty without a budget."""
    budget = diagnosis.budget
    if budget is None:
        return Html()
    whole = max(budget.total**2, sum(budget.squares[name] for name in EXPECTED))
    rows: list[tuple[str, str, str]] = []
    for name, words in PARTS.items():
        share = budget.squares[name] / whole
        length = bar(min(max(share, 0.0), 1.0), "added" if name in EXPECTED else "alike")
        rows.append((words, fixed(getattr(budget, name), 2), tag("span", length, f"{100 * share:.0f} %")))
    rows += [
        ("sum: the declared model's error", fixed(budget.total, 2), ""),
        ("sum without the last two parts: the floor of this model", fixed(budget.floor, 2), ""),
    ]
    words = (
        "The squares of the parts add up to the square of the measured error. A negative part takes away: the named "
        "effects made predictions worse, or errors are smaller than the model with its noise expects."
    )
    head = (term("error budget", "part"), "mm", "share of the square")
    return section("What the error consists of", tag("p", budget.sentence), table(head, rows), tag("p", words))


def one_shot(diagnosis: Diagnosis) -> Html:
    """One shot, and a map of the errors."""
    before, after = diagnosis.before, diagnosis.after
    changed = after is not before and bool(diagnosis.findings or diagnosis.unexplained.fallback)
    shot = shots.median_shot(before, after, changed)
    if shot is None:
        return Html()
    was, now = shot.errors
    off = f"off by {was:.1f} mm before and {now:.1f} mm after" if changed else f"off by {now:.1f} mm"
    ranked = "gain is the median" if changed else "error is the median"
    of_all = f"{ranked} of all {len(after.paths)} held-out tracks"
    caption = f"Track {shot.after.name}, whose {of_all}: its prediction is {off}."
    words = "Root mean square errors of all held-out tracks. Cells without a number hold too few samples."
    drawn = picture(shots.shot_picture(shot, changed), caption)
    mapped = picture(shots.error_map(before, after, changed), words)
    return section("One shot, and where the errors are", tag("div", drawn, mapped, kind="beside"))
