"""Finds the spin labels that contradict their flights, with probabilities.

All labels of a recording determine together what share of them is wrong and by how much right and wrong ones err, so
that a single doubtful one among many does not count (docs/derivations/diagnosis.md).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.holdout import EvaluationTrack, Holdout
from ballfg.diagnosis.generic_test import GenericTest, LabelCheck, LabelVerdict
from ballfg.diagnosis.hypotheses.hypothesis import with_effects
from ballfg.diagnosis.residual_tests.label_flights import LabelledFlight, labelled_flights
from ballfg.diagnosis.search.evaluation import noise_about
from ballfg.dynamics import AnalyticModel
from ballfg.estimation import Settings, Status, dataset_settings
from ballfg.estimation.batch import estimate_tracks
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.coefficients import choose, values_of, with_values
from ballfg.learning.calibration.population import evidence, fit_population
from ballfg.tracks.noise import TrackNoise

LABEL: Final = "label"  # Kind of the test
NONE_WRONG: Final = 0.5
"""Prior probability that all labels are right; else all shares of wrong ones are equally probable."""
SHARES: Final = (np.arange(40) + 0.5) / 40  # Shares of wrong labels, the middles of fortieths
RIGHT: Final = np.exp(np.linspace(0.0, 1.4, 8))
"""Errors of right labels, as multiples of the stated ones: up to four times."""
RIGHT_SPREAD: Final = 0.7
"""Standard deviation of the logarithm of such a multiple: stated noise is known to a factor of two."""
WRONG: Final = np.exp(np.linspace(-1.1, 1.1, 9))
"""Errors of wrong labels, as multiples of `wrong_error`: a third to three times."""

MOST_ROUNDS = 5  # Largest number of fits of the population; usual are three, from coefficients far off
SETTLED = 0.1  # Change of the population's mean, in standard errors, below which it has converged


def check_labels(
    model: AnalyticModel, declared: AnalyticModel, holdout: Holdout, tracker: TrackNoise | None = None, *, jobs: int = 1
) -> LabelCheck | None:
    """Computes the verdicts on all spin labels of a dataset.

    Args:
        model: corrected by the diagnosis, fitted to the tracks.
        declared: the model before the diagnosis.
        holdout: the tracks of both halves.
        tracker: memory of the tracker and jitter of the stamps, if found.
        jobs: processes.
    Returns: None without labels.
    """
    return judged(label_evidence(model, declared, holdout, tracker, jobs=jobs))


def label_evidence(
    model: AnalyticModel, declared: AnalyticModel, holdout: Holdout, tracker: TrackNoise | None = None, *, jobs: int = 1
) -> list[LabelledFlight]:
    """The labels with the spins of their flights, from the arguments of `check_labels`."""
    parts = (*holdout.search_tracks, *holdout.held_out_tracks)
    tracks = sorted((p for p in parts if p.track.spin_label is not None), key=lambda p: p.track.name)
    if not tracks:
        return []
    ball, settings = scattering_model(model, declared, tracks, holdout, tracker, jobs=jobs)
    return labelled_flights(ball, holdout.surfaces, settings, tracks, jobs)


def scattering_model(
    model: AnalyticModel,
    declared: AnalyticModel,
    tracks: Sequence[EvaluationTrack],
    holdout: Holdout,
    tracker: TrackNoise | None = None,
    *,
    jobs: int = 1,
) -> tuple[AnalyticModel, Settings]:
    """A corrected model with refitted coefficients, and the settings for predictions with it.

    If bounces scatter, the diagnosis' own deterministic fit adapts coefficients and spins to them, and right labels
    seem wrong. Here each track with a spin label is smoothed with process noise, and the declared coefficients of
    flight and bounce are the mean of a population; added effects and values that differ between tracks stay.
    """
    plain = with_effects(model)
    plain.variations = model.variations
    usual = dataset_settings(holdout.dataset, plain)  # no noise is stated in this model
    names = [n for n in declared_free(declared) if not n.startswith("measurement.") and n not in model.variations]
    if names:
        plain = _of_population(plain, declared, names, tracks, holdout, usual, jobs)
    plain.noise = noise_about(plain, tracks, holdout.dataset, tracker, jobs=jobs)
    settings = dataset_settings(holdout.dataset, plain)
    # the labels' estimated error includes wrong labels: right ones have the dataset's error
    return plain, replace(settings, spin_label_noise=usual.spin_label_noise)


def _of_population(
    model: AnalyticModel,
    declared: AnalyticModel,
    names: Sequence[str],
    tracks: Sequence[EvaluationTrack],
    holdout: Holdout,
    settings: Settings,
    jobs: int,
) -> AnalyticModel:
    chosen, mean = choose(declared, names), values_of(model, names)
    priors = {**settings.coefficients, **dict(zip(names, chosen.sigma.tolist(), strict=True))}
    for _ in range(MOST_ROUNDS):
        moving = with_values(model, names, mean)
        smoother = make_estimator("smoother", moving, holdout.surfaces, replace(settings, coefficients=priors))
        estimates = estimate_tracks(smoother, (part.track for part in tracks), len(tracks), jobs)
        found = []
        for estimate in (e for e in estimates if e.status is Status.OK):
            columns = [estimate.coefficient_names.index(name) for name in names]
            covariance = estimate.coefficient_covariance[np.ix_(columns, columns)]
            found.append(evidence(estimate.coefficients[columns], covariance, mean, chosen.sigma))
        if not found:
            return model
        population = fit_population(found, chosen.start, chosen.sigma, chosen.low, chosen.high)
        before, mean = mean, population.mean
        if np.abs((mean - before) / population.sigma).max() < SETTLED:
            break
    return with_values(model, names, mean)


def judged(flights: Sequence[LabelledFlight]) -> LabelCheck | None:
    """The verdicts on labels with their flights; None without labels."""
    if not flights:
        return None
    right = np.stack([f.right.log_densities(RIGHT * f.right.error) for f in flights])
    errors = [np.hypot(RIGHT[:, None] * f.right.error, WRONG * f.wrong.error) for f in flights]  # of wrong labels
    wrong = np.stack([f.wrong.log_densities(e.ravel()) for f, e in zip(flights, errors, strict=True)])
    probability, p_all_right = _mixture(right, wrong)
    verdicts = [
        LabelVerdict(f.name, p, f.wrong.off, f.wrong.off_sigma)
        for f, p in zip(flights, probability.tolist(), strict=True)
    ]
    return LabelCheck(p_all_right, tuple(sorted(verdicts, key=lambda v: (-v.probability, -v.off))))


def label_test(check: LabelCheck, before: LabelCheck | None = None) -> GenericTest:
    """The check as a test; before: of the declared model, for the share of contradicted labels."""
    now = len(check.contradicted)
    whole = now if before is None else max(now, len(before.contradicted))
    return GenericTest(LABEL, check.where, check.p_all_right, now / whole if whole else 0.0)


def _mixture(right: Array, wrong: Array) -> tuple[Array, float]:
    """Probability (n,) that each label is wrong, and that none is.

    Args: right: (n, r) log densities of labels that err by `RIGHT`.  wrong: (n, r w) of wrong ones.
    """
    wrong = wrong.reshape(*right.shape, -1)
    stated = np.exp(-0.5 * (np.log(RIGHT) / RIGHT_SPREAD) ** 2)
    prior = np.log(stated / stated.sum())
    least = np.maximum(right.max(axis=1), wrong.max(axis=(1, 2)))[:, None]
    as_right, as_wrong = right - least, wrong - least[..., None]
    one, other = np.log1p(-SHARES), np.log(SHARES)
    each_wrong = other + as_wrong[..., None]  # (n, r, w, shares)
    either = np.logaddexp(one + as_right[:, :, None, None], each_wrong)
    some = either.sum(axis=0) + prior[:, None, None] - np.log(len(WRONG) * len(SHARES)) + np.log1p(-NONE_WRONG)
    none = as_right.sum(axis=0) + prior + np.log(NONE_WRONG)
    top = max(some.max(), none.max())
    weights, sure = np.exp(some - top), np.exp(none - top).sum()
    total = weights.sum() + sure
    return (np.exp(each_wrong - either) * weights).sum(axis=(1, 2, 3)) / total, float(sure / total)
