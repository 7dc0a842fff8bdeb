"""The registry of trainees: what a config's key `kind` can name.

A kind of one's own is a subclass of `TraineeKind` and one call of `register_trainee`, or an entry point of the group
`ballfg.trainees`. This module imports nothing heavy, so that a config is checked at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar

from ballfg.registry import Registry

if TYPE_CHECKING:
    from ballfg.learning.config.training import TrainConfig
    from ballfg.learning.trainee import Prepared


class TraineeKind(ABC):
    """A kind of `ballfg-train`: its name and how its model is built."""

    name: ClassVar[str]
    """Value of the config's key `kind`."""
    unused: ClassVar[tuple[str, ...]] = ()
    """Keys of the config without effect on this kind; a config that sets one is refused."""
    augmented: ClassVar[bool] = False
    """Whether training tracks are rotated and shifted unless the config says otherwise."""

    @classmethod
    @abstractmethod
    def build(cls, config: TrainConfig) -> Prepared:
        """The model with its data, ready to train.

        Args: config: the whole config; the section `options` is the kind's own.
        """


TRAINEES: Registry[TraineeKind] = Registry(
    "trainee", group="ballfg.trainees", base=TraineeKind, remedy="docs/learn.md has an example."
)
"""All kinds by name."""

register_trainee = TRAINEES.register
