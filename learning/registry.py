"""Registers the trainees, which a config's key `kind` names.

A kind of one's own is a subclass of `TraineeKind` and one call of `register_trainee`, or an entry point of the group
`ballfg.trainees`. Those of the package stand beside what they build, and are imported when they are named.
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
    """True if training tracks are rotated and shifted unless the config says otherwise."""

    @classmethod
    @abstractmethod
    def build(cls, config: TrainConfig) -> Prepared:
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
