"""Refits a model with further effects or labels in another frame, and says which refits may be worth their time."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import stats

from ballfg.arrays import Array
from ballfg.diagnosis.fit.effects import with_effects
from ballfg.diagnosis.fit.fit import alike, fit_problem, followed
from ballfg.diagnosis.fit.problem import LABEL_LOSS, Fit, Problem
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.search.score import ALARM, Score, Scored
from ballfg.dynamics.effects.measurement import signed_permutations
from ballfg.state import SPIN

FIRST_STEPS, USUAL_STEPS = 2, 6
"""Largest number of steps of a refit from absence, and from the usual strength, which all spins must follow.

They lead near the minimum of the deterministic fit, and the likelihood leads on from there. At that minimum itself a
model that lacks something else has strengths that random motion does not need, often in the range of another maximum.
"""
UNLABELLED_SPIN = 200.0  # rad/s, prior of a spin about zero without labels
FRAMES = 48  # Number of exchanges and reversals of axes, including the identity
FRAMES_FITTED = 2  # Number of frames that are fitted in full
FRAME_CHOICE = 2.0 * float(np.log(FRAMES - 1))  # Cost of a label frame in BIC, for the choice among all frames


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
    """Refits that may be worth making."""

    words: str  # Names of what they add
    gain: float  # Foretold logarithm of the odds to the model; infinite if no linearisation can foretell it
    refits: Sequence[Callable[[], Refit]]  # What makes them, each with another shape


def retested(scored: Sequence[Scored], refits: Sequence[Refit]) -> list[Scored]:
    """Score tests, and the refits' own tests of what no score test sees, sorted as in `score_all`."""
    own = {r.name: r.scored for r in refits if r.tests}
    telling = {name: test for name, test in own.items() if test.p_value < ALARM}
    found = [telling.get(s.hypothesis.name, s) for s in scored]
    found += [test for name, test in own.items() if name not in {s.hypothesis.name for s in scored}]
    return sorted(found, key=lambda s: s.explained, reverse=True)


def refit_set(before: Fit, chosen: Sequence[Scored], step: Array, strengths: Array) -> Refit:
    """The fit with several hypotheses at the most probable unknowns of the linearised model.

    Args: step, strengths: as `Screen.step` gives them: a process for the fit then needs no screen, which is large.
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

    Args: before: the fit without the hypothesis.  scored: the hypothesis and its score test.
    """
    before = alike(before)
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


def _started_at(
    before: Fit, hypothesis: Hypothesis, problem: Problem, values: Mapping[str, float], steps: int = FIRST_STEPS
) -> Fit:
    """A few steps from the previous fit and some values of the hypothesis, at the noise of that fit."""
    unknowns = replace(before.unknowns, values={**before.unknowns.values, **values})
    if hypothesis.shape and not hypothesis.strengths:
        unknowns = replace(unknowns, starts=_starts_with_labels(problem, unknowns.starts))
    return fit_problem(problem, unknowns, before.noise, settle_noise=False, steps=steps)


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
    before = alike(before)
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
    before = alike(before)
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
    """Half the log determinant of the information on first states; with the cost, the marginal likelihood (Laplace).

    It is what spins cost that become degrees of freedom of their flights, which also fit noise.
    """
    return 0.5 * float(np.linalg.slogdet(fitted.linearised.start_information)[1].sum())


def delta_bic(before: Fit, after: Fit) -> float:
    """BIC of one fit minus that of another at the same noise, counted in tracks, the independent units."""
    more = len(after.problem.free) - len(before.problem.free)
    tracks = len(np.unique(before.problem.stretches.track))
    return 2.0 * (after.cost - before.cost) + more * float(np.log(tracks))


def frame_hypotheses(before: Fit, general: Hypothesis) -> list[Hypothesis]:
    """The frames of the labels, with other axes or signs, that agree best with the flights.

    Such a change is too large for a score test. Spins are estimated from the flights alone, with the declared
    coefficients: those fitted to wrong labels would be wrong too.  Args: general: the hypothesis of any other frame.
    """
    spins, covariances, labels = _spins_without_labels(before)
    frames = signed_permutations().numpy()[1:]
    costs = [_disagreement(labels, spins, covariances, frame, before.noise.label) for frame in frames]
    best = frames[np.argsort(costs)[:FRAMES_FITTED]].reshape(-1, 9).tolist()
    shapes = [dict(zip(general.coefficients, frame, strict=True)) for frame in best]
    return [Hypothesis(general.effect, shape, (), FRAMES - 1) for shape in shapes]


def _spins_without_labels(before: Fit) -> tuple[Array, Array, Array]:
    """(n, 3) spins from the flights alone, their covariances (n, 3, 3) and labels (n, 3), of labelled stretches."""
    problem = before.problem
    labelled = problem.stretches.take(problem.stretches.labelled)
    bare = replace(labelled, labels=torch.full_like(labelled.labels, torch.nan), settings=0.0 * labelled.settings)
    starts = before.unknowns.starts[problem.stretches.labelled]
    unknowns = replace(before.unknowns, starts=starts, values=problem.declared, own={})
    alone = replace(problem, stretches=bare, shared=False)
    result = fit_problem(alone, unknowns, replace(before.noise, spin=np.full(3, UNLABELLED_SPIN)), settle_noise=False)
    covariances = np.linalg.inv(result.linearised.start_information)[:, SPIN, SPIN]
    return result.unknowns.starts[:, SPIN], np.asarray(covariances), labelled.labels.numpy()


def _disagreement(labels: Array, spins: Array, covariances: Array, frame: Array, noise: float) -> float:
    """Robust squared distance between spins and labels in a frame (3, 3)."""
    covariance = frame @ covariances @ frame.T + noise**2 * np.eye(3)
    apart = labels - spins @ frame.T
    square = (apart * np.linalg.solve(covariance, apart[..., None])[..., 0]).sum(axis=-1)
    robust = 2.0 * LABEL_LOSS.value(np.sqrt(square)) + np.linalg.slogdet(covariance)[1]
    return float(robust.sum())
