"""`report.html`: a diagnosis as one page that needs nothing else. The answer comes first, then what it rests on."""

from __future__ import annotations

import math

from ballfg.diagnosis.report import pictures
from ballfg.diagnosis.report.evidence import alike, coefficients, invisible, judged, left_over, rankings
from ballfg.diagnosis.report.parts import STYLE, Html, items, picture, section, table, tag, text
from ballfg.diagnosis.report.wording import NONE, change, fixed, joined, number, plus_minus, probability
from ballfg.diagnosis.result import Diagnosis, Finding, Residuals, Verdict

BADGES = {Verdict.FOUND: "found", Verdict.NOTHING: "nothing", Verdict.UNEXPLAINED: "unexplained"}
"""Classes of the style for the verdict."""


def page(diagnosis: Diagnosis) -> str:
    """The whole page."""
    body = tag(
        "main",
        _answer(diagnosis),
        _errors(diagnosis),
        section("What was added to the model", *(_finding(f) for f in diagnosis.findings)),
        alike(diagnosis),
        left_over(diagnosis),
        _residuals(diagnosis),
        rankings(diagnosis),
        invisible(diagnosis),
        coefficients(diagnosis),
        judged(diagnosis),
    )
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(diagnosis.dataset)}: diagnosis</title><style>{STYLE}</style>"
    )
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>{body}</body></html>\n'


def _answer(diagnosis: Diagnosis) -> Html:
    badge = tag("span", diagnosis.verdict.value, kind=f"badge {BADGES[diagnosis.verdict]}")
    where = tag("p", f"{diagnosis.dataset} · what does the model lack? ", badge)
    return tag("header", where, tag("h1", diagnosis.sentence))


def _errors(diagnosis: Diagnosis) -> Html:
    before, after, changed = diagnosis.before, diagnosis.after, bool(diagnosis.findings)
    likelihoods = before.log_likelihood, after.log_likelihood
    cards = tag(
        "div",
        _card("prediction error", before.prediction_rmse_mm, after.prediction_rmse_mm, " mm", changed),
        _card("error of the apex", before.apex_rmse_mm, after.apex_rmse_mm, " mm", changed),
        _card("NIS", before.nis, after.nis, "", changed, "1: the prediction knows how far off it may be"),
        _card("log likelihood", *likelihoods, "", changed, "per coordinate; more is better"),
        kind="cards",
    )
    words = (
        f"On {diagnosis.tracks_judged_on} tracks that took no part in the search: the first 40 % of each was observed, "
        "the rest predicted and compared with what was measured there."
    )
    if not changed:
        return section("How well the model predicts", tag("p", words), cards)
    paired = picture(
        pictures.errors_by_track(before, after), "Each line is one of these tracks; diamonds pool them all."
    )
    return section("What it brings", tag("p", words), tag("div", cards, paired, kind="beside"))


def _card(name: str, was: float, now: float, unit: str, changed: bool, note: str = "") -> Html:
    """One number, with what it was before where the model changed, and a note or the change in percent."""
    decimals = 1 if unit else 2
    old = tag("span", f"{fixed(was, decimals)} → ", kind="was") if changed and math.isfinite(was) else Html()
    shown = f"{fixed(now, decimals)}{unit}" if math.isfinite(now) else NONE
    if not math.isfinite(now):
        note = "nothing to judge by"
    elif not note and changed:
        note = change(was, now)
    return tag("div", _quiet(name), tag("span", old, shown, kind="big"), _quiet(note), kind="card")


def _quiet(words: str) -> Html:
    return tag("span", words, kind="quiet") if words else Html()


def _finding(finding: Finding) -> Html:
    head = tag("h3", finding.name, " ", tag("span", finding.kind, kind="badge added"))
    values = table(
        ("coefficient", "value ± standard deviation"),
        ((tag("code", name), plus_minus(value)) for name, value in finding.parameters.items()),
    )
    return tag("article", head, tag("p", finding.sentence), values, items(_evidence(finding)), kind="card")


def _evidence(finding: Finding) -> tuple[str, ...]:
    """What speaks for a finding, in words."""
    verb = "falls" if finding.delta_bic < 0 else "rises"
    gain = "adds" if finding.held_out_gain >= 0 else "takes away"
    lines = [
        f"Probability of so strong a trace by chance, all candidates counted: {probability(finding.p_value)}.",
        f"The model's BIC {verb} by {abs(finding.delta_bic):.0f} with it, refitted.",
        f"On the judging tracks it {gain} {number(abs(finding.held_out_gain))} of log likelihood per track; "
        f"probability of that by chance: {probability(finding.held_out_p)}.",
    ]
    others = finding.indistinguishable_from
    lines.append(f"Cannot be told from {joined(others)}." if others else "No other candidate explains as much.")
    return tuple(lines)


def _residuals(diagnosis: Diagnosis) -> Html:
    series: dict[str, Residuals] = {"the fitted model": diagnosis.residuals_before}
    if diagnosis.findings:
        series = {"before": diagnosis.residuals_before, "after": diagnosis.residuals_after}
    parts: list[str] = []
    if any(len(r.flight.times) for r in series.values()):
        parts.append(
            picture(
                pictures.flight_in_time(series),
                "Accelerations that the fit would have to invent in flight. A model that lacks nothing leaves zero.",
            )
        )
        parts.append(picture(pictures.flight_against(series), "The same accelerations against the state of the ball."))
    if all(len(r.contact.times) for r in series.values()):
        parts.append(
            picture(
                pictures.contacts(series, diagnosis.model.radius),
                "Outgoing minus predicted velocity at each contact; the slip is that of the ball's lowest point.",
            )
        )
    if any(len(r.measurement.times) for r in series.values()):
        parts.append(
            picture(
                pictures.measurements(series),
                f"Measured minus fitted positions in units of their noise, limited to ±{pictures.LARGEST_WHITENED:g}.",
            )
        )
        parts.append(
            picture(pictures.histogram(series), "Broad tails are outliers; a broad middle is a noise misjudged.")
        )
    return section("What the model leaves", *parts)
