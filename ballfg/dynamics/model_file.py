"""Reads and writes model files: the effects of a model with their coefficients, and its learned part."""

import difflib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, cast

import yaml

from ballfg.checks import check_path, check_range, shown
from ballfg.dynamics.analytic import AnalyticModel, after_needs
from ballfg.dynamics.coefficient import DOUBT, THIN_SHELL, todays_name
from ballfg.dynamics.domain import Domain
from ballfg.dynamics.effect import Effect, Kind
from ballfg.dynamics.effects.registry import EFFECTS, GENERIC, LEARNED, effect_class
from ballfg.dynamics.model import BASE, BallModel
from ballfg.dynamics.population import SpinPopulation
from ballfg.dynamics.variation import Variation
from ballfg.files.strict_yaml import read_yaml
from ballfg.files.whole_file import write_text
from ballfg.files.whole_folder import of_one_state
from ballfg.tracks.noise import TrackNoise

KINDS: Final[tuple[Kind, ...]] = ("flight", "bounce", "measurement")
VARIATIONS: Final = "variations"
POPULATIONS: Final = "populations"
SPIN: Final = "spin"  # Entry of the section `populations`
DOMAIN: Final = "domain"
SECTIONS = (*KINDS, VARIATIONS, POPULATIONS, DOMAIN, "learned")
RADIUS: Final = 0.02  # m, of a ball that nobody states: a table-tennis ball's
LONGEST_NAME: Final = 255  # Characters of a folder's name
NOISE: Final = "noise"
"""Entry of the section `measurement` that is not an effect: the scatter of tracks about the model."""


@of_one_state
def load_model(
    path: str | Path, *, radius: float | None = None, inertia_factor: float = THIN_SHELL, room: str | None = None
) -> BallModel:
    """Read a model file.

    Args:
        path: YAML file with the sections `flight`, `bounce`, `measurement`, `variations`, `populations`, `domain`,
            `learned` (docs/models.md).
        radius: m, of the ball, usually from the dataset; None: that of the ball that the model was fitted on or that
            networks learned from, else 0.02.
        inertia_factor: moment of inertia divided by m R^2.
        room: name of the dataset to estimate. In a room outside of its training a network that fades keeps half of its
            correction, or nothing if that did not help held-out training tracks. None: as trained.
    Returns: the analytic model if `learned` is null; else the content of the learned folder: a `LearnedModel` or an
        analytic model with trained noise and launcher (`trained`).
    Raises:
        FileNotFoundError: if the model file or the learned folder does not exist.
        ValueError: if it is not YAML, or names a section, effect or coefficient that does not exist, or a value
            outside its bounds; or if the folder does not hold a learned part of this version, or one of another ball.
    """
    path = check_path("path", path)
    if path.is_dir():
        raise FileNotFoundError(f"model file must be one YAML file; {path} is a folder. {_file_of(path)}")
    if not path.is_file():
        raise FileNotFoundError(f"model file {path} does not exist; a model is one YAML file")
    content = read_yaml(path)
    learned = content.get("learned") if isinstance(content, Mapping) else None
    if learned is None:
        return _analytic(content, radius, inertia_factor, str(path))
    beside = isinstance(learned, str) and learned not in (".", "..") and Path(learned).name == learned
    if not beside or not 0 < len(learned) <= LONGEST_NAME:
        raise ValueError(
            f"{path}: section 'learned' must be null or the name of a folder beside the file; got {shown(learned)}. "
            "Copy the folder there."
        )
    from ballfg.dynamics.networks.learned import LearnedModel  # networks are imported where a file names one
    from ballfg.dynamics.networks.learned_file import read_learned, trained_radius

    content = {**content, "learned": None}
    size = (trained_radius(path.parent / learned) or RADIUS) if radius is None else radius
    analytic = model_from_dict(content, radius=size, inertia_factor=inertia_factor, where=str(path))
    model = read_learned(path.parent / learned, analytic)
    abroad = room is not None and model.trained is not None and model.trained.is_foreign(room)
    if abroad and isinstance(model, LearnedModel) and model.fading is not None:
        model.fading.strength = float(model.fading.get_buffer("abroad"))
    return model


def _analytic(content: Any, radius: float | None, inertia_factor: float, where: str) -> AnalyticModel:
    """The model of a file without a learned part, for the ball that it was fitted on where no radius is given."""
    from ballfg.dynamics.nominal import TOLERANCE  # which reads model files

    domain = _domain(content.get(DOMAIN), where) if isinstance(content, Mapping) else None
    fitted = None if domain is None else domain.nearest_radius(RADIUS if radius is None else radius)
    size = next(r for r in (radius, fitted, RADIUS) if r is not None)
    model = model_from_dict(content, radius=size, inertia_factor=inertia_factor, where=where)
    if fitted is not None and abs(size / fitted - 1.0) > TOLERANCE:
        model.learned_from = fitted
    return model


