"""Kinds of one's own beside those of the package: names, defaults and the section that is theirs."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ballfg.learning import Prepared, TrainConfig, TraineeKind, build, register_trainee
from ballfg.learning.trainee import TRAINEES
from tests.learning.run.falling_ball import FallingBalls

GIVEN = {"kind": "heavy", "options": {"masses": [1.0, 2.0]}, "data": "plain"}


class Heavy(TraineeKind):
    """Balls of given masses."""

    name = "heavy"
    unused = ("gradient",)
    augmented = True

    @classmethod
    def build(cls, config: TrainConfig) -> Prepared:
        return Prepared(FallingBalls(config.data or (), config.seed), config.options["masses"], ())


@pytest.fixture
def registered() -> Iterator[None]:
    with TRAINEES.restored():
        register_trainee(Heavy)
        yield


def test_a_registered_kind_reads_its_own_options(registered: None) -> None:
    config = TrainConfig.model_validate(GIVEN)
    assert config.augmented
    assert TrainConfig.model_validate(config.model_dump(mode="json")) == config
    trainee, train, validation = build(config)
    assert isinstance(trainee, FallingBalls)
    assert (train, validation) == ([1.0, 2.0], ())


def test_keys_without_effect_are_refused(registered: None) -> None:
    with pytest.raises(ValueError, match="'gradient' plays no part in kind 'heavy'"):
        TrainConfig.model_validate(GIVEN | {"gradient": "unrolled"})
    with pytest.raises(ValueError, match="'options' plays no part in kind 'mlp'"):
        TrainConfig.model_validate(GIVEN | {"kind": "mlp"})


def test_only_registered_kinds_are_known() -> None:
    with pytest.raises(ValueError, match=r"must be 'a-tune', 'mlp', .*; got 'heavy'"):
        TrainConfig.model_validate(GIVEN)


def test_names_are_taken_once() -> None:
    class Second(Heavy):
        name = "mlp"

    with pytest.raises(ValueError, match=r"name of a trainee must be its own; got 'mlp'"):
        register_trainee(Second)
    with pytest.raises(TypeError, match="trainee must be a subclass of TraineeKind"):
        register_trainee(FallingBalls.__mro__[1])
