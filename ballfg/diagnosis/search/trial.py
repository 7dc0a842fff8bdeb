"""Scores every hypothesis of a round, and lists the refits that may be worth making."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np

from ballfg.diagnosis.evidence.rows import Motion, Patterns
from ballfg.diagnosis.evidence.screen import Screen
from ballfg.diagnosis.evidence.weighed import Weighed
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis, has_effect, hypotheses, scene_of
from ballfg.diagnosis.hypotheses.signatures import columns_of
from ballfg.diagnosis.hypotheses.varying import Grouping, Varying, near, varying_hypotheses
from ballfg.diagnosis.search.candidates import Scored, leading_sets, score_all, screened, shortlist
from ballfg.diagnosis.search.refits import Attempt, Refit, frame_hypotheses, refit, refit_driven, refit_set, refit_usual
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.measurement import SpinLabelFrame
from ballfg.dynamics.variation import place_of

AS_GOOD = 0.97
"""Share of the best place's explained residual from which another place of a change is as good."""
LABELLED = 0.5
"""Share of flights with a spin label needed for a score test of an effect that multiplies spins."""


def try_varying(
    model: Weighed,
    motion: Motion,
    catalogue: Sequence[type[Effect]],
    known: Sequence[Grouping],
    tell: Callable[[str], None],
) -> tuple[list[Scored], list[Attempt]]:
    """Scores every hypothesis of an effect that differs between tracks, and lists the refits of the leading ones.

    Args:
        model: without any of them.
        motion: random columns of its fit.
        catalogue: effects that may differ.
        known: groupings of the tracks.
        tell: called with progress.
    """
    searched = sorted(dict.fromkeys(model.fit.problem.stretches.names), key=place_of)
    listed = offered_varying(model, catalogue, known)
    tell(f"testing {len(listed)} ways in which tracks may differ")
    scored = score_all(model, listed, motion)
    names = sorted({name for way in known for level in way.weights.values() for name in level}, key=place_of)
    attempts = []
    for candidate in shortlist(scored):
        closer = near(cast(Varying, candidate.hypothesis), searched, names)
        task = partial(_refit_placed, model, motion, candidate, closer)
        attempts.append(Attempt(candidate.hypothesis.name, candidate.odds, [task]))
    return scored, attempts


def _refit_placed(model: Weighed, motion: Motion, candidate: Scored, closer: Sequence[Varying]) -> Refit:
    """The refit with a change along the recording at its best place."""
    best = _placed(model, motion, closer) if len(closer) > 1 else candidate
    return refit(model.fit, replace(best, p_value=candidate.p_value))


def _alone(before: Fit, leading: Sequence[Scored]) -> list[Attempt]:
    """The refits of every shape of the leading hypotheses."""
    found = []
    for candidate in leading:
        shaped = [candidate]
        if candidate.hypothesis.effect is SpinLabelFrame:
            frames = frame_hypotheses(before, candidate.hypothesis)
            shaped = [Scored(frame, None, candidate.p_value) for frame in frames]
        found.append(
            Attempt(candidate.hypothesis.name, candidate.odds, [partial(refit, before, one) for one in shaped])
        )
    return found


def _together(screen: Screen, scored: Sequence[Scored], most: int) -> list[Attempt]:
    """The refits of the leading sets of hypotheses."""
    tested, found = {id(s.hypothesis): s for s in scored}, []
    for chosen, odds in leading_sets(screen, scored, most).items():
        members = [tested[id(screen.candidates[one])] for one in chosen]
        task = partial(refit_set, screen.model.fit, members, *screen.step(chosen))
        found.append(Attempt(" and ".join(one.hypothesis.name for one in members), odds, [task]))
    return found


def _placed(model: Weighed, motion: Motion, closer: Sequence[Varying]) -> Scored:
    """The change along the recording at its best place.

    Several places explain about the same if tracks between them do not show the coefficient. Then an earlier change's
    place is chosen, since one new table changes several coefficients; else the middle of them.
    """
    known = {deviation.level for deviation in model.fit.problem.deviations.values()}
    scored = {id(s.hypothesis): s for s in score_all(model, closer, motion)}
    most = max(s.explained for s in scored.values())
    good = [scored[id(h)] for h in closer if scored[id(h)].explained >= AS_GOOD * most]
    named = [s for h, s in ((cast(Varying, s.hypothesis), s) for s in good) if known & set(h.grouping.weights)]
    return named[0] if named else good[len(good) // 2]


def _offered(model: Weighed, catalogue: Sequence[type[Effect]]) -> tuple[list[Hypothesis], list[Hypothesis]]:
    """The hypotheses that a model lacks: those of a score test, and those that multiply spins that nobody labelled."""
    problem = model.fit.problem
    listed = hypotheses(problem.model, scene_of(model.fit), catalogue)
    lacking = [h for h in listed if not set(h.columns) & set(problem.free)]
    unlabelled = problem.stretches.labelled.mean() < LABELLED
    driven = [h for h in lacking if h.effect.multiplies_spin and unlabelled]
    return [h for h in lacking if h not in driven and h.strengths], driven


def screen_of(
    model: Weighed,
    motion: Motion,
    catalogue: Sequence[type[Effect]],
    varying: Sequence[Varying] = (),
    patterns: Patterns | None = None,
) -> Screen:
    """What foretells a model with further effects, or with others in place of its own; without any, nothing but itself.

    Args: as in `try_hypotheses`.  varying: effects that differ by tracks.  patterns: that the model was weighed with.
    """
    listed = [*_offered(model, catalogue)[0], *varying]
    return Screen.of(model, motion, listed, columns_of(model.fit, listed), patterns)


def offered_varying(model: Weighed, catalogue: Sequence[type[Effect]], known: Sequence[Grouping]) -> list[Varying]:
    """The hypotheses of effects that differ between tracks."""
    problem = model.fit.problem
    return varying_hypotheses(problem.model, scene_of(model.fit), catalogue, problem.free, known)


def try_hypotheses(
    weighed: Weighed,
    motion: Motion,
    catalogue: Sequence[type[Effect]],
    tell: Callable[[str], None],
    most: int = 1,
) -> tuple[list[Scored], list[Attempt], Screen]:
    """Scores all hypotheses, sorted by explained residual, and lists the refits of the best, alone and together.

    The screen foretells what no refit weighs.

    Args:
        weighed: the model without any of them.
        motion: random columns of its fit.
        catalogue: candidate effects.
        tell: called with progress.
        most: largest number of effects in a set.
    """
    before, model = weighed.fit, weighed.fit.problem.model
    testable, driven = _offered(weighed, catalogue)
    tell(f"testing {len(testable) + len(driven)} hypotheses")
    scored, screen = screened(weighed, testable, motion)
    leading = shortlist(scored)
    called = {candidate.hypothesis.name for candidate in leading}
    attempts = [*_alone(before, leading), *_together(screen, scored, most)]
    for one in scored:
        hypothesis = one.hypothesis
        if hypothesis.usual and hypothesis.name not in called and not has_effect(model, hypothesis.name):
            called.add(hypothesis.name)
            # beside other effects its absence misleads less, and the linearisation may foretell it
            gain = one.odds if weighed.named else np.inf
            words = f"{hypothesis.name}, which balls usually have"
            attempts.append(Attempt(words, gain, [partial(refit_usual, before, hypothesis)]))
    for hypothesis in driven:
        words = f"{hypothesis.name} and spins that nobody labelled"
        attempts.append(Attempt(words, np.inf, [partial(refit_driven, before, hypothesis)]))
    return scored, attempts, screen
