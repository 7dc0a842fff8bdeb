"""Registers the trainees, which a config's key `kind` names.

A user's kind is a subclass of `TraineeKind` and one call of `register_trainee`, or an entry point of the group
`ballfg.trainees`. Models are imported when they are built, so that a config is checked at once.
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


TRAINEES: Registry[TraineeKind] = Registry(
    "trainee", group="ballfg.trainees", base=TraineeKind, remedy="docs/learn.md has an example."
)
"""All kinds by name."""

register_trainee = TRAINEES.register

NETWORKS = ("mlp", "mlp+gs", "skip+gs", "mnn+gs")
"""Kinds that are a network for the dynamics."""
SEQUENCES = ("lstm", "diffusion")
"""Kinds that map observations to the rest of a track, without estimator and dynamics."""


class Network(TraineeKind):
    """A network for the dynamics, trained through the estimator."""

    unused: ClassVar[tuple[str, ...]] = ("options",)

    @classmethod
    def build(cls, config: TrainConfig) -> Prepared:
        """The model with its data, ready to train."""
        from ballfg.learning.end_to_end.build import build_end_to_end

        return build_end_to_end(config)


class Sequence(TraineeKind):
    """A network from observations to the rest of a track."""

    unused: ClassVar[tuple[str, ...]] = ("architecture", "model", "noise", "gradient", "options")
    augmented = True

    @classmethod
    def build(cls, config: TrainConfig) -> Prepared:
        """The model with its data, ready to train."""
        from ballfg.learning.sequence.trainee import build_sequence

        return build_sequence(config)


@register_trainee
class ATune(Network):
    """The coefficients of the analytic model."""

    name = "a-tune"
    unused = ("architecture", "options")
    augmented = True


@register_trainee
class Mlp(Network):
    """A network on raw states, which learns the symmetry of the room from rotated and shifted tracks."""

    name = "mlp"
    augmented = True


@register_trainee
class MlpGramSchmidt(Network):
    """A network on Gram-Schmidt features, which do not change with a rotation or a shift."""

    name = "mlp+gs"


@register_trainee
class SkipGramSchmidt(Network):
    """The same with skip connections."""

    name = "skip+gs"


@register_trainee
class MnnGramSchmidt(Network):
    """The same with multiplications of hidden states."""

    name = "mnn+gs"


@register_trainee
class Lstm(Sequence):
    """A recurrent network."""

    name = "lstm"


@register_trainee
class Diffusion(Sequence):
    """A conditional diffusion model."""

    name = "diffusion"
