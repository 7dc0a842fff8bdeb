"""How well the model predicts, before and after: errors on held-out tracks, one shot, and where the errors are."""

import math

from ballfg.diagnosis.report import pictures, shots
from ballfg.diagnosis.report.glossary import term
from ballfg.diagnosis.report.wording import NONE, change, fixed
from ballfg.diagnosis.result import Diagnosis, Errors
from ballfg.pages.html import Html, picture, section, table, tag


def errors(diagnosis: Diagnosis) -> Html:
    """Errors of predictions on the held-out half, before and after, and what they should be."""
    before, after, changed = diagnosis.before, diagnosis.after, diagnosis.after is not diagnosis.before
    changed = changed and (bool(diagnosis.findings) or diagnosis.unexplained.fallback is not None)
    numbers = (
        (term("prediction error"), before.prediction_rmse_mm, after.prediction_rmse_mm, " mm", "small"),
        (term("apex", "error of the apex"), before.apex_rmse_mm, after.apex_rmse_mm, " mm", "small"),
        (term("NIS"), before.nis, after.nis, "", "1"),
        (term("90 % intervals", "90 % intervals hold"), *_percents(before, after), " %", "90 %"),
        (term("log likelihood"), before.log_likelihood, after.log_likelihood, "", "large"),
    )
    words = tag(
        "p",
        f"Of {diagnosis.tracks_judged_on} ",
        term("held-out tracks"),
        " the first 40 % was observed. The rest was predicted and compared with the measured positions. "
        + (
            "Both models were fitted to the other tracks, the declared one without what was added."
            if changed
            else "The model was fitted to the other tracks."
        ),
    )
    if not changed:
        rows = [(name, _fixed(now, unit), goal) for name, _, now, unit, goal in numbers]
        return section("How well the model predicts", words, table(("", "value", "should be"), rows))
    head = ("", "declared model", "corrected model", "change", "should be")
    lines = [
        (name, _fixed(was, unit), _fixed(now, unit), _changed(was, now, unit), goal)
        for name, was, now, unit, goal in numbers
    ]
    caption = "Each line is one of these tracks; diamonds pool them all."
    paired = picture(pictures.errors_by_track(before, after), caption)
    shown = tag("div", tag("div", table(head, lines)), paired, kind="beside")
    return section("How much predictions gain", words, shown)


def _percents(before: Errors, after: Errors) -> tuple[float, float]:
    return 100 * before.intervals_held, 100 * after.intervals_held


def _fixed(value: float, unit: str) -> str:
    return f"{fixed(value, 1 if unit else 2)}{unit}" if math.isfinite(value) else NONE


def _changed(was: float, now: float, unit: str) -> str:
    """The change in percent of a length; nothing for numbers whose ratio means nothing."""
    if not math.isfinite(was + now):
        return "nothing to compare"
    return change(was, now) if unit == " mm" else ""


def one_shot(diagnosis: Diagnosis) -> Html:
    """One shot, and where the errors are."""
    before, after = diagnosis.before, diagnosis.after
    changed = after is not before and bool(diagnosis.findings or diagnosis.unexplained.fallback)
    shot = shots.median_shot(before, after, changed)
    if shot is None:
        return Html()
    was, now = shot.errors
    off = f"off by {was:.1f} mm before and {now:.1f} mm after" if changed else f"off by {now:.1f} mm"
    ranked = "gain is the median" if changed else "error is the median"
    caption = (
        f"Track {shot.after.name}, whose {ranked} of all {len(after.paths)} judged tracks: its prediction is {off}."
    )
    words = "Root mean square errors of all judged tracks. Cells without a number hold too few samples."
    return section(
        "One shot, and where the errors are",
        tag(
            "div",
            picture(shots.shot_picture(shot, changed), caption),
            picture(shots.error_map(before, after, changed), words),
            kind="beside",
        ),
    )
