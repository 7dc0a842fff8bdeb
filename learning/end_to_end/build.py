"""Builds a model of the dynamics from a config, for training through the estimator."""

import copy
from collections.abc import Iterable
from dataclasses import replace
from typing import ClassVar, Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics import BallModel
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import build as build_model
from ballfg.dynamics.networks.spin_embedding import SPIN_UNIT, SpinEmbedding
from ballfg.estimation import Smoother, Status
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.end_to_end.end_to_end import EndToEnd
from ballfg.learning.end_to_end.learnables import Learnables, NoiseScales
from ballfg.learning.end_to_end.pretrain import Anchor, pretrain
from ballfg.learning.gradient.implicit import GaussNewtonGradient, ImplicitGradient, UnrolledGradient
from ballfg.learning.trainee import NETWORKS, Prepared, TraineeKind
from ballfg.learning.training_data import TrainingShot, read_training_data
from ballfg.progress import doing
from ballfg.state import SPIN, VELOCITY

GRADIENTS: dict[str, type[ImplicitGradient | UnrolledGradient]] = {
    "implicit": ImplicitGradient,
    "gauss-newton": GaussNewtonGradient,
    "unrolled": UnrolledGradient,
}


def _model(config: TrainConfig, analytic: AnalyticModel) -> BallModel:
    if config.kind not in NETWORKS:
        return analytic
    chosen = config.architecture.model_dump(exclude_none=True, exclude={"pretrain"})
    architecture = Architecture.of(config.kind, **chosen)  # type: ignore[arg-type]
    base = analytic if architecture.residual else None
    model = build_model(architecture, radius=analytic.radius, base=base, seed=config.seed)
    if base is None and config.architecture.pretrain:
        with doing("fitting the networks to the analytic model"):
            left = pretrain(model, analytic, config.seed, config.architecture.pretrain)
        print(f"networks fitted to the analytic model: {left:.2g} m/s^2, 0.1 m/s, 10 rad/s left", flush=True)
    return model


class Network(TraineeKind):
    """A network for the dynamics, trained through the estimator."""

    unused: ClassVar[tuple[str, ...]] = ("options",)

    @classmethod
    def build(cls, config: TrainConfig) -> Prepared:
        """The model with its data, ready to train. Raises: ValueError, FileNotFoundError: bad input."""
        data = read_training_data(config)
        if data.embedding is not None and config.launcher.start == "tracks":
            begin_with_tracks(data.embedding, [data.shots[k] for k in data.train], data.analytic)
        process, scale = data.shots[0].settings.process, config.noise.position_scale or 1.0
        noise = NoiseScales(process, position=scale, learned=config.loss.likelihood > 0.0)
        untrained = None
        if config.kind in NETWORKS:
            alone = Learnables(*copy.deepcopy((data.analytic, data.embedding, noise)))
            untrained = EndToEnd(data.shots, alone, config.loss)
        model = _model(config, data.analytic)
        trainee = EndToEnd(
            data.shots,
            Learnables(model, data.embedding, noise),
            config.loss,
            method=GRADIENTS[config.gradient](),
            seed=config.seed,
            augment=config.augmented,
            anchor=Anchor(model, data.analytic, config.seed) if config.loss.anchor > 0.0 else None,
            coefficient_step=config.optimizer.coefficient_step,
            noise_step=config.optimizer.noise_step,
            fades=data.train,
            held_out=data.validation,
            untrained=untrained,
        )
        return Prepared(trainee, data.train, data.validation)


class ATune(Network):
    """The coefficients of the analytic model."""

    name = "a-tune"
    unused = ("architecture", "options")
    augmented = True


class Mlp(Network):
    """A network on raw states, which learns the symmetry of the room from rotated and shifted tracks."""

    name = "mlp"
    augmented = True


class MlpGramSchmidt(Network):
    """A network on Gram-Schmidt features, which do not change with a rotation or a shift."""

    name = "mlp+gs"


class SkipGramSchmidt(Network):
    """The same with skip connections."""

    name = "skip+gs"


class MnnGramSchmidt(Network):
    """The same with multiplications of hidden states."""

    name = "mnn+gs"


SPIN_PRIOR: Final = 150.0  # rad/s, standard deviation of the prior: launchers reach this spin
LEAST_SPEED: Final = 0.5  # m/s of horizontal motion below which a launch has no forward direction


def begin_with_tracks(embedding: SpinEmbedding, shots: Iterable[TrainingShot], model: AnalyticModel) -> None:
    """Set an embedding to the spins that a model finds in whole tracks, by least squares over their settings.

    Without spin labels only the flight shows the spin: from no spin, learning needs many epochs to reach 150 rad/s, and
    a group of shots may end with the wrong sign. An analytic model of a whole track is right within some 10 rad/s.

    Shots with a spin label, or without all settings, are skipped; where none is left the embedding stays as it is.
    Coefficients of the model that vary from track to track are estimated too.
    """
    settings, spins = [], []
    for shot in shots:
        told = None if shot.settings.launcher is None else shot.settings.launcher.settings(shot.track)
        spin = None if told is None else _spin(shot, model)
        if told is not None and spin is not None:
            settings.append(told)
            spins.append(spin)
    if settings:
        weight = np.linalg.lstsq(np.stack(settings), np.stack(spins), rcond=None)[0].T / SPIN_UNIT
        with torch.no_grad():
            embedding.weight.copy_(torch.from_numpy(weight))


def _spin(shot: TrainingShot, model: AnalyticModel) -> Array | None:
    """(3,) rad/s about forward, across and up at the first sample; None for a failed estimate or a slow launch."""
    wide = replace(shot.settings, launcher=None, coefficients=coefficient_sigmas(model), spin_prior=SPIN_PRIOR)
    estimate = Smoother(model, shot.surfaces, wide).estimate(shot.track)
    velocity, spin = estimate.states[0, VELOCITY], estimate.states[0, SPIN]
    speed = float(np.hypot(velocity[0], velocity[1]))
    if estimate.status is not Status.OK or speed < LEAST_SPEED:
        return None
    x, y = velocity[:2] / speed
    return np.array([x * spin[0] + y * spin[1], x * spin[1] - y * spin[0], spin[2]])
