"""`report.html`: a diagnosis as one self-contained page. The answer comes first, then its grounds."""

import math
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files

from matplotlib.figure import Figure

from ballfg.diagnosis.report import pictures
from ballfg.diagnosis.report.parts import Html, bar, items, picture, section, table, tag, text
from ballfg.diagnosis.report.wording import NONE, change, fixed, joined, listed, number, plus_minus, probability
from ballfg.diagnosis.result import Candidate, Diagnosis, Finding, Outcome, Residuals, Value, Verdict
from ballfg.dynamics import EFFECTS

BADGES = {Verdict.FOUND: "found", Verdict.NOTHING: "nothing", Verdict.UNEXPLAINED: "unexplained"}
COLOURS = {Outcome.ADDED: "added", Outcome.ALIKE: "alike"}
"""Classes of the style for the verdict and for the outcome of a candidate."""
SHOWN = 8
"""Rows of a ranking that are seen at once; the others unfold."""
INTERVALS = "90 % is right: share of measured coordinates inside their 90 % intervals"
RANKING = ("candidate", "squared residual it would explain", "by chance", "BIC", "first estimate", "outcome")


def page(diagnosis: Diagnosis) -> str:
    """The whole page."""
    badge = tag("span", diagnosis.verdict.value, kind=f"badge {BADGES[diagnosis.verdict]}")
    question = tag("p", f"{diagnosis.dataset} · what does the model lack? ", badge)
    calibrated = table(("coefficient", "declared", "fitted with the added effects"), _values(diagnosis.calibrated))
    noise = table(("position noise along", "stated", "estimated"), _values(diagnosis.noise))
    body = tag(
        "main",
        tag("header", question, tag("h1", diagnosis.sentence)),
        _errors(diagnosis),
        section("What was added to the model", *(_finding(f) for f in diagnosis.findings)),
        _alike(diagnosis),
        section("What fits better and is no name", items(diagnosis.remarks) if diagnosis.remarks else ""),
        _left_over(diagnosis),
        _residuals(diagnosis),
        _rankings(diagnosis),
        _invisible(diagnosis),
        section("Coefficients and noise", calibrated, noise),
        _evaluation(diagnosis),
    )
    style = files(__package__).joinpath("style.css").read_text(encoding="utf-8")
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(diagnosis.dataset)}: diagnosis</title><style>\n{style}</style>"
    )
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>{body}</body></html>\n'


def _errors(diagnosis: Diagnosis) -> Html:
    """Errors of predictions on the held-out half, before and after."""
    before, after, changed = diagnosis.before, diagnosis.after, bool(diagnosis.findings)
    likelihoods = before.log_likelihood, after.log_likelihood
    cards = tag(
        "div",
        _card("prediction error", before.prediction_rmse_mm, after.prediction_rmse_mm, " mm", changed),
        _card("error of the apex", before.apex_rmse_mm, after.apex_rmse_mm, " mm", changed),
        _card("NIS", before.nis, after.nis, "", changed, "1: errors are as large as predicted"),
        _card("intervals hold", 100 * before.intervals_held, 100 * after.intervals_held, " %", changed, INTERVALS),
        _card("log likelihood", *likelihoods, "", changed, "per coordinate; more is better"),
        kind="cards",
    )
    words = (
        f"Both models were fitted to the other tracks. Of {diagnosis.tracks_judged_on} tracks the first 40 % was "
        "observed. The rest was predicted and compared with the measured positions."
    )
    if not changed:
        return section("How well the model predicts", tag("p", words), cards)
    caption = "Each line is one of these tracks; diamonds pool them all."
    paired = picture(pictures.errors_by_track(before, after), caption)
    return section("How much predictions gain", tag("p", words), tag("div", cards, paired, kind="beside"))


def _card(name: str, was: float, now: float, unit: str, changed: bool, note: str = "") -> Html:
    """One number, with its old value where the model changed, and a note or the change in percent."""
    decimals = 1 if unit else 2
    old = tag("span", f"{fixed(was, decimals)} → ", kind="was") if changed and math.isfinite(was) else Html()
    shown = f"{fixed(now, decimals)}{unit}" if math.isfinite(now) else NONE
    if not math.isfinite(now):
        note = "nothing to compare"
    elif not note and changed:
        note = change(was, now)
    below = tag("span", note, kind="quiet") if note else Html()
    return tag("div", tag("span", name, kind="quiet"), tag("span", old, shown, kind="big"), below, kind="card")


