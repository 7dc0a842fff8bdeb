"""The folder of a sequence model: a config that is safe to read, and weights that hold numbers only."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from ballfg.files.whole_folder import whole_folder

CONFIG, WEIGHTS = "config.yaml", "weights.safetensors"


class FolderConfig(BaseModel):
    """What `config.yaml` says."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    kind: Literal["lstm", "diffusion"]
    """Of the model."""
    width: int
    """Of its hidden states."""
    points: Annotated[int, Field(ge=1)]
    """Of the grid on which it predicts."""
    labels: Annotated[tuple[str, ...], Field(strict=False)]
    """Labels that are launcher settings."""
    categories: dict[str, Annotated[tuple[str, ...], Field(strict=False)]]
    """Values of those that are text."""


def write_folder(folder: Path, config: Mapping[str, Any], weights: Mapping[str, Tensor]) -> None:
    """Write both files beside their place, then move them there at once. Raises: ValueError: if the folder exists."""
    if folder.exists():
        raise ValueError(f"folder must be new; {folder} exists. Choose another name or delete it.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with whole_folder(folder) as part:
        text = yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True)
        (part / CONFIG).write_text(text, encoding="utf-8")
        save_file({name: value.contiguous() for name, value in weights.items()}, part / WEIGHTS)


def read_folder(folder: Path) -> tuple[FolderConfig, dict[str, Tensor]]:
    """Config and weights.

    Raises: FileNotFoundError: a missing file. ValueError: a damaged one.
    """
    for name in (CONFIG, WEIGHTS):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"{folder} must hold {CONFIG} and {WEIGHTS}; {name} is missing. Save it again.")
    try:
        content = yaml.safe_load((folder / CONFIG).read_text(encoding="utf-8"))
        config = FolderConfig.model_validate(content)
    except (yaml.YAMLError, UnicodeDecodeError, ValidationError) as error:
        raise ValueError(f"{folder / CONFIG}: not the config of a sequence model ({error}). Save it again.") from None
    try:
        weights = load_file(folder / WEIGHTS)
    except SafetensorError as error:
        raise ValueError(f"{folder / WEIGHTS}: not readable as safetensors ({error}). Save the model again.") from None
    return config, weights
