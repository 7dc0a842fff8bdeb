"""The step of an analytic model's coefficients, in their prior standard deviations."""

from __future__ import annotations

from pathlib import Path

import pytest

from ballfg.learning.config.training import TrainConfig
from ballfg.learning.run.loop import make_optimizer
from ballfg.learning.run.training import build


def after_a_step(data: Path, **optimizer: float) -> dict[str, float]:
    """By how much each coefficient moves in the first step."""
    given = {"data": [str(data)], "split": {"by": "none"}, "observe": {"samples": 25}, "kind": "a-tune"}
    config = TrainConfig.model_validate(given | {"optimizer": {"learning_rate": 0.01} | optimizer})
    trainee, *_ = build(config)
    model = trainee.learnables.model
    before = {name: float(p.detach()) for name, p in model.named_parameters()}
    adam = make_optimizer(trainee, config.optimizer)
    for group in adam.param_groups:
        group["lr"] = group["scale"] * config.optimizer.learning_rate
    trainee.loss([0, 1, 2], 0).total.backward()
    adam.step()
    return {name: abs(float(p.detach()) - before[name]) for name, p in model.named_parameters()}


def test_adam_moves_each_by_the_same_share_of_its_standard_deviation(no_spin_labels: Path) -> None:
    moved = after_a_step(no_spin_labels, coefficient_step=10.0)
    assert moved["flight.drag.k"] == pytest.approx(0.01 * 10.0 * 0.035, rel=1e-3)
    assert moved["flight.magnus.k"] == pytest.approx(0.01 * 10.0 * 0.0008, rel=1e-3)
    assert moved["flight.gravity.g"] == 0.0  # as good as known
