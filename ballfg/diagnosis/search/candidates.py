"""Scores every hypothesis of a search round, refits the leading ones and compares the refits."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np
import torch
from scipy import stats

from ballfg.arrays import Array
from ballfg.diagnosis.evidence.prior import log_odds
from ballfg.diagnosis.evidence.rows import Motion, random_motion
from ballfg.diagnosis.evidence.screen import Screen
from ballfg.diagnosis.evidence.weighed import Weighed
from ballfg.diagnosis.fit.fit import fit_problem, followed
from ballfg.diagnosis.fit.problem import Fit, Problem, Unknowns
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis, with_effects
from ballfg.diagnosis.hypotheses.signatures import columns_of, hypothesis_signatures
from ballfg.diagnosis.search.label_frames import FRAMES
from ballfg.diagnosis.search.score import Score, score_tests
from ballfg.state import SPIN

ALARM = 0.0025
"""Probability that a hypothesis passes the score tests of one round by chance. A trace that passes is about one whose
effect is named."""
LEAST_GAIN = 0.0
"""Natural units. Least foretold gain of a candidate that is refitted: with new noise it may gain more."""
MOST_REFITS = 4
"""Largest number of hypotheses that are refitted alone in a round."""
MOST_SHAPES, FIRST_STEPS, USUAL_STEPS = 9, 2, 6
"""Largest number of shapes of a hypothesis that are refitted, and of the steps of a refit from absence, and from the
usual strength, which all spins must follow.

They lead near the minimum of the deterministic fit, and the likelihood leads on from there. At that minimum itself a
model that lacks something else has strengths that random motion does not need, often in the range of another maximum.
"""
PAIR = 2
"""Number of hypotheses in the smallest set of several."""
FRAME_CHOICE = 2.0 * float(np.log(FRAMES - 1))
"""Cost of a label frame in BIC, for the choice among all frames."""


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


@dataclass(frozen=True)
class Refit:
    """The refit of a model with a hypothesis at the noise of the previous fit, and the difference of BIC to that.

    A negative difference is better. Hypotheses `beside` it were added too. `tests` says that its score is its own, by
    the ratio of likelihoods.
    """

    scored: Scored
    fit: Fit
    delta_bic: float
    beside: tuple[Hypothesis, ...] = ()
    tests: bool = False

    @property
    def added(self) -> tuple[Hypothesis, ...]:
        """All hypotheses in it that the model lacked."""
        return (*self.beside, self.scored.hypothesis)

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.scored.hypothesis.name


@dataclass(frozen=True)
class Attempt:
    """Refits that may be worth making.

    Attributes:
        words: names of what they add.
        gain: foretold logarithm of the odds to the model; infinite if no linearisation can foretell it.
        refits: what makes them, each with another shape.
    """

    words: str
    gain: float
    refits: Sequence[Callable[[], Refit]]


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
    if not testable:
        return []
    return screened(model, testable, random_motion(model.fit) if motion is None else motion)[0]


def screened(model: Weighed, testable: Sequence[Hypothesis], motion: Motion) -> tuple[list[Scored], Screen]:
    """The same of hypotheses with strengths, at least one, and what foretells the gains of sets of them.

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


def retested(scored: Sequence[Scored], refits: Sequence[Refit]) -> list[Scored]:
    """Score tests, and the refits' own tests of what no score test sees, sorted as in `score_all`."""
    own = {r.name: r.scored for r in refits if r.tests}
    telling = {name: test for name, test in own.items() if test.p_value < ALARM}
    found = [telling.get(s.hypothesis.name, s) for s in scored]
    found += [test for name, test in own.items() if name not in {s.hypothesis.name for s in scored}]
    return sorted(found, key=lambda s: s.explained, reverse=True)


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


def refit_set(before: Fit, chosen: Sequence[Scored], step: Array, strengths: Array) -> Refit:
    """The fit with several hypotheses at the most probable unknowns of the linearised model.

    Args:
        before: the fit without them.
        chosen: the hypotheses and their score tests.
        step, strengths: as `Screen.step` gives them: a process for the fit then needs no screen, which is large.
    """
    problem, listed = before.problem, [one.hypothesis for one in chosen]
    for hypothesis in listed:
        problem = with_hypothesis(problem, hypothesis)
    parameters = dict(problem.model.named_parameters())
    absent = {name: float(parameters[name]) if name in parameters else 0.0 for h in listed for name in h.free()}
    names = [name for hypothesis in listed for name in hypothesis.columns]
    foretold = {
        name: float(np.clip(absent[name] + strength, problem.free[name].low, problem.free[name].high))
        for name, strength in zip(names, strengths.tolist(), strict=True)
    }
    moved, values = before.stepped(step), before.unknowns.values
    wider = Fit.at(problem, replace(before.unknowns, values={**values, **absent}), before.noise)
    after = followed(wider, replace(moved, values={**moved.values, **absent, **foretold}))
    if not np.isfinite(after.cost):  # too long a step: a flight missed its contact
        after = wider
    return Refit(chosen[-1], after, delta_bic(before, after), tuple(listed[:-1]))


def refit(before: Fit, scored: Scored) -> Refit:
    """The joint fit with a hypothesis in the model, a few steps from its absence, in its lowest shape.

    A usual effect (friction, say) is also started at its usual strength, for its absence may be a minimum of its own:
    without friction, the fitted spins contradict friction.

    Args:
        before: the fit without the hypothesis.
        scored: the hypothesis and its score test.
    """
    shaped = [replace(scored, hypothesis=shape) for shape in (scored.hypothesis, *scored.shapes)]
    return min((_refit(before, shape) for shape in shaped), key=lambda r: r.fit.cost)


