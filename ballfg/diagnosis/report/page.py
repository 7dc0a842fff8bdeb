"""`report.html`: a diagnosis as one self-contained page. The answer comes first, then its grounds."""

import math
from collections.abc import Iterator, Mapping, Sequence

from matplotlib.figure import Figure

from ballfg.diagnosis.remains.generic import ALARM
from ballfg.diagnosis.report import pictures, shots
from ballfg.diagnosis.report.glossary import glossary, outcome_badge, term
from ballfg.diagnosis.report.headline import advice, certainty, further, headline, where
from ballfg.diagnosis.report.origin import Origin, date, packages
from ballfg.diagnosis.report.plain_effects import in_plain_words, plain_name
from ballfg.diagnosis.report.wording import NONE, change, fixed, joined, listed, number, plus_minus, probability
from ballfg.diagnosis.result import (
    Candidate,
    Diagnosis,
    Errors,
    Finding,
    GenericTest,
    Outcome,
    Residuals,
    Value,
    Verdict,
)
from ballfg.dynamics import EFFECTS
from ballfg.files.page_parts import Html, bar, items, picture, section, table, tag, whole_page

BADGES = {Verdict.FOUND: "found", Verdict.NOTHING: "nothing", Verdict.UNEXPLAINED: "unexplained"}
COLOURS = {Outcome.ADDED: "added", Outcome.ALIKE: "alike"}
"""Classes of the style for the verdict and for the outcome of a candidate."""
SHOWN = 8
"""Rows of a ranking that are seen at once; the others unfold."""
RANKING = (
    "candidate",
    term("squared residual", "squared residual it would explain"),
    term("by chance"),
    term("BIC"),
    "first estimate",
    "outcome",
)


def page(diagnosis: Diagnosis, origin: Origin | None = None) -> str:
    """The whole page; origin: the command and the files that it comes from, where they are known."""
    badge = tag("span", diagnosis.verdict.value, kind=f"badge {BADGES[diagnosis.verdict]}")
    question = tag("p", f"{diagnosis.dataset} · what does the model lack? ", badge)
    values = (term("coefficient"), "declared", "fitted with the added effects")
    calibrated = table(values, _values(diagnosis.calibrated))
    noise = table(("position noise along", "stated", "estimated"), _values(diagnosis.noise))
    return whole_page(
        f"{diagnosis.dataset}: diagnosis",
        tag("header", question, tag("h1", headline(diagnosis)), _in_short(diagnosis)),
        section("What to do next", *_next(diagnosis, origin)),
        _errors(diagnosis),
        _shots(diagnosis),
        section("What was added to the model", *(_finding(f) for f in diagnosis.findings)),
        _alike(diagnosis),
        section("What fits better and is no name", items(diagnosis.remarks) if diagnosis.remarks else ""),
        _left_over(diagnosis),
        _residuals(diagnosis),
        _rankings(diagnosis),
        _invisible(diagnosis),
        section("Coefficients and noise", calibrated, noise),
        _evaluation(diagnosis),
        section("Where this report comes from", _made(diagnosis, origin)),
        section("What the words mean", glossary()),
    )


def _in_short(diagnosis: Diagnosis) -> Html:
    """What was found beside the first sentence, and how sure it is."""
    more = items(further(diagnosis))
    parts = [tag("h3", "In detail"), more] if more else []
    sure = items(certainty(diagnosis))
    return tag("div", *parts, *((tag("h3", "How sure is that?"), sure) if sure else ()), kind="short")


def _next(diagnosis: Diagnosis, origin: Origin | None) -> Iterator[Html]:
    """Commands and experiments that follow."""
    known = origin or Origin("", ("DATASET",), "", "OUT")
    for words, command in advice(diagnosis, known):
        yield tag("p", words)
        if command:
            yield tag("pre", tag("code", command))


def _made(diagnosis: Diagnosis, origin: Origin | None) -> Html:
    """Date, versions and inputs."""
    rows = [("made on", date()), ("with", packages()), ("dataset", diagnosis.dataset)]
    if origin is not None:
        rows += [
            ("from", ", ".join(origin.datasets)),
            ("model", origin.model or "the nominal model of the dataset's ball"),
            ("command", tag("code", origin.command)),
        ]
    used = f"{diagnosis.tracks_found_on} to find with, {diagnosis.tracks_judged_on} to judge by"
    return table(("", ""), (*rows, ("tracks", used)))


def _errors(diagnosis: Diagnosis) -> Html:
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
        + ("Both models were" if changed else "The model was")
        + " fitted to the other tracks.",
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


