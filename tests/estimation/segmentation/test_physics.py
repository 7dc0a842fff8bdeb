"""What is read off a ball model."""

import pytest
import torch

from ballfg.dynamics import Architecture, BallModel, build
from ballfg.dynamics.model_file import model_from_dict
from ballfg.estimation.segmentation.physics import SegmentationPhysics, physics_of


def test_the_numbers_of_an_analytic_model_are_its_own():
    model = model_from_dict(
        {
            "flight": {"gravity": {"g": 9.7}, "drag": {"k": 0.11}, "magnus": {"k": 0.003}},
            "bounce": {"restitution": {"e": 0.88}, "friction": {"mu": 0.3}, "table_height": {"offset": -0.004}},
        },
        radius=0.025,
    )
    physics = physics_of(model)
    assert physics.gravity == pytest.approx(9.7, rel=1e-12)
    assert physics.drag == pytest.approx(0.11, rel=1e-9)
    assert physics.restitution == pytest.approx(0.88, rel=1e-9)
    assert physics.friction == pytest.approx(0.3, rel=1e-9)
    assert physics.surface_offset == pytest.approx(-0.004, rel=1e-12)
    assert physics.radius == 0.025


class Useless(BallModel):
    """An untrained model may say anything."""

    def rates(self, state):
        return torch.ones_like(state[..., :3]), None

    def after_bounce(self, state):
        return -3.0 * state


def test_absurd_answers_give_way_to_a_table_tennis_ball():
    physics, usual = physics_of(Useless(0.02)), SegmentationPhysics()
    assert (physics.gravity, physics.restitution, physics.friction) == (
        usual.gravity,
        usual.restitution,
        usual.friction,
    )
    assert 0.0 <= physics.drag < 1e-12


def test_learned_contacts_are_asked_what_they_may_know():
    """A network that was never shown a slip of more than 15 m/s may say anything about it."""

    class Learned(BallModel):
        def rates(self, state):
            return torch.zeros_like(state[..., :3]), None

        def after_bounce(self, state):
            inside = state[..., 3:4].abs() < 15.0
            after = inner.after_bounce(state)
            return torch.where(inside, after, 2.0 * state)

    inner = model_from_dict({"flight": {}, "bounce": {"restitution": {"e": 0.9}, "friction": {"mu": 0.2}}})
    assert physics_of(Learned(0.02)).friction == pytest.approx(0.2, rel=1e-9)


def test_what_a_model_answered_is_asked_again_when_its_numbers_change():
    model = model_from_dict({"flight": {"gravity": {}, "drag": {"k": 0.11}}, "bounce": {"restitution": {"e": 0.9}}})
    assert physics_of(model) is physics_of(model)
    with torch.no_grad():
        dict(model.named_parameters())["flight.drag.k"].fill_(0.2)
    assert physics_of(model).drag == pytest.approx(0.2, rel=1e-9)
    dict(model.named_parameters())["flight.drag.k"].data.fill_(0.3)  # past the version counter
    assert physics_of(model).drag == pytest.approx(0.3, rel=1e-9)
    learned = build(Architecture.of("mlp", width_flight=8, width_contact=8, depth=1), radius=0.02, seed=1)
    before = physics_of(learned)
    with torch.no_grad():
        for parameter in learned.parameters():
            parameter.add_(0.1)
    assert physics_of(learned) != before
