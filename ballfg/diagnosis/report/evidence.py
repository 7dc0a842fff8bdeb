"""The parts of the page behind the answer: what else it could be, what is left, ranking, coefficients, the judging."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from ballfg.diagnosis.report import pictures
from ballfg.diagnosis.report.parts import Html, bar, items, picture, section, table, tag
from ballfg.diagnosis.report.wording import NONE, fixed, joined, listed, number, plus_minus, probability
from ballfg.diagnosis.result import Candidate, Diagnosis, Fallback, Outcome, Value
from ballfg.dynamics import EFFECTS

SHOWN = 8
"""Rows of a ranking that are seen at once; the others unfold."""
COLOURS = {Outcome.ADDED: "added", Outcome.ALIKE: "alike"}
"""Classes of the style for what became of a candidate."""
RANKING = ("candidate", "squared residual it would explain", "by chance", "BIC", "first estimate", "what became of it")


def alike(diagnosis: Diagnosis) -> Html:
    """What could not be told apart, and what to measure to decide it."""
    cards = []
    for finding in diagnosis.findings:
        others = finding.indistinguishable_from
        if not others:
            continue
        hints = {finding.name: finding.decide} | {n: EFFECTS[n].decide for n in others if n in EFFECTS}
        words = f"These data cannot tell {joined((finding.name, *others))} apart. What would decide it:"
        lines = items(tag("span", tag("b", name), f": {hint}") for name, hint in hints.items())
        cards.append(tag("article", tag("p", words), lines, kind="card"))
    return section("What could not be told apart", *cards)


def left_over(diagnosis: Diagnosis) -> Html:
    """What is left in the end, the tests that say so, and what explains it without a name."""
    left = diagnosis.unexplained
    words = left.where or "No pattern is left that the tests can see: what remains is noise."
    share = (
        f"That is {100 * left.share_of_residual:.0f} % of the pattern that was there at the start."
        if left.where and math.isfinite(left.share_of_residual)
        else ""
    )
    tests = table(
        ("test", "by chance", "share of the first pattern", "what it sees"),
        ((t.name, probability(t.p_value), _percent(t.share), t.where) for t in left.tests),
    )
    rest = _fallback(left.fallback) if left.fallback else Html()
    return section("What is left unexplained", tag("p", words), tag("p", share) if share else "", tests, rest)


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if math.isfinite(share) else NONE


def _fallback(fallback: Fallback) -> Html:
    without, within = (fixed(errors.prediction_rmse_mm, 1) for errors in (fallback.before, fallback.after))
    words = (
        "It explains the rest without naming it. Prediction error on the judging tracks: "
        f"{without} mm without, {within} mm with it."
    )
    head = tag("h3", "A stopgap: ", fallback.kind)
    return tag("article", head, tag("p", tag("code", fallback.description)), tag("p", words), kind="card")


def rankings(diagnosis: Diagnosis) -> Html:
    """The candidates of each round, best first."""
    if not diagnosis.rounds:
        return Html()
    words = (
        "Each candidate is tested for its trace in what the model leaves, with everything that is not known set free. "
        "The best ones are refitted; one is added; the rest is tested again. Bars have a logarithmic scale."
    )
    parts = [tag("p", words)]
    if len(diagnosis.rounds) > 1:
        caption = "An effect that is added takes along what only resembled it."
        parts.append(picture(pictures.ranking(diagnosis.rounds), caption))
    most = max((c.explained for row in diagnosis.rounds for c in row), default=0.0)
    for n, row in enumerate(diagnosis.rounds, start=1):
        lines = list(_lines(row, most))
        parts += [tag("h3", f"Round {n}"), table(RANKING, lines[:SHOWN])]
        if rest := table(RANKING, lines[SHOWN:]):
            parts.append(tag("details", tag("summary", f"{len(lines) - SHOWN} more candidates"), rest))
    return section("Which effects were tested", *parts)


def _lines(row: Sequence[Candidate], most: float) -> Iterator[tuple[str, ...]]:
    """The rows of a table; most: what fills a bar."""
    for c in row:
        colour = COLOURS.get(c.outcome, "other")
        unseen = c.outcome is Outcome.INVISIBLE
        length = math.log1p(max(c.explained, 0.0)) / math.log1p(most) if most > 0.0 and not unseen else 0.0
        explained = Html() if unseen else tag("span", bar(length, colour), number(c.explained))
        yield (
            tag("span", tag("b", c.name), " ", tag("span", c.kind, kind="quiet")),
            explained or NONE,
            NONE if unseen else probability(c.p_value),
            NONE if c.delta_bic is None else f"{c.delta_bic:+.0f}",
            NONE if unseen else listed(c.estimate),
            tag("span", c.outcome.value, kind=f"badge {colour}"),
        )


def invisible(diagnosis: Diagnosis) -> Html:
    """Candidates about which these data say nothing: they may be there all the same."""
    last = {c.name: c for row in diagnosis.rounds for c in row}
    names = [name for name, c in last.items() if c.outcome is Outcome.INVISIBLE]
    if not names:
        return Html()
    words = (
        "These may be there or not: whatever they would do, something that is not known takes it up, or nothing in the "
        "tracks depends on it. They are not ruled out."
    )
    rows = ((tag("b", n), *((EFFECTS[n].sentence, EFFECTS[n].decide) if n in EFFECTS else (NONE, NONE))) for n in names)
    return section("What these data cannot show", tag("p", words), table(("candidate", "it is", "to see it"), rows))


def coefficients(diagnosis: Diagnosis) -> Html:
    """Declared coefficients and noise, as declared and as fitted."""
    calibrated = table(("coefficient", "declared", "fitted with all that was added"), _values(diagnosis.calibrated))
    noise = table(("position noise along", "stated", "as the tracks have it"), _values(diagnosis.noise))
    return section("The numbers of the model and of the noise", calibrated, noise)


def _values(values: Mapping[str, Value]) -> Iterator[tuple[str, ...]]:
    for name, value in values.items():
        declared = NONE if value.declared is None else number(value.declared, 4)
        yield tag("code", name), declared, plus_minus(value)


def judged(diagnosis: Diagnosis) -> Html:
    """How the answer was come by."""
    words = (
        f"{diagnosis.tracks_found_on} tracks served to find, {diagnosis.tracks_judged_on} others to judge. "
        "Residual pictures, ranking and coefficients are of the first, errors of the second. "
        "Probabilities are those of a chance pattern among all candidates tested, with the noise as the tracks have it."
    )
    excluded = items(diagnosis.excluded)
    return section("How it was judged", tag("p", words), tag("p", "Left out:") if excluded else "", excluded)
