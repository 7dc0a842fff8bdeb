"""Writes `report.html`, a diagnosis as one self-contained page: first the answer, then its grounds."""

import math
from collections.abc import Iterator, Mapping

from matplotlib.figure import Figure

from ballfg.diagnosis.generic_test import ALARM, percent
from ballfg.diagnosis.report import pictures, wording
from ballfg.diagnosis.report.candidates import invisible, noticed_from, rankings
from ballfg.diagnosis.report.headline import Origin, advice, answer, certainty, further, headline, where
from ballfg.diagnosis.report.predictions import errors, one_shot, parts_of_error
from ballfg.diagnosis.report.wording import glossary, term
from ballfg.diagnosis.result import Diagnosis, Finding, Residuals, Value, Verdict
from ballfg.dynamics import EFFECTS
from ballfg.machine import date, versions
from ballfg.pages.html import Html, doubtful, items, picture, section, table, tag, typed, whole_page

BADGES = {Verdict.FOUND: "found", Verdict.NOTHING: "nothing", Verdict.UNEXPLAINED: "unexplained"}
"""CSS class of the verdict."""
PACKAGES = ("ballfg", "torch", "numpy", "scipy")  # Those whose versions a report names


def page(diagnosis: Diagnosis, origin: Origin | None = None) -> str:
    """The whole page; origin: its command and files, if known."""
    badge = tag("span", answer(diagnosis), kind=f"badge {BADGES[diagnosis.verdict]}")
    question = tag("p", f"{diagnosis.dataset} · what does the model lack? ", badge)
    doubts = doubtful(origin.doubts if origin is not None else ())
    values = (term("coefficient"), "declared", "fitted" + (" with the added effects" if diagnosis.findings else ""))
    calibrated = table(values, _values(diagnosis.calibrated))
    noise = table(("position noise along", "stated", "estimated"), _values(_in_mm(diagnosis.noise)))
    return whole_page(
        f"{diagnosis.dataset}: diagnosis",
        tag("header", question, tag("h1", headline(diagnosis)), doubts, _in_short(diagnosis)),
        section("What to do next", *_next(diagnosis, origin)),
        errors(diagnosis),
        parts_of_error(diagnosis),
        one_shot(diagnosis),
        section("What was added to the model", *(_finding(f) for f in diagnosis.findings)),
        _alike(diagnosis),
        section("What else was noticed", items(diagnosis.remarks) if diagnosis.remarks else ""),
        _left_over(diagnosis),
        _residuals(diagnosis),
        rankings(diagnosis),
        noticed_from(diagnosis),
        invisible(diagnosis),
        section("Coefficients and noise", calibrated, noise),
        _evaluation(diagnosis),
        section("Where this report comes from", _made(diagnosis, origin)),
        section("What the words mean", glossary()),
    )


def _in_short(diagnosis: Diagnosis) -> Html:
    """Further findings after the first sentence, and their certainty."""
    more = items(further(diagnosis))
    parts = [tag("h3", "In detail"), more] if more else []
    sure = items(certainty(diagnosis))
    return tag("div", *parts, *((tag("h3", "How sure is that?"), sure) if sure else ()), kind="short")


def _next(diagnosis: Diagnosis, origin: Origin | None) -> Iterator[Html]:
    """The next commands and experiments."""
    known = origin or Origin("", ("DATASET",), "", "OUT")
    for words, command in advice(diagnosis, known):
        yield tag("p", words)
        if command:
            yield tag("pre", typed(command))


def _made(diagnosis: Diagnosis, origin: Origin | None) -> Html:
    """Date, versions and inputs."""
    packages = ", ".join(f"{name} {version}" for name, version in versions(PACKAGES).items())
    rows = [("made on", date()), ("with", packages), ("dataset", diagnosis.dataset)]
    if origin is not None:
        rows += [
            ("from", ", ".join(origin.datasets)),
            ("model", origin.model or "the nominal model of the dataset's ball"),
            ("command", typed(origin.command)),
        ]
    used = f"{diagnosis.tracks_found_on} to find with, {diagnosis.tracks_judged_on} to judge by"
    return table(("", ""), (*rows, ("tracks", used)))


def _finding(finding: Finding) -> Html:
    """An added effect, its coefficients and its evidence."""
    head = tag("h3", wording.capital(wording.plain_name(finding.name)), " ", tag("code", finding.name, kind="quiet"))
    values = table(
        (term("coefficient"), "value ± standard deviation"),
        ((tag("code", name), wording.plus_minus(value)) for name, value in finding.parameters.items()),
    )
    verb = "falls" if finding.delta_bic < 0 else "rises"
    gain = "adds" if finding.held_out_gain >= 0 else "takes away"
    others = finding.indistinguishable_from
    evidence = [f"Probability that it is there: {wording.odds(finding.probability)}."]
    if others:
        evidence.append(
            f"That it or one of those that cannot be told from it is there: {wording.odds(finding.together)}."
        )
    if finding.usual:
        evidence.append(f"Stronger than usual: {finding.usual}.")
    by_chance = f" by chance, all candidates counted: {wording.probability(finding.p_value)}."
    bic = f" {verb} by {abs(finding.delta_bic):.0f} with it."
    gained = f" it {gain} {wording.number(abs(finding.held_out_gain))} of "
    per_track = f" per track; probability of that by chance: {wording.probability(finding.held_out_p)}."
    held = tag("span", "On the ", term("held-out tracks"), gained, term("log likelihood"), per_track)
    evidence += [
        tag("span", "Probability of so strong a ", term("trace"), by_chance),
        tag("span", "The model's ", term("BIC"), bic),
        *([held] if math.isfinite(finding.held_out_gain) else []),
        f"Cannot be told from {wording.joined(others)}."
        if others
        else "Of the candidates that were not refused no other explains as much.",
    ]
    words = (tag("p", wording.in_plain_words(finding)), tag("p", finding.sentence))
    return tag("article", head, *words, values, items(evidence), kind="card")


