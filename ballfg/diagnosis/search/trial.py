"""Scores every hypothesis of a round, and lists the refits that may be worth making."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import takewhile
from typing import cast

import numpy as np

from ballfg.diagnosis.evidence.rows import Motion, Patterns, random_motion
from ballfg.diagnosis.evidence.screen import Screen
from ballfg.diagnosis.evidence.weighed import Weighed
from ballfg.diagnosis.fit.effects import has_effect
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis, hypotheses, scene_of
from ballfg.diagnosis.hypotheses.signatures import columns_of, hypothesis_signatures
from ballfg.diagnosis.hypotheses.varying import Grouping, Varying, near, varying_hypotheses
from ballfg.diagnosis.search.refits import Attempt, Refit, frame_hypotheses, refit, refit_driven, refit_set, refit_usual
from ballfg.diagnosis.search.score import Scored, score_tests
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.measurement import SpinLabelFrame
from ballfg.dynamics.variation import place_of

LEAST_GAIN = 0.0  # Natural units. Least foretold gain of a candidate that is refitted: with new noise it may gain more
MOST_REFITS = 4  # Largest number of hypotheses that are refitted alone in a round
MOST_SHAPES = 9  # Largest number of shapes of a hypothesis that are refitted
PAIR = 2  # Number of hypotheses in the smallest set of several


def score_all(model: Weighed, candidates: Sequence[Hypothesis], motion: Motion | None = None) -> list[Scored]:
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
    fit = model.alike  # a score takes what tracks have alike from all that an effect could explain
    scores = score_tests(*hypothesis_signatures(fit, testable, columns if fit is model.fit else None))
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


AS_GOOD = 0.97  # Share of the best place's explained residual from which another place of a change is as good
LABELLED = 0.5  # Share of flights with a spin label needed for a score test of an effect that multiplies spins


def try_varying(
    model: Weighed,
    motion: Motion,
    catalogue: Sequence[type[Effect]],
    known: Sequence[Grouping],
    tell: Callable[[str], None],
) -> tuple[list[Scored], list[Attempt]]:
    """Scores every hypothesis of an effect that differs between tracks, and lists the refits of the leading ones.

    Args: model: without any of them.  motion: random columns of its fit.  known: groupings of the tracks.
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
    return refit(model.alike, replace(best, p_value=candidate.p_value))


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

    Of several that explain about the same, an earlier change's is chosen, since one new table changes several
    coefficients; else the middle of them.
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
    """What foretells a model with further effects, or with others in place of its own.

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

    Args: weighed: the model without any of them.  motion: random columns of its fit.  most: effects in a set.
    """
    before, model = weighed.alike, weighed.fit.problem.model
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