def _finding(finding: Finding) -> Html:
    """An effect that was added, its coefficients and its evidence."""
    head = tag("h3", finding.name, " ", tag("span", finding.kind, kind="badge added"))
    values = table(
        ("coefficient", "value ± standard deviation"),
        ((tag("code", name), plus_minus(value)) for name, value in finding.parameters.items()),
    )
    verb = "falls" if finding.delta_bic < 0 else "rises"
    gain = "adds" if finding.held_out_gain >= 0 else "takes away"
    others = finding.indistinguishable_from
    evidence = items(
        (
            f"Probability of so strong a trace by chance, all candidates counted: {probability(finding.p_value)}.",
            f"The model's BIC {verb} by {abs(finding.delta_bic):.0f} with it, refitted.",
            f"On the held-out tracks it {gain} {number(abs(finding.held_out_gain))} of log likelihood per track; "
            f"probability of that by chance: {probability(finding.held_out_p)}.",
            f"Cannot be told from {joined(others)}." if others else "No other candidate explains as much.",
        )
    )
    return tag("article", head, tag("p", finding.sentence), values, evidence, kind="card")


def _alike(diagnosis: Diagnosis) -> Html:
    """Effects that the data cannot tell apart, and measurements that can."""
    cards = []
    for finding in diagnosis.findings:
        others = finding.indistinguishable_from
        if others:
            hints = {finding.name: finding.decide} | {n: EFFECTS[n].decide for n in others if n in EFFECTS}
            words = f"These data cannot tell {joined((finding.name, *others))} apart. What would decide it:"
            lines = items(tag("span", tag("b", name), f": {hint}") for name, hint in hints.items())
            cards.append(tag("article", tag("p", words), lines, kind="card"))
    return section("What could not be told apart", *cards)


def _left_over(diagnosis: Diagnosis) -> Html:
    """The pattern that is left in the end, its tests, and a description without a name."""
    left, share = diagnosis.unexplained, ""
    words = left.where or "No pattern is left that the tests can see: what remains is noise."
    if left.where and math.isfinite(left.share_of_residual):
        share = f"That is {100 * left.share_of_residual:.0f} % of the pattern that was there at the start."
    shares = [f"{100 * t.share:.0f} %" if math.isfinite(t.share) else NONE for t in left.tests]
    tests = table(
        ("test", "by chance", "share of the first pattern", "pattern"),
        ((t.name, probability(t.p_value), share, t.where) for t, share in zip(left.tests, shares, strict=True)),
    )
    rest = Html()
    if left.fallback is not None:
        without, within = (fixed(e.prediction_rmse_mm, 1) for e in (left.fallback.before, left.fallback.after))
        purpose = "It describes the rest without naming a cause. Prediction error on the held-out tracks:"
        rest = tag(
            "article",
            tag("h3", "A stopgap: ", left.fallback.kind),
            tag("p", tag("code", left.fallback.description)),
            tag("p", f"{purpose} {without} mm without, {within} mm with it."),
            kind="card",
        )
    return section("What is left unexplained", tag("p", words), tag("p", share) if share else "", tests, rest)


def _residuals(diagnosis: Diagnosis) -> Html:
    series: dict[str, Residuals] = {"the fitted model": diagnosis.residuals_before}
    if diagnosis.findings:
        series = {"before": diagnosis.residuals_before, "after": diagnosis.residuals_after}
    drawn: list[tuple[Figure, str]] = []
    if any(len(r.flight.times) for r in series.values()):
        words = "Accelerations in flight that the model does not explain. They are zero where it lacks nothing."
        drawn.append((pictures.flight_in_time(series), words))
        drawn.append((pictures.flight_against(series), "The same accelerations against the state of the ball."))
    if all(len(r.contact.times) for r in series.values()):
        words = "Outgoing minus predicted velocity at each contact; the slip is that of the ball's lowest point."
        drawn.append((pictures.contacts(series, diagnosis.model.radius), words))
    if any(len(r.measurement.times) for r in series.values()):
        words = f"Measured minus fitted positions in units of their noise, limited to ±{pictures.LARGEST_WHITENED:g}."
        drawn.append((pictures.measurements(series), words))
        drawn.append((pictures.histogram(series), "Outliers make broad tails; misjudged noise makes a broad middle."))
    return section("What the model leaves", *(picture(figure, words) for figure, words in drawn))