def _shots(diagnosis: Diagnosis) -> Html:
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


def _finding(finding: Finding) -> Html:
    """An effect that was added, its coefficients and its evidence."""
    head = tag("h3", _upper(plain_name(finding.name)), " ", tag("code", finding.name, kind="quiet"))
    values = table(
        (term("coefficient"), "value ± standard deviation"),
        ((tag("code", name), plus_minus(value)) for name, value in finding.parameters.items()),
    )
    verb = "falls" if finding.delta_bic < 0 else "rises"
    gain = "adds" if finding.held_out_gain >= 0 else "takes away"
    others = finding.indistinguishable_from
    evidence = items(
        (
            f"Probability of so strong a trace by chance, all candidates counted: {probability(finding.p_value)}.",
            tag("span", "The model's ", term("BIC"), f" {verb} by {abs(finding.delta_bic):.0f} with it, refitted."),
            tag(
                "span",
                "On the ",
                term("held-out tracks"),
                f" it {gain} {number(abs(finding.held_out_gain))} of ",
                term("log likelihood"),
                f" per track; probability of that by chance: {probability(finding.held_out_p)}.",
            ),
            f"Cannot be told from {joined(others)}." if others else "No other candidate explains as much.",
        )
    )
    return tag(
        "article", head, tag("p", in_plain_words(finding)), tag("p", finding.sentence), values, evidence, kind="card"
    )


def _alike(diagnosis: Diagnosis) -> Html:
    """Effects that the data cannot tell apart, and measurements that can."""
    cards = []
    for finding in diagnosis.findings:
        others = finding.indistinguishable_from
        if others:
            hints = {finding.name: finding.decide} | {n: EFFECTS[n].decide for n in others if n in EFFECTS}
            names = joined(tuple(map(plain_name, (finding.name, *others))))
            words = f"These data cannot tell {names} apart. What would decide it:"
            lines = items(tag("span", tag("b", plain_name(n)), f": {hint}") for n, hint in hints.items())
            cards.append(tag("article", tag("p", words), lines, kind="card"))
    return section("What could not be told apart", *cards)


def _left_over(diagnosis: Diagnosis) -> Html:
    """The pattern that is left in the end, its tests, and a description without a name."""
    left, share = diagnosis.unexplained, ""
    words = _upper(f"{where(left.where)}.") if left.where else ""
    words = words or "No pattern is left that the tests can see: what remains is noise."
    if left.where and math.isfinite(left.share_of_residual):
        share = f"That is {100 * left.share_of_residual:.0f} % of the pattern that was there at the start."
    alarms = [t for t in left.tests if t.p_value < ALARM]
    quiet = tuple(dict.fromkeys(t.name for t in left.tests if t.p_value >= ALARM))
    head = (term("generic test"), term("by chance"), "pattern", "share of it at the start that is left")
    tests = table(head, ((t.name, probability(t.p_value), t.where, _share(t)) for t in alarms))
    silent = f"Tests that find nothing beyond noise: {joined(quiet)}." if quiet else ""
    quietly = tag("p", silent, kind="quiet") if silent else Html()
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
    return section("What is left unexplained", tag("p", words), tag("p", share) if share else "", tests, quietly, rest)


def _share(test: GenericTest) -> str:
    """The share of a pattern that is left."""
    return f"{100 * test.share:.0f} %" if math.isfinite(test.share) else NONE


def _upper(words: str) -> str:
    return words[:1].upper() + words[1:]


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
            tag("span", tag("b", _upper(plain_name(c.name))), " ", tag("code", c.name, kind="quiet")),
            NONE if unseen else tag("span", bar(length, colour), number(c.explained)),
            NONE if unseen else probability(c.p_value),
            NONE if c.delta_bic is None else f"{c.delta_bic:+.0f}",
            NONE if unseen else listed(c.estimate),
            outcome_badge(c.outcome, colour),
        )


def _invisible(diagnosis: Diagnosis) -> Html:
    """Candidates about which these data say nothing: they may be there all the same."""
    last = {c.name: c for row in diagnosis.rounds for c in row}
    names = [name for name, c in last.items() if c.outcome is Outcome.INVISIBLE]
    words = (
        "These effects may be there or not: nothing in the tracks depends on them, or something unknown takes up all "
        "that they would change. They are not ruled out."
    )
    rows = (
        (tag("b", plain_name(n)), *((EFFECTS[n].sentence, EFFECTS[n].decide) if n in EFFECTS else (NONE, NONE)))
        for n in names
    )
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