def _file_of(folder: Path) -> str:
    """What to give in place of a folder."""
    if (folder / "model.yaml").is_file():
        return f"Give {folder / 'model.yaml'}."
    if (folder / "weights.safetensors").is_file():
        return (
            "It holds weights: give the model file beside it that names it. Models of kind lstm or diffusion have "
            "none: SequencePredictor.load of ballfg.learning.sequence.predictor reads them, and no command does."
        )
    return "Give a file in it."


def model_from_dict(
    content: Any, *, radius: float = RADIUS, inertia_factor: float = THIN_SHELL, where: str = "model"
) -> AnalyticModel:
    """The model of a parsed model file without a learned part.

    Args:
        content: the sections `flight`, `bounce`, `measurement`, `variations`, `populations`, `domain` (docs/models.md).
        radius: m, of the ball.  inertia_factor: moment of inertia divided by m R^2.
        where: start of the error messages.
    Raises: ValueError: if it names a section, effect or coefficient that does not exist, or a value out of its bounds.
    """
    if not isinstance(content, Mapping):
        raise ValueError(f"{where}: a model is a mapping with the sections {', '.join(SECTIONS)}; got {shown(content)}")
    for section in content:
        if section not in SECTIONS:
            raise ValueError(f"{where}: unknown section '{section}'{_nearest(section, SECTIONS)}")
    if content.get("learned") is not None:
        raise ValueError(f"{where}: section 'learned' must be null; only a file tells where a learned part lies")
    content, noise = _without_noise(content, where)
    effects: list[Effect] = []
    for kind in KINDS:
        section = content.get(kind)
        if section is None:
            if kind == "measurement":
                continue
            raise ValueError(f"{where}: section '{kind}' is missing; write '{kind}: {{}}' for no effects")
        if not isinstance(section, Mapping):
            raise ValueError(f"{where}: section '{kind}' must map effects to coefficients; got {shown(section)}")
        effects += [_effect(name, kind, values, where) for name, values in section.items()]
    try:
        effects = after_needs(effects)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    model = AnalyticModel(effects, radius=radius, inertia_factor=inertia_factor)
    model.noise = noise
    check_spreads(noise, model, f"{where}: measurement.")
    model.variations = _variations(content.get(VARIATIONS), model, where)
    model.spins = _spins(content.get(POPULATIONS), where)
    model.domain = _domain(content.get(DOMAIN), where)
    return model


def _domain(section: Any, where: str) -> Domain | None:
    """What the model was fitted on."""
    try:
        return None if section is None else Domain(section)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {error}") from error


def _spins(section: Any, where: str) -> SpinPopulation | None:
    """The spins of groups of shots."""
    if section is None:
        return None
    if not isinstance(section, Mapping) or set(section) != {SPIN}:
        raise ValueError(f"{where}: section '{POPULATIONS}' must be a mapping with '{SPIN}'; got {shown(section)}")
    try:
        return SpinPopulation.from_mapping(section[SPIN])
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {POPULATIONS}.{SPIN}: {error}") from error


def _variations(section: Any, model: AnalyticModel, where: str) -> dict[str, Variation]:
    """Coefficients that differ between tracks, by name."""
    if section is None:
        return {}
    if not isinstance(section, Mapping):
        raise ValueError(f"{where}: section '{VARIATIONS}' must map coefficients to their values; got {shown(section)}")
    declared, found = model.declared_coefficients(), {}
    for name, content in section.items():
        if name not in declared:
            raise ValueError(f"{where}: {VARIATIONS}: unknown coefficient '{name}'{_nearest(name, tuple(declared))}")
        try:
            found[name] = Variation.from_mapping(content)
            for value in found[name].values.values():
                check_range("each value", value, declared[name].low, declared[name].high)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{where}: {VARIATIONS}.{name}: {error}") from error
    return found


def _without_noise(content: Mapping[str, Any], where: str) -> tuple[Mapping[str, Any], TrackNoise | None]:
    """Splits `measurement.noise`, which is not an effect, from the rest of the content."""
    section = content.get("measurement")
    if not isinstance(section, Mapping) or section.get(NOISE) is None:
        return content, None
    try:
        noise = TrackNoise.from_mapping(section[NOISE])
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: measurement.{error}") from error
    return {**content, "measurement": {name: v for name, v in section.items() if name != NOISE}}, noise


