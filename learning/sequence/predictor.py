"""Builds sequence models of a kind and size, predicts tracks with them, and saves and loads them as folders."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import torch
import yaml
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, ValidationError
from safetensors.torch import save
from torch import Tensor

from ballfg.checks import short_text, shown
from ballfg.files.strict_yaml import read_yaml
from ballfg.files.weights import read_tensors
from ballfg.files.whole_folder import of_one_state, whole_folder
from ballfg.learning.evaluation import Plain
from ballfg.learning.sequence.data import Example, LauncherSettings, collate, example
from ballfg.learning.sequence.diffusion import DiffusionModel
from ballfg.learning.sequence.model import Frame, LstmModel, SequenceModel
from ballfg.tracks import Track

SequenceKind = Literal["lstm", "diffusion"]
DEFAULT_WIDTH: dict[SequenceKind, int] = {"lstm": 96, "diffusion": 64}  # Chosen by validation on simulated tracks
_MODELS: dict[SequenceKind, type[LstmModel] | type[DiffusionModel]] = {"lstm": LstmModel, "diffusion": DiffusionModel}
CHUNK = 64  # Tracks that are predicted at once, which bounds the memory
CONFIG, WEIGHTS = "config.yaml", "weights.safetensors"


@dataclass(frozen=True)
class SequenceArchitecture:
    """Kind and width, of the hidden states or of the denoiser's channels: a multiple of 8, for the attention heads."""

    kind: SequenceKind
    width: int

    def empty(self, settings: int, points: int) -> SequenceModel:
        """A model before its weights and scales are loaded."""
        return _MODELS[self.kind](settings, points, self.width)

    def untrained(self, examples: Sequence[Example], seed: int) -> SequenceModel:
        """A model with the scales of some examples and weights drawn by the seed; torch's generator is unchanged."""
        settings = len(examples[0].settings)
        points = Frame(settings).fit(examples)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            model = self.empty(settings, points)
        model.frame.fit(examples)
        return model


class FolderConfig(Plain):
    """The content of `config.yaml`: architecture, points of the grid, labels of settings, values of textual ones."""

    kind: SequenceKind
    width: Annotated[int, Field(ge=8, le=2048, multiple_of=8)]
    points: Annotated[int, Field(ge=1, le=100_000)]
    labels: Annotated[tuple[str, ...], Field(strict=False)]
    categories: dict[str, Annotated[tuple[str, ...], Field(strict=False)]]
    digest: str | None = None  # SHA-256 of the weights; null in folders of earlier versions


@dataclass(eq=False)
class SequencePredictor:
    """Predicts the rest of tracks from their first samples; beyond the longest rest in training it goes straight on.

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
        """Positions of many tracks, (k, 3) m each; arguments and errors as those of `predict`, for each track."""
        examples = [
            example(track, count, self.launcher.of(track), asked)
            for track, count, asked in zip(tracks, observed, times, strict=True)
        ]
        predicted: list[NDArray[np.float64]] = []
        for first in range(0, len(examples), CHUNK):
            batch = collate(examples[first : first + CHUNK])
            with torch.no_grad():
                rows = zip(self.model.predict(batch), batch.asked, strict=True)
            predicted += [row[mask].numpy() for row, mask in rows]
        return predicted

    def save(self, folder: Path) -> None:
        """Write `config.yaml` and `weights.safetensors` in the place of an earlier model; the parent must exist."""
        weights = save({name: value.contiguous() for name, value in self.model.state_dict().items()})
        config = FolderConfig(
            kind=self.architecture.kind,
            width=self.architecture.width,
            points=self.model.points,
            labels=self.launcher.labels,
            categories=dict(self.launcher.categories),
            digest=hashlib.sha256(weights).hexdigest(),
        )
        with whole_folder(folder, earlier=(CONFIG, WEIGHTS)) as part:
            text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
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
        architecture = SequenceArchitecture(config.kind, config.width)
        launcher = LauncherSettings(config.labels, config.categories)
        model = architecture.empty(launcher.size, config.points)
        expected, got = (
            {name: (tuple(value.shape), value.dtype) for name, value in tensors.items()}
            for tensors in (model.state_dict(), weights)
        )
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
