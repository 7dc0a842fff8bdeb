"""Scores every hypothesis of a search round, and lists those that lead."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from ballfg.diagnosis.evidence.prior import log_odds
from ballfg.diagnosis.evidence.rows import Motion, random_motion
from ballfg.diagnosis.evidence.screen import Screen
from ballfg.diagnosis.evidence.weighed import Weighed
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.hypotheses.signatures import columns_of, hypothesis_signatures
from ballfg.diagnosis.search.score import Score, score_tests

ALARM = 0.0025
"""Probability that a hypothesis passes the score tests of one round by chance. A trace that passes is about one whose
effect is named."""
LEAST_GAIN = 0.0
"""Natural units. Least foretold gain of a candidate that is refitted: with new noise it may gain more."""
MOST_REFITS = 4
"""Largest number of hypotheses that are refitted alone in a round."""
MOST_SHAPES = 9
"""Largest number of shapes of a hypothesis that are refitted."""
PAIR = 2
"""Number of hypotheses in the smallest set of several."""


@dataclass(frozen=True)
class Scored:
    """A hypothesis and the outcome of its score test, corrected for the number of hypotheses; None: not visible.

    `shapes` are the next best shapes of the effect: other places, other signs, possibly better minima.
    `tested` is the number of hypotheses, `gain` the foretold logarithm of the ratio of evidences.
    """

    hypothesis: Hypothesis
    score: Score | None
    p_value: float
    shapes: tuple[Hypothesis, ...] = ()
    tested: int = 1
    gain: float = -np.inf

    @property
    def explained(self) -> float:
        """Squared whitened residual that the hypothesis would explain; negative if it is not visible."""
        return -1.0 if self.score is None else self.score.explained

    @property
    def odds(self) -> float:
        """Foretold logarithm of the posterior odds of the model with it to that without."""
        return self.gain + log_odds([self.hypothesis])


def score_all(
    model: Weighed,
    candidates: Sequence[Hypothesis],
    motion: Motion | None = None,
) -> list[Scored]:
    """Score tests of all hypotheses, and their foretold gains.

    Args:
        model: without any of them, as `weigh` gives it.
        candidates: the hypotheses; those without strengths are left out.
        motion: random columns of the model's fit, if they are known.
    Returns: the tests, sorted by explained residual, invisible hypotheses last.
    """
    testable = [h for h in candidates if h.strengths]
    return screened(model, testable, random_motion(model.fit) if motion is None else motion)[0]


def screened(model: Weighed, testable: Sequence[Hypothesis], motion: Motion) -> tuple[list[Scored], Screen]:
    """The same of hypotheses with strengths, and what foretells the gains of sets of them.

    Args: motion: random columns of the model's fit.
    """
    columns = columns_of(model.fit, testable)
    screen = Screen.of(model, motion, testable, columns)
    scores = score_tests(*hypothesis_signatures(model.fit, testable, columns))
    scored = []
    for hypothesis, score, gain in zip(testable, scores, screen.gains, strict=True):
        p_value = 1.0 if score is None else min(1.0, score.p_value * len(testable))
        scored.append(Scored(hypothesis, score, p_value, tested=len(testable), gain=gain))
    return sorted(scored, key=lambda s: s.explained, reverse=True), screen


def shortlist(scored: Sequence[Scored]) -> list[Scored]:
    """The hypotheses to refit: the best shapes of each effect that may gain.

    Once one of them does, further shapes are worth a few steps even if nothing is foretold of them.
    """
    found: dict[str, list[Scored]] = {}
    for candidate in sorted(scored, key=lambda s: s.gain, reverse=True):
        if candidate.score is not None:
            found.setdefault(candidate.hypothesis.name, []).append(candidate)
    leading = [shapes for shapes in found.values() if shapes[0].gain > LEAST_GAIN][:MOST_REFITS]
    return [replace(best, shapes=tuple(s.hypothesis for s in others[: MOST_SHAPES - 1])) for best, *others in leading]


def leading_sets(screen: Screen, scored: Sequence[Scored], most: int) -> dict[tuple[int, ...], float]:
    """The most probable set of up to `most` visible hypotheses, and the most probable pair, with their log odds.

    None that is foretold to be less probable than one hypothesis alone.
    """
    seen = {id(s.hypothesis) for s in scored if s.score is not None}
    visible = [one for one, candidate in enumerate(screen.candidates) if id(candidate) in seen]
    sets = screen.sets(visible, most)
    likely = list(takewhile(lambda chosen: len(chosen) >= PAIR, sets))
    pairs = [chosen for chosen in likely if len(chosen) == PAIR]
    return {chosen: sets[chosen] for chosen in (*likely[:1], *pairs[:1])}
