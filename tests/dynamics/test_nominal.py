"""The nominal model of a ball: which known ball it is, and what is guessed for any other."""

from __future__ import annotations

import math

import pytest

from ballfg.dynamics import AnalyticModel, nominal_model
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.model_file import model_to_dict
from ballfg.dynamics.nominal import air_coefficients, nominal_note
from ballfg.tracks import TABLE_TENNIS, Ball
from ballfg.tracks.info import TENNIS

SQUASH = Ball(radius=0.02, mass=0.024)
TENNIS_DRAG = 0.6
"""Drag coefficient of a tennis ball: 0.5 to 0.65 (docs/physics.md)."""


def drag(model: AnalyticModel) -> float:
    return float(model.flight["drag"].k.detach())  # type: ignore[operator]


def test_the_table_tennis_ball() -> None:
    expected = {
        "flight": {"gravity": {"g": 9.81}, "drag": {"k": 0.12}, "magnus": {"k": 0.0028}},
        "bounce": {
            "restitution": {"e": 0.93},
            "friction": {"mu": 0.25},
            "tangential_restitution": {"e_t": 0.15},
            "table_height": {"offset": -0.003},
        },
        "measurement": {},
        "learned": None,
    }
    sigmas = {"flight.drag.k": 0.035, "bounce.restitution.e": 0.02, "bounce.table_height.offset": 0.004}
    for model in (nominal_model(), nominal_model(TABLE_TENNIS), nominal_model(0.02)):
        assert model_to_dict(model) == expected
        assert coefficient_sigmas(model) == sigmas
        assert model.radius == 0.02


def test_a_tennis_ball_is_no_table_tennis_ball() -> None:
    model = nominal_model(TENNIS)
    assert model.radius == TENNIS.radius
    assert (drag(model), float(model.flight["magnus"].k.detach())) == air_coefficients(TENNIS, TENNIS_DRAG)  # type: ignore[operator]
    assert model_to_dict(model)["bounce"] == {"restitution": {"e": 0.75}, "friction": {"mu": 0.6}}
    assert model.declared_coefficients()["flight.drag.k"].sigma == pytest.approx(0.3 * drag(model))


@pytest.mark.parametrize(
    ("ball", "expected"),
    [
        (Ball(0.019, 0.0025), "table tennis"),  # the 38 mm ball of before the year 2000
        (Ball(0.0327, 0.056), "tennis"),
        (Ball(0.0343, 0.0594), "tennis"),
        (SQUASH, None),
        (Ball(0.0367, 0.147), "baseball"),
        (Ball(0.02, 0.0577), None),  # only the mass is that of a tennis ball
        (Ball(0.11, 0.35), None),  # between a volleyball and a football
    ],
)
def test_a_ball_is_a_known_one_if_radius_and_mass_are_near(ball: Ball, expected: str | None) -> None:
    known = {"table tennis": 0.12, "tennis": drag(nominal_model(TENNIS)), "baseball": 0.00618}
    known |= {None: air_coefficients(ball)[0]}
    assert drag(nominal_model(ball)) == known[expected]
    assert nominal_model(ball).radius == ball.radius
    assert (nominal_note(ball) is None) == (expected is not None)


def test_an_unknown_ball_gets_physics_wide_priors_and_a_note() -> None:
    model = nominal_model(SQUASH)
    assert drag(model) == pytest.approx(1.2 * 0.5 * math.pi * SQUASH.radius**2 / (2 * SQUASH.mass))
    sigmas = coefficient_sigmas(model)
    assert sigmas["flight.drag.k"] == pytest.approx(0.5 * drag(model))
    assert sigmas["bounce.restitution.e"] == pytest.approx(0.15)
    assert coefficient_sigmas(nominal_model())["bounce.restitution.e"] == 0.02  # other models keep theirs
    note = nominal_note(SQUASH)
    assert note is not None
    assert note.startswith("no nominal model for a ball of 0.02 m radius and 0.024 kg: drag and Magnus force follow")
    assert "\n" not in note


def test_air_coefficients_follow_from_size_and_mass() -> None:
    ball = Ball(radius=0.033, mass=0.058)
    drag, magnus = air_coefficients(ball, TENNIS_DRAG)
    assert drag == pytest.approx(0.0213, rel=0.01)
    spin, speed = 150.0, 24.75  # spin ratio 0.2, where the lift law was made linear
    lift = 1.2 * math.pi * ball.radius**2 * speed**2 / (2 * ball.mass) / (2 + speed / (ball.radius * spin))
    assert magnus * spin * speed == pytest.approx(lift, rel=1e-12)


def test_balls_that_cannot_be_guessed() -> None:
    with pytest.raises(ValueError, match=r"^nominal model: drag\.k must lie in \[0, 2\] 1/m; got 7\.06"):
        nominal_model(Ball(0.15, 0.003))
    with pytest.raises(ValueError, match=r"radius must be 0\.001 to 1 m"):
        nominal_model(20.0)


def test_unknown_sigma() -> None:
    with pytest.raises(KeyError):
        nominal_model().flight["drag"].set_sigmas(c=0.1)  # type: ignore[operator]
