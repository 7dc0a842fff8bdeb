"""Predicts tracks by a trained sequence model, and saves and loads it as a folder."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import torch
import yaml
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors.torch import save
from torch import Tensor

from ballfg.checks import short_text, shown
from ballfg.files.strict_yaml import read_yaml
from ballfg.files.weights import read_tensors
from ballfg.files.whole_folder import of_one_state, whole_folder
from ballfg.learning.sequence.architecture import SequenceArchitecture
from ballfg.learning.sequence.data import LauncherSettings, collate, example
from ballfg.learning.sequence.model import SequenceModel
from ballfg.tracks import Track

CHUNK = 64
"""Tracks that are predicted at once, which bounds the memory."""
CONFIG, WEIGHTS = "config.yaml", "weights.safetensors"


class FolderConfig(BaseModel):
    """The content of `config.yaml`."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    kind: Literal["lstm", "diffusion"]
    """Kind of the model."""
    width: Annotated[int, Field(ge=1, le=2048)]
    """Width of its hidden states."""
    points: Annotated[int, Field(ge=1, le=100_000)]
    """Number of points of its grid."""
    labels: Annotated[tuple[str, ...], Field(strict=False)]
    """Labels that are launcher settings."""
    categories: dict[str, Annotated[tuple[str, ...], Field(strict=False)]]
    """Values of the textual labels."""
    digest: str | None = None
    """SHA-256 of the weights; null in folders of earlier versions."""


@dataclass(eq=False)
class SequencePredictor:
    """Predicts the rest of tracks from their first samples.

    A prediction reaches as far as the longest rest in training; beyond that it goes straight on.
    Frames may be dropped, but the observed part should last as long as in training: a model has learned no other.
    """

    architecture: SequenceArchitecture
    launcher: LauncherSettings
    model: SequenceModel

    @property
    def parameter_count(self) -> int:
        """Trainable numbers; scales are not among them."""
        return sum(parameter.numel() for parameter in self.model.parameters())

    def predict(self, track: Track, observed: int, times: ArrayLike) -> NDArray[np.float64]:
        """Positions of one track.

        Args:
            track: its first `observed` samples and its labels are used, nothing else.
            observed: >= 2.
            times: (k,) s in the track's own time, increasing, later than the last observed sample.
        Returns: (k, 3) m.
        Raises: ValueError: too few samples, launcher settings that are missing or unknown, or bad times.
        """
        return self.predict_many([track], [observed], [times])[0]

    def predict_many(
        self, tracks: Sequence[Track], observed: Sequence[int], times: Sequence[ArrayLike]
    ) -> list[NDArray[np.float64]]:
        """Positions of many tracks, as `predict` gives them.

        Args:
            tracks: as for `predict`.
            observed: one number per track.
            times: (k,) s, one array per track.
        Returns: (k, 3) m, one array per track.
        Raises: ValueError: as `predict`.
        """
        examples = [
            example(track, count, self.launcher.of(track), asked)
            for track, count, asked in zip(tracks, observed, times, strict=True)
        ]
        predicted: list[NDArray[np.float64]] = []
        for first in range(0, len(examples), CHUNK):
            batch = collate(examples[first : first + CHUNK])
            with torch.no_grad():
                positions = self.model.predict(batch)
            predicted += [row[mask].numpy() for row, mask in zip(positions, batch.asked, strict=True)]
        return predicted

    def save(self, folder: str | Path) -> None:
        """Write `config.yaml` and `weights.safetensors`; the folder appears once it is whole.

        Raises: ValueError: if the folder exists.
        """
        folder = Path(folder)
        if folder.exists():
            raise ValueError(f"folder must be new; {folder} exists. Choose another name or delete it.")
        folder.parent.mkdir(parents=True, exist_ok=True)
        self.replace(folder)

    def replace(self, folder: Path) -> None:
        """Write as `save`, in the place of an earlier model of that folder; its parent must exist."""
        config: dict[str, Any] = {
            "kind": self.architecture.kind,
            "width": self.architecture.width,
            "points": self.model.points,
            "labels": list(self.launcher.labels),
            "categories": {label: list(values) for label, values in self.launcher.categories.items()},
        }
        weights = save({name: value.contiguous() for name, value in self.model.state_dict().items()})
        config["digest"] = hashlib.sha256(weights).hexdigest()
        with whole_folder(folder, earlier=(CONFIG, WEIGHTS)) as part:
            text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
            (part / CONFIG).write_text(text, encoding="utf-8")
            (part / WEIGHTS).write_bytes(weights)

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Read what `save` wrote; predictions are the same to the last bit.

        Raises:
            FileNotFoundError: the folder or one of its files is missing.
            ValueError: a file is damaged, or weights do not go with the config.
        """
        config, weights = _read(Path(folder))
        try:
            architecture = SequenceArchitecture(config.kind, config.width)
        except ValueError as error:
            raise ValueError(f"{Path(folder) / CONFIG}: {error}") from None
        launcher = LauncherSettings(config.labels, config.categories)
        model = architecture.empty(launcher.size, config.points)
        expected = {name: (tuple(value.shape), value.dtype) for name, value in model.state_dict().items()}
        got = {name: (tuple(value.shape), value.dtype) for name, value in weights.items()}
        wrong = sorted(name for name in expected.keys() | got.keys() if expected.get(name) != got.get(name))
        if wrong:
            raise ValueError(
                f"weights in {folder} must be those of the model in its config; '{wrong[0]}' is "
                f"{got.get(wrong[0], 'missing')}, not {expected.get(wrong[0], 'part of it')}. Save the model again."
            )
        if config.digest not in (None, hashlib.sha256((Path(folder) / WEIGHTS).read_bytes()).hexdigest()):
            raise ValueError(
                f"{Path(folder) / WEIGHTS}: must be as it was saved, with the digest that {CONFIG} states; it is "
                "damaged or was changed. Copy it again, or save the model again."
            )
        model.load_state_dict(weights)
        return cls(architecture, launcher, model)


@of_one_state
def _read(folder: Path) -> tuple[FolderConfig, dict[str, Tensor]]:
    """Config and weights of a folder."""
    for name in (CONFIG, WEIGHTS):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"{folder} must hold {CONFIG} and {WEIGHTS}; {name} is missing. Save it again.")
    try:
        config = FolderConfig.model_validate(read_yaml(folder / CONFIG))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "content"
        raise ValueError(
            f"{folder / CONFIG}: not the config of a sequence model ({short_text(where)}: {first['msg']}; got "
            f"{shown(first['input'])}). Save it again."
        ) from None
    return config, read_tensors(folder / WEIGHTS)
