"""Describes a pattern that no named effect explains by a few generic terms, if the model then predicts better."""

from collections.abc import Callable, Sequence

from ballfg.diagnosis.fit.holdout import EvaluationTrack
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.residual_tests.sparse import SparseTerms, fit_with_terms, sparse_terms
from ballfg.diagnosis.result import Errors, Fallback
from ballfg.diagnosis.search.process_noise import next_shot_model, noise_about
from ballfg.dynamics import AnalyticModel, BallModel
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.tracks import Dataset

HELPS = 0.9
"""Ratio of the prediction errors on the held-out half with and without an accepted fallback."""


def fallback(
    before: Fit,
    embedding: SpinEmbedding,
    corrected: AnalyticModel,
    dataset: Dataset,
    parts: Sequence[EvaluationTrack],
    now: Errors,
    evaluate: Callable[[BallModel], Errors],
) -> Fallback | None:
    """A description of the rest without a name; None if nothing predicts better.

    The previous fit and the tracks are those of the search half; `corrected` is the model of that fit, with its noise.
    Its errors `now` and those from `evaluate` are those on the held-out half.
    """
    terms = sparse_terms(before)
    if terms is None:
        return None
    after = fit_with_terms(before, terms)
    model = next_shot_model(after, embedding, corrected)
    model.noise = noise_about(model, parts, dataset, corrected.noise)
    errors = evaluate(model)
    if errors.prediction_rmse_mm >= HELPS * now.prediction_rmse_mm:
        return None
    return Fallback("sparse terms", describe(terms, after), now, errors, model)


def describe(terms: SparseTerms, after: Fit) -> str:
    """The terms with their fitted coefficients, sorted by explained residual."""
    units = after.problem.model.declared_coefficients()
    values = {name: after.unknowns.values[name] for name in terms.estimates}
    return ", ".join(f"{name.split('.', 1)[1]} = {value:.3g} {units[name].unit}" for name, value in values.items())
