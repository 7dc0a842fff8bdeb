"""Model files: which effects a model declares, with the values of their coefficients, as YAML."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, cast

import yaml

from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.registry import effect_class
from ballfg.dynamics.model import THIN_SHELL

SECTIONS = ("flight", "bounce", "measurement", "learned")


class _UniqueKeyLoader(yaml.SafeLoader):
    """The safe loader, which takes the last of two equal keys in silence; this one refuses them."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The mapping. Raises: ConstructorError: if a key comes twice."""
        keys = [key.value for key, _ in node.value]
        for key, _ in node.value:
            if keys.count(key.value) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"'{key.value}' stands twice", key.start_mark)
        return super().construct_mapping(node, deep)


def nominal_model(radius: float = 0.02) -> AnalyticModel:
    """The table-tennis model that ships with the package."""
    text = resources.files("ballfg.dynamics").joinpath("nominal.yaml").read_text(encoding="utf-8")
    return model_from_dict(yaml.safe_load(text), radius=radius, where="nominal.yaml")


def load_model(path: str | Path, *, radius: float = 0.02, inertia_factor: float = THIN_SHELL) -> AnalyticModel:
    """Read a model file.

    Args:
        path: YAML file with the sections `flight`, `bounce`, `measurement`, `learned` (docs/models.md).
        radius: m, of the ball, usually from the dataset.
        inertia_factor: moment of inertia divided by m R^2.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not YAML, or names a section, effect or coefficient that does not exist, or a value
            outside its bounds.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"model file {path} does not exist; a model is one YAML file")
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: not readable as YAML ({reason})") from error
    return model_from_dict(content, radius=radius, inertia_factor=inertia_factor, where=str(path))


def model_from_dict(
    content: Any, *, radius: float = 0.02, inertia_factor: float = THIN_SHELL, where: str = "model"
) -> AnalyticModel:
    """The model that a parsed model file describes; `where` stands in error messages."""
    if not isinstance(content, Mapping):
        raise ValueError(f"{where}: a model is a mapping with the sections {', '.join(SECTIONS)}; got {content!r}")
    for section in content:
        if section not in SECTIONS:
            raise ValueError(f"{where}: unknown section '{section}'{_nearest(section, SECTIONS)}")
    if content.get("learned") is not None:
        raise ValueError(f"{where}: section 'learned' must be null; this version reads analytic models only")
    if content.get("measurement"):
        raise ValueError(f"{where}: section 'measurement' must be empty; this version has no measurement effects")
    effects: list[Effect] = []
    for kind in ("flight", "bounce"):
        section = content.get(kind)
        if section is None:
            raise ValueError(f"{where}: section '{kind}' is missing; write '{kind}: {{}}' for no effects")
        if not isinstance(section, Mapping):
            raise ValueError(f"{where}: section '{kind}' must map effects to coefficients; got {section!r}")
        effects += [_effect(name, kind, values, where) for name, values in section.items()]
    return AnalyticModel(effects, radius=radius, inertia_factor=inertia_factor)


def _effect(name: str, kind: str, values: Any, where: str) -> Effect:
    values = {} if values is None else values
    if not isinstance(values, Mapping):
        raise ValueError(f"{where}: {kind}.{name} must map coefficients to numbers; got {values!r}")
    for key, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            hint = ". YAML reads 3e-3 as text; write 3.0e-3" if isinstance(value, str) else ""
            raise ValueError(f"{where}: {kind}.{name}.{key} must be a number; got {value!r}{hint}")
    try:
        return effect_class(name, kind)(**{str(key): value for key, value in values.items()})
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{where}: {error}") from error


def _nearest(name: object, known: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(str(name), known, n=1)
    return f"; did you mean '{close[0]}'?" if close else f"; known ones: {', '.join(known)}"


def model_to_dict(model: AnalyticModel) -> dict[str, Any]:
    """What a model file says about this model."""

    def section(group: Mapping[str, object]) -> dict[str, dict[str, float]]:
        effects = {name: cast(Effect, effect) for name, effect in group.items()}
        return {n: {c.name: float(getattr(e, c.name).detach()) for c in e.coefficients} for n, e in effects.items()}

    return {
        "flight": section(dict(model.flight.items())),
        "bounce": section(dict(model.contact.items())),
        "measurement": {},
        "learned": None,
    }


def save_model(model: AnalyticModel, path: str | Path) -> None:
    """Write a model file; the final name appears only once the file is whole."""
    path = Path(path)
    part = path.with_name(path.name + ".part")
    part.write_text(yaml.safe_dump(model_to_dict(model), sort_keys=False), encoding="utf-8")
    os.replace(part, path)
