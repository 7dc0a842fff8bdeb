"""Defines the interface between a trained model and the loop that trains it, and registers the kinds of them.

A kind of one's own is a subclass of `TraineeKind` and one call of `register_trainee`, or an entry point of the group
`ballfg.trainees`. Those of the package stand beside what they build, and are imported when they are named.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor, nn

from ballfg.arrays import Array
from ballfg.registry import Registry

if TYPE_CHECKING:
    from ballfg.learning.config.training import TrainConfig


@dataclass(frozen=True)
class BatchLoss:
    """The loss of a batch of tracks. All numbers are sums over tracks, so that those of parts of a batch add up.

    Attributes:
        total: () dimensionless, differentiable sum of the tracks' losses; 0 without a graph where every track failed.
        tracks: number of tracks in it.
        squared_error: m^2, summed over `points` positions (three coordinates each).
        points: number of positions.
        failed: name and reason of each track that was left out.
    """

    total: Tensor
    tracks: int
    squared_error: float
    points: int
    failed: tuple[tuple[str, str], ...] = ()

    @classmethod
    def none(cls, failed: Sequence[tuple[str, str]] = ()) -> Self:
        """The loss of no tracks."""
        return cls(torch.zeros((), dtype=torch.float64), 0, 0.0, 0, tuple(failed))


@dataclass(frozen=True)
class PredictedShot:
    """The predicted and measured positions (k, 3) m of a track.

    Attributes:
        times: (k,) s since the last observed sample; those of observed samples are not positive.
    """

    name: str
    times: Array
    measured: Array
    predicted: Array


@dataclass(frozen=True)
class Learned:
    """A number that was learned, in its `unit`, before and after; `meaning` says what it is."""

    name: str
    before: float
    after: float
    unit: str
    meaning: str


class Trainee(ABC):
    """A model with its data.

    Tracks are numbered; a loop divides the numbers among processes. No result may depend on how tracks are batched,
    beyond rounding.

    Attributes:
        module: holds every trainable parameter by name.
    """

    module: nn.Module
    read_by: ClassVar[str] = ""
    """What reads the written model, if no command does."""

    @abstractmethod
    def loss(self, tracks: Sequence[int], epoch: int) -> BatchLoss:
        """The loss on some training tracks; random numbers derive from the seed, the track and the epoch alone."""

    @abstractmethod
    def judge(self, tracks: Sequence[int]) -> BatchLoss:
        """The loss on any tracks, without gradient and without augmentation."""

    @abstractmethod
    def export(self, folder: Path) -> Path:
        """Write the model into a folder. Returns: the path that other commands and classes load it from."""

    def shown(self, track: int) -> PredictedShot | None:
        """A track as the model predicts it, for a picture; None where it cannot be predicted, or by default."""
        return None

    def without_training(self, tracks: Sequence[int]) -> BatchLoss | None:
        """As `judge`, of the model that one has without any training; by default None: that is no other model."""
        return None

    def learned(self) -> Sequence[Learned]:
        """Numbers with a meaning that were learned, such as noise and coefficients; none by default."""
        return ()

    def groups(self) -> list[dict[str, Any]]:
        """Parameter groups for a torch optimizer, each with `name` and a `scale` on the learning rate."""
        return [{"name": "all", "params": list(self.module.parameters()), "scale": 1.0}]

    def after_step(self) -> None:  # noqa: B027 - most models have no bounds
        """Bring parameters back into their bounds after an optimizer's step; none by default."""

    def memory(self) -> dict[str, Tensor]:
        """State beside the parameters that lasts from one epoch to the next, by name: tensors (...) of any unit."""
        return {}

    def remember(self, memory: dict[str, Tensor]) -> None:
        """Restore the state that `memory` gave.

        Args: memory: tensors of any shape (...) and unit, by name.
        Raises: ValueError: if it is another run's.
        """
        if memory:
            raise ValueError(f"memory must be empty for this model; got {', '.join(sorted(memory))}.")


class Prepared(NamedTuple):
    """A trainee that is ready to train, and the numbers of the tracks that train and that validate."""

    trainee: Trainee
    train: Sequence[int]
    validation: Sequence[int]


class TraineeKind(ABC):
    """A kind of `ballfg-train`: its name and how its model is built."""

    name: ClassVar[str]
    """Value of the config's key `kind`."""
    unused: ClassVar[tuple[str, ...]] = ()
    """Keys of the config without effect on this kind, such as `model` or `launcher.start`; a config that sets one is
    refused."""
    augmented: ClassVar[bool] = False
    """True if training tracks are rotated and shifted unless the config says otherwise."""

    @classmethod
    @abstractmethod
    def build(cls, config: "TrainConfig") -> Prepared:
        """The model with its data, ready to train.

        Args: config: the whole config; the section `options` is the kind's own.
        """


NETWORKS = {"mlp": "Mlp", "mlp+gs": "MlpGramSchmidt", "skip+gs": "SkipGramSchmidt", "mnn+gs": "MnnGramSchmidt"}
"""Kinds that are a network for the dynamics, and their classes."""
SEQUENCES = {"lstm": "Lstm", "diffusion": "Diffusion"}
"""Kinds that map observations to the rest of a track, without estimator and dynamics."""

_OWN = {name: f"ballfg.learning.end_to_end.build:{cls}" for name, cls in {"a-tune": "ATune", **NETWORKS}.items()}
_OWN |= {name: f"ballfg.learning.sequence.trainee:{cls}" for name, cls in SEQUENCES.items()}
TRAINEES: Registry[TraineeKind] = Registry(
    "trainee", group="ballfg.trainees", base=TraineeKind, remedy="docs/learn.md has an example.", own=_OWN
)
"""All kinds by name."""

register_trainee = TRAINEES.register
