"""Reads and writes the learned part of a model file: a folder with `config.yaml` and `weights.safetensors`.

It uses safe loaders only. The folder's name ends with a digest of its content: a model file always names a complete
folder, and saving again never changes that folder.
"""

import hashlib
import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import safetensors.torch
import torch
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from ballfg.checks import shown
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.model import BASE, BallModel
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.fading import Fading
from ballfg.dynamics.networks.learned import LearnedModel, build
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.dynamics.nominal import TOLERANCE
from ballfg.dynamics.trained import Trained
from ballfg.files.strict_yaml import read_yaml
from ballfg.files.weights import read_tensors
from ballfg.files.whole_folder import whole_folder
from ballfg.tracks.noise import TrackNoise

CONFIG, WEIGHTS = "config.yaml", "weights.safetensors"
LEARNED = ".learned-"
"""Part of a folder's name, between the stem of the model file that named it first and the digest of its content."""
_MODEL, _LAUNCHER = "model.", "launcher."
"""Prefixes of tensor names: of the networks and of the spin embedding; of the base, whose values stand in the model
file itself."""

LARGEST_DENSITY = 100_000  # Largest number of centres of a feature density; training chooses a few hundred


class _Section(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)


class _LauncherConfig(_Section):
    labels: Annotated[tuple[str, ...], Field(strict=False)]
    categories: dict[str, Annotated[tuple[str, ...], Field(strict=False)]]


class _TrainedConfig(_Section):
    process_noise: dict[str, float]
    position_scale: float
    spin_noise: float | None
    launcher: _LauncherConfig | None
    rooms: Annotated[tuple[str, ...], Field(strict=False)] = ()
    elsewhere: dict[str, Any] | None = None


class _FadingConfig(_Section):
    flight_centres: Annotated[int, Field(ge=0, le=LARGEST_DENSITY)]
    contact_centres: Annotated[int, Field(ge=0, le=LARGEST_DENSITY)]


class _Config(_Section):
    architecture: Architecture | None
    trained: _TrainedConfig | None
    fading: _FadingConfig | None = None
    radius: Annotated[float, Field(gt=0.0)] | None = None
    """m, of the ball that the networks learned from; None in files of earlier versions."""


def has_learned_part(model: BallModel) -> bool:
    """True if this model needs a folder beside its model file."""
    return isinstance(model, LearnedModel) or model.trained is not None


def write_learned(model: BallModel, parent: Path, stem: str) -> str:
    """Writes the folder of a model's learned part.

    Args: model: learned, or analytic with `trained`.  parent: folder to write into.  stem: start of the name.
    Returns: the folder's name. It appears only once it is complete, and nothing removes it: users copy model files.
    """
    content = _config(model)
    stated = content.model_dump(mode="json", exclude={"radius"} if content.radius is None else None)
    config = yaml.safe_dump(stated, sort_keys=False, allow_unicode=True).encode()
    weights = safetensors.torch.save({name: t.detach().contiguous() for name, t in _tensors(model).items()})
    folder = parent / f"{stem}{LEARNED}{_digest(config, weights)}"
    with whole_folder(folder) as part:
        (part / CONFIG).write_bytes(config)
        (part / WEIGHTS).write_bytes(weights)
    return folder.name


def read_learned(folder: Path, analytic: AnalyticModel) -> BallModel:
    """The model of a folder and of the effects in the model file.

    Args: folder: written by `write_learned`.  analytic: model of the effects; the base of a residual architecture.
    Raises:
        FileNotFoundError: if the folder or one of its files is missing.
        ValueError: if a file is damaged or was changed after saving, the config is unknown, or weights have other
            names, shapes or types.
    """
    for path in (folder / CONFIG, folder / WEIGHTS):
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist; a learned part is a folder with {CONFIG} and {WEIGHTS}.")
    config = _read_config(folder / CONFIG)
    model = _empty_model(config, analytic, folder)
    expected = _tensors(model)
    tensors = _read_weights(folder / WEIGHTS, expected)
    with torch.no_grad():
        for name, tensor in expected.items():
            tensor.copy_(tensors[name])
    _check_digest(folder)  # last: an error in a file says more than that it was changed
    return model


def trained_radius(folder: Path) -> float | None:
    """The radius, m, of the ball that the networks of a folder learned from; None if it does not say.

    Raises: ValueError: if its config is damaged.
    """
    return _read_config(folder / CONFIG).radius if (folder / CONFIG).is_file() else None


def _digest(config: bytes, weights: bytes) -> str:
    return hashlib.sha256(config + weights).hexdigest()[:12]


def _check_digest(folder: Path) -> None:
    """Refuses files that were changed after saving. A folder that a user has renamed has no digest."""
    named = re.search(rf"{re.escape(LEARNED)}([0-9a-f]{{12}})$", folder.name)
    found = _digest((folder / CONFIG).read_bytes(), (folder / WEIGHTS).read_bytes())
    if named is not None and named[1] != found:
        raise ValueError(
            f"{folder}: {CONFIG} and {WEIGHTS} must be as they were saved, with the digest {named[1]} that the name of "
            f"the folder states; theirs is {found}: a file is damaged or was changed. Copy the folder again, or train "
            "again."
        )


