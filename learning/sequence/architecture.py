"""Defines kind and size of a sequence model, and builds the model."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self, get_args

import torch

from ballfg.checks import shown
from ballfg.learning.sequence.data import Example
from ballfg.learning.sequence.diffusion import DiffusionModel
from ballfg.learning.sequence.frame import Frame
from ballfg.learning.sequence.lstm import LstmModel
from ballfg.learning.sequence.model import SequenceModel

SequenceKind = Literal["lstm", "diffusion"]
DEFAULT_WIDTH: dict[SequenceKind, int] = {"lstm": 96, "diffusion": 64}
"""Chosen by validation on simulated tracks."""
_MODELS: dict[SequenceKind, type[LstmModel] | type[DiffusionModel]] = {"lstm": LstmModel, "diffusion": DiffusionModel}


@dataclass(frozen=True)
class SequenceArchitecture:
    """Kind and size.

    Attributes:
        kind: lstm or diffusion.
        width: of the hidden states; diffusion: channels of the denoiser. A multiple of 8, for the attention heads.
    Raises: ValueError: an unknown kind, or a width that is not a positive multiple of 8.
    """

    kind: SequenceKind
    width: int

    def __post_init__(self) -> None:
        if self.kind not in _MODELS:
            raise ValueError(
                f"kind must be one of {', '.join(get_args(SequenceKind))}; got {shown(self.kind)}. Rename it."
            )
        if isinstance(self.width, bool) or not isinstance(self.width, int) or self.width < 8 or self.width % 8:
            raise ValueError(f"width must be a positive multiple of 8; got {shown(self.width)}. Round it.")

    @classmethod
    def of(cls, kind: SequenceKind) -> Self:
        """The default of a kind. Raises: ValueError: an unknown kind."""
        return cls(kind, DEFAULT_WIDTH.get(kind, 0))

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