def _refit(before: Fit, scored: Scored) -> Refit:
    hypothesis, problem = scored.hypothesis, with_hypothesis(before.problem, scored.hypothesis)
    parameters = dict(problem.model.named_parameters())
    absent = {name: float(parameters[name]) if name in parameters else 0.0 for name in hypothesis.free()}
    usual = absent | {hypothesis.parameter(n): hypothesis.coefficients[n].default for n in hypothesis.strengths}
    tried = [_started_at(before, hypothesis, problem, absent)]
    if usual != absent:
        tried.append(_started_at(before, hypothesis, problem, usual, USUAL_STEPS))
    after = min(tried, key=lambda fitted: fitted.cost)
    chosen = 0.0 if hypothesis.strengths else FRAME_CHOICE
    return Refit(scored, after, delta_bic(before, after) + chosen)


def _from(before: Fit, problem: Problem, unknowns: Unknowns, steps: int = FIRST_STEPS) -> Fit:
    """A few steps of a fit at the noise of the previous one."""
    return fit_problem(problem, unknowns, before.noise, settle_noise=False, steps=steps)


def _started_at(
    before: Fit, hypothesis: Hypothesis, problem: Problem, values: Mapping[str, float], steps: int = FIRST_STEPS
) -> Fit:
    """The fit of a problem with a hypothesis, started from the previous fit and some values of the hypothesis."""
    unknowns = replace(before.unknowns, values={**before.unknowns.values, **values})
    if hypothesis.shape and not hypothesis.strengths:
        unknowns = replace(unknowns, starts=_starts_with_labels(problem, unknowns.starts))
    return _from(before, problem, unknowns, steps)


def with_hypothesis(problem: Problem, hypothesis: Hypothesis) -> Problem:
    """The problem with an effect in its model and the effect's coefficients free."""
    return replace(
        problem,
        model=hypothesis.added_to(problem.model),
        free={**problem.free, **hypothesis.free()},
        deviations={**problem.deviations, **hypothesis.deviations()},
    )


def _starts_with_labels(problem: Problem, starts: Array) -> Array:
    """First states whose spins are the labels in a model's label frame."""
    with torch.no_grad():
        offset = problem.model.labelled(torch.zeros(3, dtype=torch.float64)).numpy()
        read = problem.model.labelled(torch.eye(3, dtype=torch.float64)).numpy() - offset  # rows M e_i
    labelled, moved = problem.stretches.labelled, starts.copy()
    moved[labelled, SPIN] = (problem.stretches.labels.numpy()[labelled] - offset) @ np.linalg.inv(read)
    return moved


def refit_driven(before: Fit, hypothesis: Hypothesis) -> Refit:
    """The fit with an effect that multiplies unlabelled spins, tested by the ratio of marginal likelihoods.

    A coefficient times a spin of mean zero has zero slope at zero. At its usual value the slope is nonzero, and
    launcher settings and single shots get their spins. They do so first, with a fixed coefficient: bounces alone may
    have given spins the wrong sign, which a free coefficient would adopt.
    """
    listed = {hypothesis.parameter(n): c for n, c in hypothesis.coefficients.items()}
    free = {**before.problem.free, **{name: listed[name] for name in hypothesis.columns}}
    model = with_effects(before.problem.model, hypothesis.effect())
    problem = replace(before.problem, model=model)
    held = fit_problem(problem, before.unknowns, before.noise, settle_noise=False)
    values = {name: c.default for name, c in listed.items()}
    unknowns = replace(held.unknowns, values={**held.unknowns.values, **values})
    after = fit_problem(replace(problem, free=free), unknowns, before.noise, settle_noise=False)
    taken = 2.0 * (_narrowness(after) - _narrowness(before))
    freedom = 3 * problem.stretches.settings.shape[1] + len(hypothesis.columns)
    return _by_likelihood(before, after, hypothesis, taken, freedom)


def refit_usual(before: Fit, hypothesis: Hypothesis) -> Refit:
    """The fit with a usual effect, whatever the result of its score test.

    The usual strength is far from absence, where the slope may carry no information. Without friction, for instance, a
    ball keeps its spin through a bounce, and nothing shows how friction would change the fitted spin.
    """
    after = refit(before, Scored(hypothesis, None, 1.0)).fit
    return _by_likelihood(before, after, hypothesis, 0.0, len(hypothesis.columns))


def _by_likelihood(before: Fit, after: Fit, hypothesis: Hypothesis, taken: float, freedom: int) -> Refit:
    """A refit tested by its likelihood ratio, less the part `taken` by spins that became free."""
    gain = 2.0 * (before.cost - after.cost) - taken
    estimate = np.array([after.unknowns.values[name] for name in hypothesis.columns])
    p_value = float(stats.chi2.sf(max(gain, 0.0), freedom))
    tracks = len(np.unique(after.problem.stretches.track))
    score = Score(estimate, np.full(len(estimate), np.nan), gain, p_value, freedom, tracks)
    return Refit(Scored(hypothesis, score, score.p_value), after, delta_bic(before, after) + taken, tests=True)


def _narrowness(fitted: Fit) -> float:
    """Half the log determinant of the information on first states. With the cost it gives the marginal likelihood.

    With a lift every spin is a degree of freedom of its flight, which also fits noise. This term is its cost, by
    Laplace's approximation.
    """
    return 0.5 * float(np.linalg.slogdet(fitted.linearised.start_information)[1].sum())


def delta_bic(before: Fit, after: Fit) -> float:
    """BIC of one fit minus that of another at the same noise, counted in tracks, the independent units."""
    more = len(after.problem.free) - len(before.problem.free)
    tracks = len(np.unique(before.problem.stretches.track))
    return 2.0 * (after.cost - before.cost) + more * float(np.log(tracks))
