"""Fits a declared model jointly: first states stretch by stretch, coefficients and launcher over all of them.

The method is Gauss-Newton with Levenberg's damping. Coefficients that the data cannot determine keep their declared
values by the priors of their effects.
"""

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from ballfg.arrays import Array, Mask
from ballfg.diagnosis.fit.free import Unknowns, declared_deviations, declared_free
from ballfg.diagnosis.fit.problem import Fit, Noise, Problem, Robust, scatter_axes
from ballfg.diagnosis.fit.sensitivity import Predicted, predict
from ballfg.diagnosis.fit.stretches import Stretches
from ballfg.diagnosis.fit.system import System
from ballfg.diagnosis.result import Value
from ballfg.dynamics import AnalyticModel
from ballfg.estimation import Settings
from ballfg.state import SPIN, STATE_DIM
from ballfg.tracks import Track

MOST_STEPS = 15  # Largest number of Gauss-Newton steps in one minimisation
CORRECTIONS = 2  # Number of corrections of first states that follow a step of all other unknowns
SCALE_ROUNDS = 3  # Number of minimisations, each with new noise and weights
SETTLED = 0.01  # Relative change of the noise below which it has converged
TOLERANCE = 1e-5  # Relative decrease of the objective below which a minimisation ends
FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e6
NORMAL_MEDIAN = 0.6745  # Median of the absolute value of a standard normal number
LEAST_SPREAD = 1e-3  # Share of the stated noise below which an axis counts as free of noise
LEAST_SPIN_SCATTER = 1.0  # rad/s. Least scatter of unlabelled spins


def fit_model(
    model: AnalyticModel,
    stretches: Stretches,
    settings: Settings,
    *,
    settle_noise: bool = True,
    tracks: Sequence[Track] = (),
) -> Fit:
    """Fits a model's coefficients to stretches, with all first states.

    Args:
        model: as declared; it is copied. Coefficients with a prior are estimated.
        stretches: the data. Stretches whose contacts the model does not reach from the first guess are left out.
        settings: of the dataset; the noise of spin labels and the prior of spins.
        settle_noise: True to estimate the scale of the noise too.
        tracks: of the stretches; needed if the model's coefficients differ between tracks.
    Returns: the minimum.
    """
    model = copy.deepcopy(model).requires_grad_(False)
    free, deviations, values = declared_deviations(model, tracks)
    problem = Problem(model, stretches, declared_free(model) | free, deviations=deviations)
    reached = reachable(model, stretches, problem.by_stretch(problem.declared | values))
    problem = replace(problem, stretches=reached)
    unknowns, noise = first_guess(problem, settings.spin_label_noise, settings.spin_prior)
    unknowns = replace(unknowns, values=unknowns.values | values)
    return fit_problem(problem, unknowns, noise, settle_noise=settle_noise)


def reachable(
    model: AnalyticModel, stretches: Stretches, values: Mapping[str, float | Array] | None = None
) -> Stretches:
    """The stretches whose contacts a model reaches from the first guess of their states.

    Args: values: fitted coefficients by parameter name, in place of the model's own.
    """
    predicted = predict(model, stretches, stretches.starts.numpy(), values or {})
    reached: Mask = np.asarray(np.isfinite(predicted.positions).all(axis=(1, 2)))
    return stretches.take(reached)


def first_guess(problem: Problem, label_noise: float, spin_prior: float) -> tuple[Unknowns, Noise]:
    """The smoother's first states and the declared coefficients; label_noise and spin_prior in rad/s."""
    launcher = np.zeros((problem.stretches.settings.shape[1], 3))
    unknowns = Unknowns(problem.stretches.starts.numpy().copy(), problem.declared, launcher)
    return unknowns, Noise(label=label_noise, spin=np.full(3, spin_prior))


