"""Kinds of one's own beside those of the package: names, defaults, section. Sub-rooms of learning import one way."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ballfg.learning import Prepared, TrainConfig, TraineeKind, build, register_trainee
from ballfg.learning.trainee import TRAINEES
from tests.learning.run.falling_ball import FallingBalls
from tests.test_layout import MODULES, imported

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


ORDER = {"config": 0, "gradient": 0, "run": 1, "end_to_end": 2, "sequence": 2, "calibration": 3}
"""A module imports from its own sub-room and from those of a lower number."""


def sub_room(module: str) -> str | None:
    parts = module.split(".")
    return parts[2] if parts[:2] == ["ballfg", "learning"] and len(parts) > 3 else None


@pytest.mark.parametrize("module", [name for name in MODULES if sub_room(name)])
def test_sub_rooms_import_one_way(module: str) -> None:
    mine = sub_room(module)
    for line, name in imported(module, MODULES[module]):
        other = sub_room(name)
        assert other in (None, mine) or ORDER[other] < ORDER[mine], f"{MODULES[module]}:{line}: {mine} imports {other}"
