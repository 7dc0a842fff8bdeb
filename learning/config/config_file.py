"""Reads the config file of `ballfg-train`, YAML with `key=value` overrides, and checks it."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from ballfg.checks import nearest, shown
from ballfg.files.strict_yaml import YamlError, parse_yaml, read_yaml
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.training import TrainConfig

Config = TrainConfig | CalibrationConfig
CALIBRATE, AUTO = "calibrate", "auto"  # The kinds whose config is a `CalibrationConfig`


def read_config(path: str | Path, overrides: Iterable[str] = (), options: Mapping[str, Any] | None = None) -> Config:
    """The config of a file with overrides. Its key `kind` decides between training and calibration.

    Args:
        path: YAML file; an empty one means all defaults.
        overrides: `key=value`, nested keys with dots; the value is YAML, or a number as in `1e-3`.
        options: values of command-line options; they take precedence.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not YAML, or a key or value is wrong; the message names key, rule and remedy.
    """
    path = Path(path)
    content = _load(path)
    replacing = [_override(text) for text in overrides]
    kind = next((value for keys, value in reversed(replacing) if keys == ["kind"]), content.get("kind"))
    config = _class_of(kind)
    try:
        content = config.renamed(content)  # before the overrides: `jobs=1` replaces the `workers` of an older file
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    for (first, *others), value in replacing:
        *sections, last = config.EARLIER.get(first, first), *others
        place = content
        for key in sections:  # those on the way are made
            below = place.get(key)
            place[key] = dict(below) if isinstance(below, dict) else {}
            place = place[key]
        place[last] = value
    return checked_config(content | dict(options or {}), f"{path} with overrides" if replacing else str(path))


def checked_config(content: Mapping[str, Any], where: str) -> Config:
    """A config from plain values. Raises: ValueError: a wrong key or value; the message begins with `where`."""
    config = _class_of(content.get("kind"))
    try:
        return config.model_validate(dict(content))
    except ValidationError as error:
        raise ValueError(f"{where}: {_explained(error, config)}") from None


def _class_of(kind: Any) -> type[Config]:
    return CalibrationConfig if kind in (CALIBRATE, AUTO) else TrainConfig


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"config {path} does not exist; it is a YAML file, docs/train.md shows one.")
    try:
        content = read_yaml(path)
    except YamlError as error:
        if error.repeated is None:
            raise
        raise ValueError(f"{path}: '{error.repeated}' stands twice. Delete one of them.") from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ValueError(f"{path}: a config maps keys to values; got {shown(content)}. Write for instance 'seed: 0'.")
    return {str(key): value for key, value in content.items()}


def _override(override: str) -> tuple[list[str], Any]:
    """The keys, those of sections first, and the value of `key=value`."""
    key, separator, text = override.partition("=")
    parts = [part.strip() for part in key.split(".")]
    if not separator or not all(parts):
        raise ValueError(f"overrides must be key=value; got '{override}'. Write for instance seed=3.")
    try:
        return parts, json.loads(text)
    except json.JSONDecodeError:  # JSON first, since YAML takes 1e-3 for text
        pass
    try:
        return parts, parse_yaml(text, f"override {shown(override)}")
    except YamlError as error:
        raise ValueError(f"{error}. Quote the value.") from None


def _explained(error: ValidationError, config: type[Config]) -> str:
    """The first complaint, as one sentence with a remedy."""
    first = error.errors()[0]
    location = [str(part) for part in first["loc"]]
    key = ".".join(location)
    if first["type"] == "extra_forbidden":
        return _unknown(location, config)
    if first["type"] == "value_error":
        return f"'{key}' {first['ctx']['error']}" if key else str(first["ctx"]["error"])
    if first["type"] == "model_type":
        known = ", ".join(_fields_at(config, location))
        return f"'{key}' must be a section with keys; got {shown(first['input'])}. Its keys: {known}."
    got = first["input"]
    if first["type"] == "too_short":
        return f"'{key}' must hold at least one; got {shown(got)}. Leave it out or fill it."
    rule = first["msg"].removeprefix("Input ").removeprefix("should ").replace("a valid tuple", "a list")
    number = _number(got)
    if number is not None and not math.isfinite(number):
        rule, number = "be a finite number", None
    hint = " YAML reads 1e-3 as text; write 1.0e-3." if number is not None else " docs/train.md lists the keys."
    return f"'{key}' must {rule}; got {shown(got)}.{hint}"


def _unknown(location: list[str], config: type[Config]) -> str:
    """The message on an unknown key: the most similar key, or the section that has it."""
    *section, name = location
    prefix = "".join(f"{part}." for part in section)
    known = _fields_at(config, section)
    near = nearest(name, known)
    if near is not None:
        return f"unknown key '{prefix}{name}'. Did you mean '{prefix}{near}'?"
    if not section:
        inside = [f"{field}.{name}" for field in known if name in _fields_of(config.model_fields[field].annotation)]
        if inside:
            return f"unknown key '{name}'. Did you mean '{inside[0]}'?"
        if config is TrainConfig and name in CalibrationConfig.model_fields:
            return f"unknown key '{name}'. It is a key of a calibration: write 'kind: {CALIBRATE}'."
    return f"unknown key '{prefix}{name}'. Known ones: {', '.join(prefix + field for field in known)}."


def _fields_at(config: type[BaseModel], section: list[str]) -> list[str]:
    """Names of the fields of a section, given by the names that lead to it."""
    found: Any = config
    for part in section:
        found = found.model_fields[part].annotation
    return _fields_of(found)


def _fields_of(section: Any) -> list[str]:
    """Names of the fields of a section's class; none for another type."""
    return list(section.model_fields) if isinstance(section, type) and issubclass(section, BaseModel) else []


def _number(value: Any) -> float | None:
    """The number that a text holds; None for another text or value."""
    try:
        return float(value) if isinstance(value, str) else None
    except ValueError:
        return None