def fit_problem(
    problem: Problem, unknowns: Unknowns, noise: Noise, *, settle_noise: bool = True, steps: int = MOST_STEPS
) -> Fit:
    """Minimises over all unknowns, and if `settle_noise` estimates the scale of the noise in turns.

    Args: unknowns: first guess. Every stretch must reach its contacts from there, as `reachable` ensures; else the
        result is the first guess itself, with infinite cost.  noise: scales to start from.  steps: at most so many.
    """
    result = _minimise(Fit.at(problem, unknowns, noise), steps)
    for _ in range(SCALE_ROUNDS if settle_noise else 0):
        before, noise = result.noise, _settled(result)
        result = _minimise(Fit.at(result.problem, result.unknowns, noise))
        ratios = np.append(noise.position / before.position, noise.spin / before.spin)
        if bool(np.abs(np.log(ratios)).max() < SETTLED):
            break
    return result


def followed(fit: Fit, unknowns: Unknowns) -> Fit:
    """The fit at other common unknowns, its first states those whose paths come closest to the samples.

    Its cost is infinite if a path misses a contact.  Args: unknowns: their first states are not used.
    """
    names, system = fit.problem.free, fit.linearised
    values = np.array([unknowns.values[name] - fit.unknowns.values[name] for name in names])
    step = np.concatenate((values, (unknowns.launcher - fit.unknowns.launcher).ravel()))
    expected = system.residual - system.by_common @ step
    none = np.zeros(len(fit.unknowns.starts))
    for place, name in enumerate(names):
        if name in unknowns.own or name in fit.unknowns.own:
            moved_own = unknowns.own.get(name, none) - fit.unknowns.own.get(name, none)
            expected = expected - system.by_common[..., place] * moved_own[:, None]
    starts = fit.unknowns.starts + system.start_correction(expected)
    moved = Fit.at(fit.problem, replace(unknowns, starts=starts), fit.noise)
    for _ in range(CORRECTIONS):
        moved = _followed_up(moved, system, fit.robust)
    return moved


def values_of(fit: Fit, names: Iterable[str], declared: Mapping[str, float]) -> dict[str, Value]:
    """Fitted coefficients with their standard deviations, by parameter name.

    Args: names: of coefficients.  declared: values that the model stated before the fit, for a part of them.
    """
    names = list(names)
    sigmas = dict(zip(names, np.sqrt(np.diagonal(covariance_of(fit, names))).tolist(), strict=True))
    free = fit.problem.free
    return {name: Value(fit.unknowns.values[name], sigmas[name], free[name].unit, declared.get(name)) for name in names}


def covariance_of(fit: Fit, names: Sequence[str]) -> Array:
    """(p, p) covariance of fitted coefficients from the noise, with all else free; names: p parameters."""
    total = fit.gram.sum(axis=0)[:-1, :-1] + np.diag(fit.problem.common_precision)
    listed = list(fit.problem.free)
    chosen = [listed.index(name) for name in names]
    return np.asarray(np.linalg.inv(total)[np.ix_(chosen, chosen)])


def alike(fit: Fit) -> Fit:
    """The fit with the same coefficients for all tracks, with paths that come closest to the samples."""
    if not fit.unknowns.own:
        return fit
    near = followed(fit, replace(fit.unknowns, own={}))
    found = fit_problem(replace(near.problem, shared=False), near.unknowns, near.noise, settle_noise=False)
    return replace(found, problem=replace(found.problem, shared=fit.problem.shared))


def _minimise(now: Fit, steps: int = MOST_STEPS) -> Fit:
    damping = FIRST_DAMPING
    for _ in range(steps if np.isfinite(now.cost) else 0):
        now = with_guesses(now)
        moved, damping = _step(now, damping)
        if moved is None:
            break
        gain, now = now.cost - moved.cost, moved
        if gain < TOLERANCE * max(1.0, now.cost):
            break
    return now


def with_guesses(now: Fit) -> Fit:
    """The fit with its own contacts as first guesses of those that follow."""
    stretches, found = now.problem.stretches, torch.from_numpy(now.predicted.contacts)
    guesses = torch.where(found.isnan(), stretches.contacts, found)
    return replace(now, problem=replace(now.problem, stretches=replace(stretches, contacts=guesses)))


def _step(now: Fit, damping: float) -> tuple[Fit | None, float]:
    """The fit after one step, None if no damping lowers the objective; and the damping of the next step."""
    system, first = now.linearised, damping
    while damping < LARGEST_DAMPING:
        moved = _followed_up(_moved(now, system, damping), system, now.robust)
        if moved.cost < now.cost:
            return moved, 0.1 * damping if damping == first else damping
        damping *= 10.0
    return None, damping