def check_spreads(noise: TrackNoise | None, model: BallModel, where: str) -> None:
    """Refuses spreads between tracks of what is no coefficient; effects that the model lacks may have some.

    Raises: ValueError: naming the nearest coefficient.
    """
    own = tuple(name for name, _ in model.named_parameters())
    others = (name for name in (() if noise is None else noise.coefficients) if name not in own)
    for name in others:
        effects = {**EFFECTS, **GENERIC, **LEARNED}.values()
        every = tuple(f"{effect.kind}.{effect.name}.{c.name}" for effect in effects for c in effect.coefficients)
        from ballfg.dynamics.networks.fading import DOUBTS  # networks are imported where a file names one

        plain = todays_name(name).removeprefix(BASE)  # a network's file names the coefficients of its base
        if plain not in (*own, *every, *(DOUBT + c.name for c in DOUBTS)):
            close = difflib.get_close_matches(plain, own, n=1) or difflib.get_close_matches(plain, every, n=1)
            own_effect = "" if close else ". That of an effect of your own needs --effects-file FILE.py"
            hint = f"{_nearest(plain, tuple(close) or own)}{own_effect}"
            raise ValueError(f"{where}noise.coefficients: unknown coefficient {shown(name)}{hint}")


def _effect(name: str, kind: Kind, values: Any, where: str) -> Effect:
    values = {} if values is None else values
    if not isinstance(values, Mapping):
        raise ValueError(f"{where}: {kind}.{name} must map coefficients to numbers; got {shown(values)}")
    for key, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            hint = ". YAML reads 3e-3 as text; write 3.0e-3" if isinstance(value, str) else ""
            raise ValueError(f"{where}: {kind}.{name}.{key} must be a number; got {shown(value)}{hint}")
    try:
        return effect_class(name, kind)(**{str(key): value for key, value in values.items()})
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{where}: {error}") from error


def _nearest(name: object, known: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(str(name), known, n=1)
    return f"; did you mean '{close[0]}'?" if close else f"; known ones: {', '.join(known)}"


def model_to_dict(model: AnalyticModel) -> dict[str, Any]:
    """The content of a model file for this model's effects."""
    content: dict[str, Any] = {}
    for kind, group in zip(KINDS, (model.flight, model.bounce, model.measurement), strict=True):
        content[kind] = {name: cast(Effect, effect).values() for name, effect in group.items()}
    if model.noise is not None:
        content["measurement"][NOISE] = model.noise.to_mapping()
    populations = {} if model.spins is None else {POPULATIONS: {SPIN: model.spins.to_mapping()}}
    domain = {} if model.domain is None else {DOMAIN: model.domain.to_mapping()}
    return content | _listed(model.variations) | populations | domain | {"learned": None}


def _listed(variations: Mapping[str, Variation]) -> dict[str, Any]:
    """The section `variations` of a model file; a learned model lists those of its base."""
    section = {name.removeprefix(BASE): variation.to_mapping() for name, variation in variations.items()}
    return {VARIATIONS: section} if section else {}


def save_model(model: BallModel, path: str | Path) -> None:
    """Writes a model file and, beside it, the folder of the learned part if the model has one.

    The final names appear only once file and folder are complete. An earlier model's folder stays: copies of its file
    may name it.

    Raises: TypeError: if the model is neither analytic nor learned, or corrects one that is not analytic.
    """
    from ballfg.dynamics.networks.learned_file import has_learned_part, write_learned

    path = check_path("path", path)
    content = model_to_dict(_analytic_part(model)) | _listed(model.variations)
    if model.noise is not None:
        listed = {name.removeprefix(BASE): sigma for name, sigma in model.noise.coefficients.items()}
        content["measurement"][NOISE] = replace(model.noise, coefficients=listed).to_mapping()
    if has_learned_part(model):
        content["learned"] = write_learned(model, path.parent, path.stem)
    write_text(path, yaml.safe_dump(content, sort_keys=False))


def _analytic_part(model: BallModel) -> AnalyticModel:
    """The effects for the model file: none for a learned model without a base."""
    from ballfg.dynamics.networks.learned import LearnedModel

    part = model.base if isinstance(model, LearnedModel) else model
    if isinstance(model, LearnedModel) and part is None:
        return AnalyticModel((), radius=model.radius, inertia_factor=model.inertia_factor)
    if not isinstance(part, AnalyticModel):
        raise TypeError(f"model must be analytic, learned, or learned on an analytic one; got {type(part).__name__}.")
    return part
