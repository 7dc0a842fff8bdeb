"""Describes a pattern that no named effect explains by a model that predicts better, without a name.

A few generic terms come first, because they are readable. Only if they do not help, a network corrects the model.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np

from ballfg.diagnosis.fit.holdout import EvaluationTrack
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.residual_tests.sparse import SparseTerms, fit_with_terms, sparse_terms
from ballfg.diagnosis.result import Errors, Fallback
from ballfg.diagnosis.search.process_noise import calibrated_model, noise_about
from ballfg.dynamics import AnalyticModel, Architecture, BallModel, build
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.estimation import Settings, Smoother, dataset_settings, dataset_surfaces
from ballfg.estimation.batch import do_all
from ballfg.estimation.measurement.as_measured import plainly_measured
from ballfg.estimation.measurement.invert_measurement import InvertMeasurement
from ballfg.estimation.noise.estimate import spread_over
from ballfg.learning.config.training import LossConfig, OptimizerConfig, TrainConfig
from ballfg.learning.end_to_end.end_to_end import EndToEnd
from ballfg.learning.end_to_end.learnables import Learnables, NoiseScales
from ballfg.learning.run.loop import Task, Training, TrainingStoppedError
from ballfg.learning.run.ranks import Ranks
from ballfg.learning.shots import TrainingShot, shots_of
from ballfg.progress import unwatched
from ballfg.tracks import Dataset, Track
from ballfg.tracks.noise import TrackNoise

HELPS = 0.9
"""Ratio of the prediction errors on the held-out half with and without an accepted fallback."""
OBSERVED = 0.4
"""Observed share of a typical track in training; the network learns to predict the rest."""
VALIDATES = 5
"""One in this number of tracks selects the best epoch of the network."""
LEAST_LEARNED = 10
"""Least number of shots for the training of a network."""
MOST_LEARNED = 20
"""Largest number of tracks for the training, evenly spread."""
EPOCHS = 30
"""Epochs of the training: half a minute."""
POSITION_SCALE = 0.03
"""m, prediction error beyond which a track's loss grows only linearly, so that a few tracks cannot dominate."""


def fallback(
    before: Fit,
    embedding: SpinEmbedding,
    noise: TrackNoise | None,
    dataset: Dataset,
    parts: Sequence[EvaluationTrack],
    now: Errors,
    evaluate: Callable[[BallModel], Errors],
    jobs: int = 1,
) -> Fallback | None:
    """A description of the rest without a name; None if nothing predicts better.

    The previous fit and the tracks are those of the search half, with their noise. The errors `now`, of the model so
    far, and those from `evaluate` are those on the held-out half. With several `jobs` both kinds are computed in
    parallel; readable terms still come first.
    """
    makers = [partial(make, before, embedding, noise, dataset, parts) for make in (_with_terms, _with_network)]
    together = do_all(makers, jobs) if jobs > 1 else (make() for make in makers)
    for kind, made in zip(("sparse terms", "learned residual"), together, strict=False):
        if made is None:
            continue
        model, words = made
        errors = evaluate(model)
        if errors.prediction_rmse_mm < HELPS * now.prediction_rmse_mm:
            return Fallback(kind, words, now, errors, model)
    return None


def _with_terms(
    before: Fit, embedding: SpinEmbedding, noise: TrackNoise | None, dataset: Dataset, parts: Sequence[EvaluationTrack]
) -> tuple[BallModel, str] | None:
    """A model with a few generic terms, and their description."""
    terms = sparse_terms(before)
    if terms is None:
        return None
    after = fit_with_terms(before, terms)
    model = calibrated_model(after, embedding)
    model.noise = noise_about(model, parts, dataset, noise)
    return model, describe(terms, after)


def _with_network(
    before: Fit, embedding: SpinEmbedding, noise: TrackNoise | None, dataset: Dataset, parts: Sequence[EvaluationTrack]
) -> tuple[BallModel, str] | None:
    """A model corrected by a network, and its size in words."""
    base = calibrated_model(before, embedding)
    base.noise = noise
    network = learned_residual(base, dataset, [p.track for p in spread_over(parts, len(parts), MOST_LEARNED)])
    if network is None:
        return None
    network.noise = noise_about(network, parts, dataset, noise)
    size = sum(p.numel() for p in (*network.flight.parameters(), *network.contact.parameters()))
    return network, f"{network.architecture.kind}, {size} parameters"


def describe(terms: SparseTerms, after: Fit) -> str:
    """The terms with their fitted coefficients, sorted by explained residual."""
    units = after.problem.model.declared_coefficients()
    values = {name: after.unknowns.values[name] for name in terms.estimates}
    return ", ".join(f"{name.split('.', 1)[1]} = {value:.3g} {units[name].unit}" for name, value in values.items())


def learned_residual(
    base: AnalyticModel, dataset: Dataset, tracks: Sequence[Track], *, epochs: int = EPOCHS
) -> LearnedModel | None:
    """A network that corrects a model, trained end to end on tracks.

    Args:
        base: calibrated; its noise and launcher stay.
        dataset: the origin of the tracks.
        tracks: to learn from.
        epochs: of the training.
    Returns: the corrected model; None if there are too few tracks or the training fails.
    """
    tracks, settings = _as_happened(base, dataset, tracks)
    if len(tracks) < LEAST_LEARNED:
        return None
    seconds = OBSERVED * float(np.median([track.duration for track in tracks]))
    plain = cast(AnalyticModel, plainly_measured(base))
    made = shots_of(tracks, plain, dataset_surfaces(dataset), settings, samples=None, seconds=seconds)
    shots = [shot for _, shot in made if isinstance(shot, TrainingShot)]
    if len(shots) < LEAST_LEARNED:
        return None
    model = build(Architecture.of("mnn+gs", residual=True), radius=base.radius, base=plain, seed=0)
    launcher = None if settings.launcher is None else settings.launcher.embedding
    noise = NoiseScales(settings.process, position=settings.position_scale, learned=False)
    loss = LossConfig(position_scale=POSITION_SCALE)
    trainee = EndToEnd(shots, Learnables(model, launcher, noise), loss)
    config = TrainConfig(optimizer=OptimizerConfig(epochs=epochs), loss=loss)
    validation = tuple(range(len(shots))[VALIDATES - 1 :: VALIDATES])
    train = tuple(n for n in range(len(shots)) if n not in validation)
    training = Training(Task(trainee, train, validation, config, Ranks(), unwatched))
    try:
        for _ in training.epochs():
            pass
    except TrainingStoppedError:
        return None
    training.take_best()
    model.base, model.trained = base, base.trained
    return model.requires_grad_(False)


def _as_happened(base: AnalyticModel, dataset: Dataset, tracks: Sequence[Track]) -> tuple[list[Track], Settings]:
    """Tracks with the model's measurement effects undone, if possible, and the settings for them."""
    settings = replace(dataset_settings(dataset, base), coefficients={})  # the network replaces them
    if base.measures_plainly:
        return list(tracks), settings
    through = InvertMeasurement(Smoother, base, dataset_surfaces(dataset), settings)
    undone = [through.undo(track) for track in tracks]
    return [u.track for u in undone if u.settled], through.smoother.settings