def _moved(now: Fit, system: System, damping: float) -> Fit:
    """The fit after a damped Gauss-Newton step; coefficients stay within their bounds."""
    problem, unknowns = now.problem, now.unknowns
    precision = problem.common_precision
    values = np.array([unknowns.values[name] for name in problem.free])
    pull = precision * np.concatenate((problem.centres - values, -unknowns.launcher.ravel()))
    eliminated = system.eliminated(damping)
    step = eliminated.common_step(precision, pull, *now.limits, damping) if problem.shared else np.zeros_like(pull)
    starts = unknowns.starts + eliminated.start_step(step)
    return Fit.at(problem, replace(now.stepped(step), starts=starts), now.noise)


def _followed_up(moved: Fit, system: System, weights: Robust) -> Fit:
    """The fit after a further correction of the first states, following a step of all unknowns.

    They can absorb most of what the linearised problem leaves out: the product of a step of coefficients and one of
    states. The derivatives stay; a stretch without a gain keeps its state.
    """
    correction = system.start_correction(moved.weighted_residual(weights))
    unknowns = replace(moved.unknowns, starts=moved.unknowns.starts + correction)
    closer = Fit.at(moved.problem, unknowns, moved.noise)
    gains = closer.robust.losses < moved.robust.losses
    starts = np.where(gains[:, None], unknowns.starts, moved.unknowns.starts)
    one, other = closer.predicted, moved.predicted
    predicted = Predicted(
        np.where(gains[:, None, None], one.positions, other.positions),
        np.where(gains[:, None], one.labels, other.labels),
        np.where(gains[:, None], one.contacts, other.contacts),
    )
    return replace(moved, unknowns=replace(unknowns, starts=starts), predicted=predicted)


def _settled(result: Fit) -> Noise:
    """Noise from the residuals: their median absolute deviation, corrected for the degrees of freedom of the states.

    One scale serves all axes: missing physics often acts along one of them, which would count as noisy and hide it.
    Axes without any noise were not measured (a ball that is dropped along x = y = 0): they do not count.
    """
    whitened = result.whitened[result.problem.stretches.used.numpy()]
    measured = [axis for axis in range(3) if _spread(result, whitened[:, axis]) > LEAST_SPREAD]
    position = result.noise.position * _spread(result, whitened[:, measured] if measured else whitened)
    return replace(result.noise, position=np.maximum(position, LEAST_SPREAD), spin=_spin_scatter(result))


def noise_by_axis(result: Fit) -> Array:
    """(3,) m: median distance between measured and fitted positions along each axis, over all samples."""
    used = result.problem.stretches.used.numpy()
    residual = result.whitened[used] * result.sigmas[used]
    return np.array([_spread(result, residual[:, axis]) for axis in range(3)])


def _spread(result: Fit, residuals: Array) -> float:
    """Median absolute deviation as a standard deviation, corrected for the degrees of freedom of the states."""
    used = result.problem.stretches.used.numpy()
    taken = (STATE_DIM - 3) * len(used) / (3.0 * used.sum())
    return float(np.median(np.abs(residuals)) / NORMAL_MEDIAN / np.sqrt(1.0 - taken))


def _spin_scatter(result: Fit) -> Array:
    """(3,) rad/s: roots of the expected squares of unlabelled spins about their launcher's mean, one step of EM."""
    unlabelled = ~result.problem.stretches.labelled
    if not unlabelled.any():
        return result.noise.spin
    axes = scatter_axes(result.unknowns.starts[unlabelled])
    covariance = np.linalg.inv(result.linearised.start_information[unlabelled])[:, SPIN, SPIN]
    about = result.whitened_spins[unlabelled] * result.noise.spin
    square = about**2 + np.diagonal(axes @ covariance @ axes.swapaxes(1, 2), axis1=-2, axis2=-1)
    return np.maximum(np.sqrt(square.mean(axis=0)), LEAST_SPIN_SCATTER)