def _config(model: BallModel) -> _Config:
    architecture, noted = model.architecture if isinstance(model, LearnedModel) else None, None
    if (trained := model.trained) is not None:
        own = trained.launcher
        noted = _TrainedConfig(
            process_noise=dict(trained.process_noise),
            position_scale=trained.position_scale,
            spin_noise=trained.spin_noise,
            launcher=None if own is None else _LauncherConfig(labels=own.labels, categories=own.categories),
            rooms=trained.rooms,
            elsewhere=None if trained.elsewhere is None else trained.elsewhere.to_mapping(),
        )
    radius = None if architecture is None else model.learned_from or model.radius
    return _Config(architecture=architecture, fading=_fading(model), trained=noted, radius=radius)


def _fading(model: BallModel) -> _FadingConfig | None:
    if not isinstance(model, LearnedModel) or model.fading is None:
        return None
    sizes = [density.get_buffer("centres").shape[0] for density in (model.fading.flying, model.fading.bouncing)]
    return _FadingConfig(flight_centres=sizes[0], contact_centres=sizes[1])


def _tensors(model: BallModel) -> dict[str, Tensor]:
    """The weights of the learned part by name; they share the model's memory."""
    tensors: dict[str, Tensor] = {}
    if isinstance(model, LearnedModel):
        tensors |= {_MODEL + n: t for n, t in model.state_dict().items() if not n.startswith(BASE)}
    if model.trained is not None and model.trained.launcher is not None:
        tensors |= {_LAUNCHER + n: t for n, t in model.trained.launcher.state_dict().items()}
    return tensors


def _read_config(path: Path) -> _Config:
    content: Any = read_yaml(path)
    try:
        return _Config.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "content"
        raise ValueError(f"{path}: {where}: {first['msg']}; got {shown(first['input'])}.") from None


def _empty_model(config: _Config, analytic: AnalyticModel, folder: Path) -> BallModel:
    """The model that the config describes, with untrained weights."""
    model: BallModel = analytic
    architecture = config.architecture
    if architecture is not None:
        if not architecture.residual and (analytic.flight or analytic.bounce):
            raise ValueError(
                f"{folder / CONFIG}: a model that is not residual must stand alone; the model file declares "
                f"{', '.join((*analytic.flight, *analytic.bounce))}. Leave its sections flight and bounce empty."
            )
        learned_from = _of_another_ball(config, analytic.radius, folder)
        base = analytic if architecture.residual else None
        model = build(architecture, radius=analytic.radius, inertia_factor=analytic.inertia_factor, base=base)
        model.learned_from = learned_from
        if config.fading is not None:
            if base is None:
                raise ValueError(f"{folder / CONFIG}: fading must have a model to fade to; make architecture residual.")
            model.fading = Fading.empty(config.fading.flight_centres, config.fading.contact_centres, analytic.radius)
    model.noise, model.spins = analytic.noise, analytic.spins
    if model is not analytic:
        if model.noise is not None and model.base is analytic:
            spreads = {f"{BASE}{name}": sigma for name, sigma in model.noise.coefficients.items()}
            model.noise = replace(model.noise, coefficients=spreads)
        model.variations = {f"{BASE}{name}": variation for name, variation in analytic.variations.items()}
    if config.trained is not None:
        model.trained = _trained(config.trained, folder)
    return model


def _of_another_ball(config: _Config, given: float, folder: Path) -> float | None:
    """The radius of the ball that networks learned from, if it is not that of the given one; else None.

    Raises: ValueError: if they stand alone, without a law of another model that holds for this ball.
    """
    own, architecture = config.radius, config.architecture
    if own is None or abs(given / own - 1.0) <= TOLERANCE:
        return None
    if architecture is None or not architecture.residual:
        raise ValueError(
            f"{folder / CONFIG}: the ball must have the radius {own:g} m that its networks learned from; got {given:g} "
            "m, and networks know no other ball. Train on tracks of this one, or correct ball.radius in dataset.yaml."
        )
    return own


def _trained(config: _TrainedConfig, folder: Path) -> Trained:
    given = config.launcher
    try:
        launcher = None if given is None else SpinEmbedding(given.labels, given.categories)
        elsewhere = None if config.elsewhere is None else TrackNoise.from_mapping(config.elsewhere)
        return Trained(
            config.process_noise, config.position_scale, launcher, config.spin_noise, config.rooms, elsewhere
        )
    except ValueError as error:
        raise ValueError(f"{folder / CONFIG}: {error}") from None


def _read_weights(path: Path, expected: dict[str, Tensor]) -> dict[str, Tensor]:
    tensors = read_tensors(path)
    for name in sorted(set(expected) | set(tensors)):
        if name not in tensors or name not in expected:
            has = "is missing" if name not in tensors else "is not of this model"
            raise ValueError(f"{path}: tensor {shown(name)} {has}; {CONFIG} and {WEIGHTS} do not belong together.")
        tensor, wanted = tensors[name], expected[name]
        if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
            raise ValueError(
                f"{path}: tensor '{name}' must be {wanted.dtype} of shape {tuple(wanted.shape)}; got {tensor.dtype} of "
                f"shape {tuple(tensor.shape)}. {CONFIG} and {WEIGHTS} do not belong together."
            )
        if not bool(tensor.isfinite().all()):
            raise ValueError(f"{path}: tensor '{name}' must be finite; it holds NaN or infinity. Train again.")
    return tensors
