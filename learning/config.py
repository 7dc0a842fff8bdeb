"""What a calibration is told: a YAML file, `key=value` overrides, and every field checked before anything starts."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ballfg.tracks.hints import did_you_mean


class CalibrationConfig(BaseModel):
    """A whole calibration. The same config on the same data gives the same numbers.

    Paths are relative to the folder in which the command runs.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    model: str | None = None
    """Model file to start from; null: the nominal table-tennis model."""

    data: str | None = None
    """Folder of the dataset. `--data` takes its place."""

    out: str = "calibration"
    """Folder that is written. `--out` takes its place."""

    coefficients: Annotated[tuple[str, ...], Field(min_length=1, strict=False)] = (
        "flight.drag.k",
        "contact.restitution.e",
        "contact.table_height.offset",
    )
    """What is calibrated, by parameter name: `flight.` or `contact.`, the effect, its coefficient."""

    split: Literal["random", "label"] = "random"
    """How tracks are parted. random: half to fit, half to judge, by the seed. label: by the label `split` of the
    dataset, `train` to fit and `test` to judge."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Of the random split."""

    observe: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.4
    """Share of a judged track's duration that is observed; the rest is predicted."""

    horizon: Annotated[float, Field(gt=0.0)] | None = None
    """s, how far is predicted; null: to the end of the track."""

    max_iterations: Annotated[int, Field(ge=1)] = 10
    """Most re-linearisations of the tracks about the new mean."""

    tolerance: Annotated[float, Field(gt=0.0)] = 0.05
    """Stop when no coefficient's mean moves by more than this share of its standard error."""

    failure_limit: Annotated[float, Field(ge=0.0, le=1.0)] = 0.2
    """Share of the fitted tracks whose estimate may fail; they are skipped. More stop the run."""

    jobs: Annotated[int, Field(ge=1)] | None = None
    """Processes; null: one per core. The numbers do not depend on it."""


FREE_TO_CHANGE = ("out", "data", "model", "max_iterations", "tolerance", "jobs")
"""Fields that a resumed run may change: they move no number, or are checked by content (data, model)."""


def read_config(
    path: str | Path, overrides: Iterable[str] = (), options: Mapping[str, str] | None = None
) -> CalibrationConfig:
    """The config of a file, with overrides.

    Args:
        path: YAML file; an empty one means all defaults.
        overrides: `key=value`; the value is YAML, or a number as in `1e-3`.
        options: values that come from command-line options; they win.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not YAML, or a key or value is wrong; the message names key, rule and remedy.
    """
    path = Path(path)
    content = _load(path)
    where = str(path)
    for override in overrides:
        key, separator, text = override.partition("=")
        if not separator or not key.strip():
            raise ValueError(f"overrides must be key=value; got '{override}'. Write for instance seed=3.")
        content[key.strip()] = _parse(override, text)
        where = f"{path} with overrides"
    content |= options or {}
    return checked_config(content, where)


def checked_config(content: Mapping[str, Any], where: str) -> CalibrationConfig:
    """A config from plain values. Raises: ValueError: a wrong key or value; the message begins with `where`."""
    try:
        return CalibrationConfig.model_validate(dict(content))
    except ValidationError as error:
        raise ValueError(f"{where}: {_explained(error)}") from None


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"config {path} does not exist; it is a YAML file, docs/train.md shows one.")
    try:
        text = path.read_text(encoding="utf-8")
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        content = yaml.safe_load(text)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not readable as YAML ({' '.join(str(error).split())})") from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ValueError(f"{path}: a config maps keys to values; got {content!r}. Write for instance 'seed: 0'.")
    keys = [] if node is None else [key.value for key, _ in node.value]
    twice = next((key for key in keys if keys.count(key) > 1), None)
    if twice is not None:
        raise ValueError(f"{path}: '{twice}' stands twice. Delete one of them.")
    return {str(key): value for key, value in content.items()}


def _parse(override: str, text: str) -> Any:
    """A value of the command line: JSON first, since YAML takes 1e-3 for text."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        pass
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ValueError(f"override '{override}': the value is not readable as YAML. Quote it.") from None


def _explained(error: ValidationError) -> str:
    """The first complaint, as one sentence with a remedy."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    known = list(CalibrationConfig.model_fields)
    if first["type"] == "extra_forbidden":
        return f"unknown key '{key}'.{did_you_mean(key, known) or ' Known ones: ' + ', '.join(known) + '.'}"
    rule = first["msg"].removeprefix("Input ").removeprefix("should ")
    got = first["input"]
    hint = " YAML reads 1e-3 as text; write 1.0e-3." if _is_number(got) else " docs/train.md lists the keys."
    return f"'{key}' must {rule}; got {got!r}.{hint}"


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return isinstance(value, str)