def _alike(diagnosis: Diagnosis) -> Html:
    """Indistinguishable effects, and measurements that would separate them."""
    cards = []
    for finding in (f for f in diagnosis.findings if f.indistinguishable_from):
        others = finding.indistinguishable_from
        hints = {finding.name: finding.decide} | {n: EFFECTS[n].decide for n in others if n in EFFECTS}
        names = wording.joined(tuple(map(wording.plain_name, (finding.name, *others))))
        words = f"These data cannot tell {names} apart. What would decide it:"
        lines = items(tag("span", tag("b", wording.plain_name(n)), f": {hint}") for n, hint in hints.items())
        cards.append(tag("article", tag("p", words), lines, kind="card"))
    return section("What could not be told apart", *cards)


def _left_over(diagnosis: Diagnosis) -> Html:
    """The remaining pattern, its tests, and a description without a name."""
    left, share = diagnosis.unexplained, ""
    words = wording.capital(f"{where(left.where)}.") if left.where else ""
    words = words or "No pattern is left that the tests can see: what remains is noise."
    if left.where and math.isfinite(left.share_of_residual):
        share = f"That is {100 * left.share_of_residual:.0f} % of the pattern that was there at the start."
    alarms = [t for t in left.tests if t.p_value < ALARM]
    loud = {t.name for t in alarms}
    quiet = tuple(dict.fromkeys(t.name for t in left.tests if t.name not in loud))
    head = (term("generic test"), term("by chance"), "pattern", "share of it at the start that is left")
    shares = (f"{100 * t.share:.0f} %" if math.isfinite(t.share) else wording.NONE for t in alarms)
    tests = table(
        head, ((t.name, wording.probability(t.p_value), t.where, s) for t, s in zip(alarms, shares, strict=True))
    )
    silent = f"Tests that find nothing beyond noise: {wording.joined(quiet)}."
    quietly, rest = tag("p", silent, kind="quiet") if quiet else Html(), Html()
    if left.fallback is not None:
        without, within = (wording.fixed(e.prediction_rmse_mm, 1) for e in (left.fallback.before, left.fallback.after))
        purpose = "It describes the rest without naming a cause. Prediction error on the held-out tracks:"
        title, described = tag("h3", "A stopgap: ", left.fallback.kind), tag("code", left.fallback.description)
        helps = tag("p", f"{purpose} {without} mm without, {within} mm with it.")
        rest = tag("article", title, tag("p", described), helps, kind="card")
    counted = tag("p", share) if share else ""
    return section("What is left unexplained", tag("p", words), counted, tests, quietly, _labels(diagnosis), rest)


def _labels(diagnosis: Diagnosis) -> Html:
    """The spin labels that contradict their flights, each with the probability that it is wrong."""
    wrong = () if diagnosis.labels is None else diagnosis.labels.contradicted
    if not wrong:
        return Html()
    words = (
        "Spin labels that contradict their flights. The spin that a flight shows is uncertain because measurements are "
        "noisy, and because flights and bounces scatter about the model."
    )
    rows = ((v.track, f"{v.off:.0f} rad/s", f"{v.sigma:.0f} rad/s", percent(v.probability)) for v in wrong)
    head = ("track", "label less the flight's spin", "standard deviation of that spin", "the label is wrong")
    return tag("article", tag("p", words), table(head, rows), kind="card")


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
        words = (
            "Means of measured minus fitted positions, in units of their noise (sigma). A single residual counts as at "
            f"most ±{pictures.LARGEST_WHITENED:g} in them, so that an outlier hides no pattern."
        )
        drawn.append((pictures.measurements(series), words))
        words = "Outliers make broad tails; misjudged noise makes a broad middle. The vertical axis is logarithmic. "
        drawn.append((pictures.histogram(series), words + pictures.beyond_histogram(series)))
    return section("What the model leaves", *(picture(figure, words) for figure, words in drawn))


def _values(values: Mapping[str, Value]) -> Iterator[tuple[str, ...]]:
    for name, value in values.items():
        unit = "" if value.unit == "1" else f" {value.unit}"
        declared = wording.NONE if value.declared is None else f"{wording.number(value.declared, 4)}{unit}"
        yield tag("code", name), declared, wording.plus_minus(value)


def _in_mm(values: Mapping[str, Value]) -> dict[str, Value]:
    """Lengths in mm, like prediction errors."""
    declared = {name: v.declared if v.declared is None else 1e3 * v.declared for name, v in values.items()}
    return {name: Value(1e3 * v.value, 1e3 * v.sigma, "mm", declared[name]) for name, v in values.items()}


def _evaluation(diagnosis: Diagnosis) -> Html:
    """The halves, their use, and unused tracks."""
    words = (
        "Traces of effects were looked for in all tracks: half of them would show only larger ones. The strength of an "
        f"effect was then fitted to {diagnosis.tracks_found_on} tracks, and with that strength it had to help on the "
        f"other {diagnosis.tracks_judged_on}, the held-out ones, whose errors are given. Once the search was over, the "
        "coefficients of the model that is written were fitted to all tracks. Probabilities are corrected for the "
        "number of candidates and use the noise that the tracks show."
    )
    excluded = items(diagnosis.excluded)
    return section(
        "How it was evaluated",
        tag("p", diagnosis.evaluation or words),
        tag("p", "Left out:") if excluded else "",
        excluded,
    )
