"""The known balls: terminal speeds, drop tests, names; drag and lift from their coefficients by the formulas."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch

import ballfg as bf
from ballfg.dynamics import Surfaces, known_balls, nominal_model
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.known_balls import KNOWN_BALLS, _read_ball, known_ball
from ballfg.dynamics.motion.integrate import fly
from ballfg.dynamics.motion.rollout import advance, rollout
from ballfg.dynamics.nominal import known_name
from ballfg.tracks import TABLE_TENNIS, Ball
from ballfg.tracks.info import TENNIS

AIR = 1.2
"""kg/m^3."""
COEFFICIENTS = {
    "tennis": (0.6, 1 / 1.4),
    "basketball": (0.54, 0.9),
    "volleyball": (0.35, 0.9),
    "football": (0.25, 1.15),
    "baseball": (0.35, 1 / (0.4 + 2.32 * 0.2)),
    "golf": (0.28, 1.25),
}
"""Drag coefficient, and lift coefficient over the spin ratio R w / v, as the files state them."""
DROPS = {
    "tennis": (2.54, 1.35, 1.47, 0.0),
    "basketball": (1.8, 1.2, 1.4, 2 * 0.121),
    "football": (2.0, 0.6, 0.85, 0.0),
}
"""m: height of the drop, least and most rebound by the rules, and how far above the ball's bottom that is measured."""
SEEN = {
    "tennis": {"drag": (0.507, 0.7), "restitution": (0.728, 0.80), "friction": (0.565, 0.725)},
    "basketball": {"restitution": (math.sqrt((1.2 - 0.242) / 1.8), math.sqrt((1.4 - 0.242) / 1.8))},
    "volleyball": {"drag": (0.13, 0.5)},
    "football": {
        "drag": (0.155, 0.5),
        "magnus": (0.18 / 0.2, 0.29 / 0.2),
        "restitution": (math.sqrt(0.3), math.sqrt(0.5)),
    },
    "baseball": {"drag": (0.30, 0.45), "magnus": (0.213 / 0.2, 0.232 / 0.2), "restitution": (0.514, 0.578)},
    "golf": {"drag": (0.17, 0.44), "magnus": (0.12 / 0.2, 0.29 / 0.2), "restitution": (0.12, 0.51)},
}
"""What sources say, least and most (docs/physics.md): drag coefficient, lift coefficient over the spin ratio, e, mu."""
PHYSICS = (Path(__file__).parents[2] / "docs" / "physics.md").read_text(encoding="utf-8")


def coefficient(name: str, group: str, effect: str, symbol: str) -> float:
    return float(getattr(getattr(nominal_model(name), group)[effect], symbol).detach())


@pytest.mark.parametrize("name", COEFFICIENTS)
def test_drag_and_lift_follow_from_the_coefficients_in_the_file(name: str) -> None:
    ball, (drag, lift) = KNOWN_BALLS[name].ball, COEFFICIENTS[name]
    half = AIR * math.pi * ball.radius**2 / (2 * ball.mass)
    assert coefficient(name, "flight", "drag", "k") == pytest.approx(half * drag, rel=0.01)
    assert coefficient(name, "flight", "magnus", "k") == pytest.approx(half * ball.radius * lift, rel=0.01)


@pytest.mark.parametrize("name", SEEN)
def test_twice_the_prior_spread_covers_what_sources_say(name: str) -> None:
    ball, declared = KNOWN_BALLS[name].ball, nominal_model(name).declared_coefficients()
    half = AIR * math.pi * ball.radius**2 / (2 * ball.mass)
    scales = {"drag": ("flight", "k", half), "magnus": ("flight", "k", half * ball.radius)}
    for effect, (low, high) in SEEN[name].items():
        group, symbol, scale = scales.get(effect, ("bounce", "e" if effect == "restitution" else "mu", 1.0))
        value = coefficient(name, group, effect, symbol)
        reach = 2.001 * declared[f"{group}.{effect}.{symbol}"].sigma + 0.002 * value  # k is rounded to three digits
        assert value - reach < low * scale < high * scale < value + reach


@pytest.mark.parametrize("name", [name for name in COEFFICIENTS if name != "tennis"])
def test_the_page_of_physics_states_the_numbers_of_the_files(name: str) -> None:
    (row,) = re.findall(rf"^\| {name}[ ,].*%.*$", PHYSICS, re.MULTILINE)
    _, size, drag, lift, restitution, friction, spreads, court = (cell.strip() for cell in row.strip("|").split("|"))
    known, (expected_drag, expected_lift) = KNOWN_BALLS[name], COEFFICIENTS[name]
    millimetres, grams = (float(number) for number in re.findall(r"[\d.]+", size))
    assert (millimetres, grams) == pytest.approx((1e3 * known.ball.radius, 1e3 * known.ball.mass), rel=1e-3)
    assert (float(drag), float(lift)) == pytest.approx((expected_drag, expected_lift), abs=0.005)
    assert float(restitution.removesuffix(", turf")) == coefficient(name, "bounce", "restitution", "e")
    assert float(friction) == coefficient(name, "bounce", "friction", "mu")
    shares = [float(number) / 100 for number in re.findall(r"\d+", spreads)]
    assert shares == pytest.approx(list(known.spreads.values()))
    sides = tuple(float(number) for number in re.findall(r"\d+", court))
    assert (sides or None) == known.court


def test_a_golf_ball_bounces_as_turf_lets_it_at_five_metres_a_second() -> None:
    """Penner's law of 2002, v in m/s into the turf."""
    speed = 5.0
    law = 0.510 - 0.0375 * speed + 0.000903 * speed**2
    assert coefficient("golf", "bounce", "restitution", "e") == pytest.approx(law, abs=0.01)


