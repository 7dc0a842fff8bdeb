"""The distance from the analytic model: its units, what it keeps in place, and its share of the loss."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from ballfg.dynamics import nominal_model
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.end_to_end.pretrain import Anchor, random_states
from ballfg.learning.run.training import build
from ballfg.state import VELOCITY, VZ
from tests.small_networks import SMALL


def test_it_is_zero_at_the_start_and_in_the_units_of_an_acceleration() -> None:
    model = nominal_model()
    anchor = Anchor(model, model, 0)
    assert float(anchor().detach()) < 1e-24  # rounding
    with torch.no_grad():
        model.flight.gravity.g += 0.3  # 0.3 m/s^2 in one of three components; the bounce does not change
    assert float(anchor().detach()) == pytest.approx(0.3**2 / 3)


def test_a_change_of_drag_counts_as_the_acceleration_that_it_makes() -> None:
    model = nominal_model()
    anchor = Anchor(model, model, 3)
    with torch.no_grad():
        model.flight.drag.k += 0.02
    velocity = random_states(3, 256)[0][:, VELOCITY]
    speed = velocity.norm(dim=-1)
    assert float(anchor().detach()) == pytest.approx(float((0.02 * speed**2).square().mean() / 3), rel=1e-9)


def test_states_fly_in_all_directions_and_fall() -> None:
    flying, falling = random_states(1, 2000)
    assert (falling[:, VZ] < -0.2).all()
    assert flying[:, VELOCITY].mean(0).abs().max() < 0.4
    assert torch.equal(random_states(1, 2000)[0], flying)


@pytest.mark.usefixtures("networks_in_torch")
def test_its_weight_adds_its_gradient_for_each_track(no_spin_labels: Path) -> None:
    """Two losses that differ in the weight alone differ by the anchor's gradient, times tracks and weight."""
    gradients = []
    for weight in (1e-9, 0.5):
        given = {"data": [str(no_spin_labels)], "split": {"by": "none"}, "observe": {"samples": 25}}
        given |= {"architecture": SMALL | {"residual": True}, "loss": {"anchor": weight}}
        trainee, *_ = build(TrainConfig.model_validate(given))
        model = trainee.learnables.model
        with torch.no_grad():
            model.flight.bias += 0.2
        trainee.loss([0, 1, 2], 0).total.backward()
        gradients.append(float(model.flight.bias.grad))
    assert gradients[1] - gradients[0] == pytest.approx(0.5 * 3 * 2 * 0.2 / 3, rel=1e-6)
