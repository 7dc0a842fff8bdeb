"""What is read off a ball model."""

import pytest
import torch

from ballfg.dynamics import BallModel, model_from_dict
from ballfg.estimate.segmentation import SegmentationPhysics, physics_of


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

    def bounce(self, state):
        return -3.0 * state


def test_absurd_answers_are_clipped():
    physics = physics_of(Useless(0.02))
    assert (physics.gravity, physics.restitution, physics.friction) == (0.1, 1.0, 3.0)
    assert 0.0 <= physics.drag < 1e-12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gravity": -9.81}, r"gravity must lie in \[0.1, 100\]; got -9.81"),
        ({"restitution": 1.2}, r"restitution must lie in \[0.05, 1\]; got 1.2"),
        ({"drag": float("nan")}, "drag must be finite; got nan"),
        ({"radius": 20.0}, r"radius must lie in \[0.001, 1\]; got 20"),
    ],
)
def test_bad_numbers_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        SegmentationPhysics(**change)
