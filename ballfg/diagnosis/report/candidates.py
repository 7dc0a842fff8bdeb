"""Lists the candidates of a diagnosis: a ranking of each round, and those that the data cannot show."""

import math
from collections.abc import Iterator, Sequence

from ballfg.diagnosis.report import pictures
from ballfg.diagnosis.report.headline import not_shown
from ballfg.diagnosis.report.wording import (
    NONE,
    OUTCOMES,
    capital,
    listed,
    number,
    plain_name,
    probability,
    sized,
    term,
)
from ballfg.diagnosis.result import Candidate, Diagnosis, Outcome
from ballfg.dynamics import EFFECTS
from ballfg.pages.html import Html, bar, explained, picture, section, table, tag

COLOURS = {Outcome.ADDED: "added", Outcome.ALIKE: "alike"}  # CSS classes for the outcome of a candidate
SHOWN = 8  # Number of visible rows of a ranking; the others unfold
RANKING = (
    "candidate",
    term("squared residual", "squared residual it would explain"),
    term("by chance"),
    term("BIC"),
    term("first estimate"),
    "outcome",
)


def rankings(diagnosis: Diagnosis) -> Html:
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
            _named(c),
            NONE if unseen else tag("span", bar(length, colour), number(c.explained)),
            NONE if unseen else probability(c.p_value),
            NONE if c.delta_bic is None else f"{c.delta_bic:+.0f}",
            NONE if unseen else listed(c.estimate),
            explained(c.outcome.value, OUTCOMES[c.outcome], f"badge {colour}"),
        )


def noticed_from(diagnosis: Diagnosis) -> Html:
    """Detectable sizes of the effects that these tracks do not show."""
    quiet = not_shown(diagnosis)
    words = (
        "These effects were looked for and not found. Here is how strong each would have had to be for the test to "
        "notice it in 9 of 10 recordings like this one, whatever its other coefficients are. Weaker ones may be there."
    )
    rows = []
    for c in quiet:
        sizes = (f"{name} {sized(size, c.estimate[name].unit)}" for name, size in c.seen_from.items())
        rows.append((_named(c), ", ".join(sizes)))
    parts = (tag("p", words), table(("effect", "would have been noticed from"), rows)) if quiet else ()
    return section("How small an effect would have been noticed", *parts)


def _named(candidate: Candidate) -> Html:
    name = candidate.name
    return tag("span", tag("b", capital(plain_name(name))), " ", tag("code", name, kind="quiet"))


def invisible(diagnosis: Diagnosis) -> Html:
    """Candidates on which these data carry no information: they may exist all the same."""
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