def _rankings(diagnosis: Diagnosis) -> Html:
    """The candidates of each round, best first."""
    if not diagnosis.rounds:
        return Html()
    words = (
        "Each candidate is tested by its trace in the residuals, with all unknowns free to adapt. The best ones are "
        "refitted, one is added, and the rest is tested again. Bars have a logarithmic scale."
    )
    parts = [tag("p", words)]
    if len(diagnosis.rounds) > 1:
        caption = "Candidates that only resemble an added effect explain little once it is in the model."
        parts.append(picture(pictures.ranking(diagnosis.rounds), caption))
    most = max((c.explained for row in diagnosis.rounds for c in row), default=0.0)
    for n, row in enumerate(diagnosis.rounds, start=1):
        lines = list(_lines(row, most))
        parts += [tag("h3", f"Round {n}"), table(RANKING, lines[:SHOWN])]
        if rest := table(RANKING, lines[SHOWN:]):
            parts.append(tag("details", tag("summary", f"{len(lines) - SHOWN} more candidates"), rest))
    return section("Which effects were tested", *parts)


def _lines(row: Sequence[Candidate], most: float) -> Iterator[tuple[str, ...]]:
    """The rows of a table; most: squared residual of a full bar."""
    for c in row:
        colour = COLOURS.get(c.outcome, "other")
        unseen = c.outcome is Outcome.INVISIBLE
        length = math.log1p(max(c.explained, 0.0)) / math.log1p(most) if most > 0.0 and not unseen else 0.0
        yield (
            tag("span", tag("b", c.name), " ", tag("span", c.kind, kind="quiet")),
            NONE if unseen else tag("span", bar(length, colour), number(c.explained)),
            NONE if unseen else probability(c.p_value),
            NONE if c.delta_bic is None else f"{c.delta_bic:+.0f}",
            NONE if unseen else listed(c.estimate),
            tag("span", c.outcome.value, kind=f"badge {colour}"),
        )


def _invisible(diagnosis: Diagnosis) -> Html:
    """Candidates about which these data say nothing: they may be there all the same."""
    last = {c.name: c for row in diagnosis.rounds for c in row}
    names = [name for name, c in last.items() if c.outcome is Outcome.INVISIBLE]
    words = (
        "These effects may be there or not: nothing in the tracks depends on them, or something unknown takes up all "
        "that they would change. They are not ruled out."
    )
    rows = ((tag("b", n), *((EFFECTS[n].sentence, EFFECTS[n].decide) if n in EFFECTS else (NONE, NONE))) for n in names)
    parts = (tag("p", words), table(("candidate", "it is", "to see it"), rows)) if names else ()
    return section("What these data cannot show", *parts)


def _values(values: Mapping[str, Value]) -> Iterator[tuple[str, ...]]:
    for name, value in values.items():
        yield tag("code", name), NONE if value.declared is None else number(value.declared, 4), plus_minus(value)


def _evaluation(diagnosis: Diagnosis) -> Html:
    """The halves, their use, and tracks that were left out."""
    words = (
        f"Effects were looked for in all tracks, fitted to {diagnosis.tracks_found_on} of them, and had to help on the "
        f"other {diagnosis.tracks_judged_on}, whose errors are given. The coefficients of the corrected model are "
        "those of all tracks. Probabilities are corrected for the number of candidates and use the noise that the "
        "tracks show."
    )
    excluded = items(diagnosis.excluded)
    return section("How it was evaluated", tag("p", words), tag("p", "Left out:") if excluded else "", excluded)