@pytest.mark.parametrize("name", KNOWN_BALLS)
def test_a_ball_that_falls_long_falls_at_the_terminal_speed(name: str) -> None:
    """With a = g - k v^2 the speed after t is sqrt(g / k) tanh(sqrt(g k) t)."""
    model, time = nominal_model(name), 3.0
    k = coefficient(name, "flight", "drag", "k")
    state = torch.zeros(1, 9, dtype=torch.float64)
    with torch.no_grad():
        fallen = fly(model, state, torch.full((1,), time, dtype=torch.float64))
        for _ in range(9):
            fallen = fly(model, fallen, torch.full((1,), time, dtype=torch.float64))
    speed = math.sqrt(9.81 / k)
    assert -float(fallen[0, 5]) == pytest.approx(speed * math.tanh(math.sqrt(9.81 * k) * 30.0), rel=1e-4)


@pytest.mark.parametrize("name", DROPS)
def test_the_drop_test_of_the_rules_of_the_game(name: str) -> None:
    """A ball that hits the ground at v = sqrt(2 g h) rises to e^2 h."""
    drop, low, high, above = DROPS[name]
    model = nominal_model(name)
    state = torch.zeros(1, 9, dtype=torch.float64)
    state[0, 2], state[0, 5] = model.radius, -math.sqrt(2 * 9.81 * drop)
    with torch.no_grad():
        speed = float(model.after_bounce(state)[0, 5])
    assert low < speed**2 / (2 * 9.81) + above < high


def test_names() -> None:
    assert (known_ball("Table-Tennis"), known_ball("soccer"), known_ball("golf ball")) == (
        "table_tennis",
        "football",
        "golf",
    )
    assert all(known_name(known.ball) == name for name, known in KNOWN_BALLS.items())
    with pytest.raises(ValueError, match=r"got 'basket ball' Did you mean 'basketball'\?"):
        known_ball("basket ball")


@pytest.mark.parametrize("name", ["badminton", "Shuttlecock"])
def test_a_shuttle_is_no_ball(name: str) -> None:
    with pytest.raises(ValueError, match="a badminton shuttle is no ball: it turns its cork ahead"):
        nominal_model(name)


def test_spreads_are_shares_of_the_values() -> None:
    sigmas = coefficient_sigmas(nominal_model("football"))
    assert sigmas["flight.drag.k"] == pytest.approx(0.5 * 0.0132)
    assert sigmas["bounce.restitution.e"] == pytest.approx(0.15 * 0.6)


def test_a_solid_ball_keeps_more_of_its_way_when_it_grips() -> None:
    """From a slide without spin, a ball that grips keeps 1 / (1 + c) of its speed; c is 2/5 solid, 2/3 hollow."""
    for name, kept in (("baseball", 1 / 1.4), ("basketball", 1 / (1 + 2 / 3))):
        model = nominal_model(name)
        state = torch.zeros(1, 9, dtype=torch.float64)
        state[0, 2], state[0, 3], state[0, 5] = model.radius + 1e-6, 1.0, -5.0
        with torch.no_grad():
            after = advance(model, state, torch.full((1,), 1e-3, dtype=torch.float64), Surfaces(0.0))
        # slip stops at v = R w; the impulse J gives v = 1 - J and R w = J / c
        assert float(after[0, 3]) == pytest.approx(kept, rel=1e-2)


def test_a_ball_is_one_file(tmp_path: Path) -> None:
    path = tmp_path / "squash.yaml"
    path.write_text(
        "ball: {radius: 0.02, mass: 0.024, source: WSF, spreads: {drag: 0.3}, court: [9.75, 6.4]}\n"
        "flight: {gravity: {}, drag: {k: 0.02}}\nbounce: {restitution: {e: 0.4}}\n",
        encoding="utf-8",
    )
    known, content = _read_ball(path)
    assert (known.ball, known.spreads, known.court) == (Ball(0.02, 0.024), {"drag": 0.3}, (9.75, 6.4))
    assert set(content) == {"flight", "bounce"}
    files = {file.stem for file in Path(known_balls.__file__).parent.glob("*.yaml")}
    assert files == set(KNOWN_BALLS)
    assert (KNOWN_BALLS["table_tennis"].ball, KNOWN_BALLS["tennis"].ball) == (TABLE_TENNIS, TENNIS)


def test_predictions_through_a_bounce_know_how_much_courts_differ() -> None:
    """A tennis ball that slides through its bounce: what another court's friction changes is within its prediction."""
    ball = nominal_model("tennis")
    start = torch.tensor([[0.0, 0.0, 1.4, 22.0, 0.0, -5.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    times = torch.arange(36, dtype=torch.float64) / 120.0
    seen = rollout(ball, start, times, Surfaces(0.0))[0, :, :3].detach().numpy()
    estimate = bf.estimate((times[:18].numpy(), seen[:18]), model=ball, surfaces=0.0)
    later = 0.6
    told = estimate.last.predict(later, later)
    assert told.next_contact.time < 0.3
    far = []
    for mu in (0.6, 0.6 * 1.15):  # the spread that the file states
        model = nominal_model("tennis")
        model.bounce["friction"].mu.data.fill_(mu)
        stamps = torch.tensor([float(told.times[-1])], dtype=torch.float64)
        far.append(float(rollout(model, start, stamps, Surfaces(0.0)).detach()[0, 0, 0]))
    assert far[0] - far[1] > 0.2
    assert 0.9 * (far[0] - far[1]) < told.sigmas[-1, 0] < 2.0 * (far[0] - far[1])
