"""The catalogue of effects: formulas by another route, derivatives of every kind, absence, what they need."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics import EFFECTS, AnalyticModel
from ballfg.dynamics.effect import Coefficient, FlightEffect
from ballfg.dynamics.effects.registry import GENERIC
from ballfg.dynamics.model import substitute, take_rows
from ballfg.dynamics.motion.integrate import fly
from ballfg.tracks.checks import MAX_COORDINATE

BASE = {
    "gravity": {"g": 9.8},
    "drag": {"k": 0.12},
    "magnus": {"k": 0.003},
    "restitution": {"e": 0.9},
    "friction": {"mu": 0.25},
    "tangential_restitution": {"e_t": 0.15},
}
KINDS = ("flight", "bounce", "measurement")
V, W, P = np.array([5.0, -1.0, -2.0]), np.array([40.0, -150.0, 60.0]), np.array([1.2, 0.3, 1.1])
STATE = torch.from_numpy(np.concatenate((P, V, W)))[None]
GRIPS = torch.tensor([[1.2, 0.3, 1.1, 0.5, 0.2, -4.0, 5.0, 3.0, 60.0]], dtype=torch.float64)
TIMES = torch.tensor([[0.2]], dtype=torch.float64)


def model_with(name=None, **values):
    """The base, with an effect in place of its own of that name."""
    effects = [EFFECTS[n](**v) for n, v in BASE.items() if n != name]
    return AnalyticModel(effects if name is None else [*effects, EFFECTS[name](**values)])


def present(c, share=1.0):
    """A value at which an effect shows."""
    return c.default + share * min(c.sigma or 1.0, c.high - c.default)


def ballistic(state):
    """The true motion, for effects that look later: a parabola."""

    def later(delay):
        delay = delay.unsqueeze(-1)
        down = torch.tensor((0.0, 0.0, -9.8), dtype=torch.float64)
        moved = state[..., :3] + delay * state[..., 3:6] + 0.5 * delay**2 * down
        return torch.cat((moved, state[..., 3:6] + delay * down, state[..., 6:]), dim=-1)

    return later


def said(model, state, kind):
    """All that effects of a kind can change, in one row a state."""
    if kind == "flight":
        acceleration, spin_rate = model.rates(state)
        return torch.cat((acceleration, torch.zeros_like(acceleration) if spin_rate is None else spin_rate), dim=-1)
    if kind == "bounce":
        gaps = (model.gap(state, 0.0), model.gap_rate(state), model.gap_acceleration(state))
        return torch.cat((model.after_bounce(state)[..., 3:], torch.stack(gaps, dim=-1)), dim=-1)
    stamps = model.true_stamps(TIMES.expand(len(state), 1))
    return torch.cat((model.measured(state, ballistic(state)), stamps, model.labelled(state[..., 6:])), dim=-1)


def everything(model, state):
    """All that a model says of a state."""
    return torch.cat([said(model, state, kind) for kind in KINDS], dim=-1)


def parameters(name):
    return [f"{EFFECTS[name].kind}.{name}.{c.name}" for c in EFFECTS[name].coefficients]


@pytest.mark.parametrize("name", EFFECTS)
def test_absent_is_the_model_without(name):
    values = {c.name: c.default if c.absent is None else c.absent for c in EFFECTS[name].coefficients}
    states = torch.cat((STATE, GRIPS))
    with torch.no_grad():
        without = everything(AnalyticModel([EFFECTS[n](**v) for n, v in BASE.items() if n != name]), states)
        torch.testing.assert_close(everything(model_with(name, **values), states), without, rtol=0, atol=0)
        changed = {c.name: present(c, 1 / (i + 1)) for i, c in enumerate(EFFECTS[name].coefficients)}
        assert float((everything(model_with(name, **changed), states) - without).abs().max()) > 1e-5


@pytest.mark.parametrize("name", [n for n in EFFECTS if n not in (*BASE, "spin_decay")])
def test_a_file_that_names_an_effect_without_a_value_gets_nothing(name):
    for c in EFFECTS[name].coefficients:
        assert c.absent is None or c.absent == c.default
        of_a_ratio = (1.0 + c.low) * (1.0 + c.high) == pytest.approx(1.0)  # 1 + s from a tenth to ten
        assert c.absent is None or c.low in (-c.high, 0.0) or of_a_ratio


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # torch's, in forward mode
@pytest.mark.parametrize("share", [0.0, 1.0], ids=["default", "present"])
@pytest.mark.parametrize("name", [n for n in EFFECTS if n != "time_offset"])  # in test_measurement.py
def test_first_and_second_derivatives(name, share):
    """Backward, forward and second derivatives, each against central differences, by state and coefficients a row."""
    model = model_with(name)
    state = torch.cat((STATE, GRIPS))
    columns = [
        torch.tensor([[present(c, share)], [present(c, 0.5 * share)]], dtype=torch.float64)
        + 0.1 * c.sigma * i * (share > 0)
        for i, c in enumerate(EFFECTS[name].coefficients)
    ]
    scale = torch.tensor([1.0] * 6 + [30.0] * 3, dtype=torch.float64)

    def function(scaled, *values):
        other = substitute(model, dict(zip(parameters(name), values, strict=True)))
        return said(other, scaled * scale, EFFECTS[name].kind)

    inputs = [x.requires_grad_() for x in ((state / scale).clone(), *columns)]
    assert torch.autograd.gradcheck(function, inputs, check_forward_ad=True, atol=1e-5, rtol=1e-5)
    assert torch.autograd.gradgradcheck(lambda *x: function(*x).sin(), inputs, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if e.kind == "flight"])
def test_derivatives_are_finite_without_spin_and_at_rest(name):
    model = model_with(name)
    states = STATE.repeat(3, 1)
    states[0, 6:] = 0.0
    states[1, 3:6] = 0.0
    states[2, 3:] = 0.0
    states.requires_grad_()
    acceleration, _ = model.rates(states)
    inputs = (states, *(p for n, p in model.named_parameters() if n in parameters(name)))
    first = torch.autograd.grad(acceleration.square().sum(), inputs, create_graph=True, allow_unused=True)
    total = sum(g.sum() for g in first if g is not None)
    second = torch.autograd.grad(total, inputs, allow_unused=True)
    assert all(bool(g.isfinite().all()) for g in (*first, *second) if g is not None)
    with torch.no_grad():
        assert bool(model.rates(states)[0].isfinite().all())


@pytest.mark.parametrize("name", EFFECTS)
def test_coefficients_may_differ_from_row_to_row(name):
    model, state = model_with(name), STATE * torch.tensor([[1.0], [0.8], [1.1]], dtype=torch.float64)
    shares = torch.tensor([[0.1], [0.2], [0.4]], dtype=torch.float64)
    rows = {p: present(c, shares) for p, c in zip(parameters(name), EFFECTS[name].coefficients, strict=True)}
    with torch.no_grad():
        together = substitute(model, rows)
        for i in range(3):
            alone = substitute(model, {p: value[i, 0] for p, value in rows.items()})
            expected = everything(alone, state[i : i + 1])[0]
            torch.testing.assert_close(everything(together, state)[i], expected, rtol=1e-13, atol=1e-13)
        taken = take_rows(together, torch.tensor([False, True, True]), 3)
        torch.testing.assert_close(
            everything(taken, state[1:]), everything(together, state)[1:], rtol=1e-13, atol=1e-13
        )


def added(name, **values):
    """(3,) m/s^2 that an effect adds to the base's acceleration in `STATE`."""
    with torch.no_grad():
        return (model_with(name, **values).rates(STATE)[0] - model_with().rates(STATE)[0])[0].numpy()


def air_forces(v):
    return -0.12 * np.linalg.norm(v) * v + 0.003 * np.cross(W, v)


@pytest.mark.parametrize(
    ("name", "values", "air"),
    [
        ("wind", {"x": 0.5, "y": -0.3, "z": 0.1}, [0.5, -0.3, 0.1]),
        ("wind_shear", {"x": 0.5, "y": -1.0, "reference": 0.7}, [0.5 * 0.4, -0.4, 0.0]),
        ("gust_region", {"x": 0.5, "center_x": 1.2, "center_y": 0.3, "center_z": 1.1}, [0.5, 0.0, 0.0]),
        (
            "gust_region",
            {"z": 2.0, "center_x": 1.2, "center_y": 0.0, "center_z": 1.5, "size": 0.5},
            [0, 0, 2 / np.e**0.5],
        ),
    ],
)
def test_moving_air_moves_the_frame_of_all_air_forces(name, values, air):
    np.testing.assert_allclose(added(name, **values), air_forces(V - np.array(air)) - air_forces(V), atol=1e-12)


def test_formulas_of_the_air_effects():
    speed = np.linalg.norm(V)
    ratio = 0.02 * np.linalg.norm(W) / speed
    drag = -0.12 * speed * V
    np.testing.assert_allclose(added("drag_speed", slope=0.02, reference=4.0), 0.02 * (speed - 4) * drag, rtol=1e-10)
    np.testing.assert_allclose(added("drag_spin", gain=0.3), 0.3 * ratio * drag, rtol=1e-10)
    lost = 0.003 * np.cross(W, V) * (1 / (1 + 0.5 * ratio) - 1)
    np.testing.assert_allclose(added("magnus_saturation", strength=0.5), lost, rtol=1e-10)
    np.testing.assert_allclose(added("buoyancy", a=0.146), [0, 0, 0.146], atol=1e-13)


def test_buoyancy_is_a_smaller_g():
    effects = {**BASE, "gravity": {"g": 9.8 - 0.146}}
    lighter = AnalyticModel([EFFECTS[n](**v) for n, v in effects.items()])
    torch.testing.assert_close(
        model_with("buoyancy", a=0.146).rates(STATE)[0], lighter.rates(STATE)[0], rtol=0, atol=1e-13
    )


def test_air_effects_act_together():
    """In wind the speed that drag_speed sees is that against the air; shares of drag add up."""
    extra = {"wind": {"x": 1.0}, "drag_speed": {"slope": 0.02}, "drag_spin": {"gain": 0.3}}
    model = AnalyticModel([EFFECTS[n](**v) for n, v in {**extra, **BASE}.items()])
    u = V - np.array([1.0, 0, 0])
    speed = np.linalg.norm(u)
    gain = 1 + 0.02 * (speed - 5) + 0.3 * 0.02 * np.linalg.norm(W) / speed
    expected = -0.12 * gain * speed * u + 0.003 * np.cross(W, u) + np.array([0, 0, -9.8])
    np.testing.assert_allclose(model.rates(STATE)[0][0].detach(), expected, rtol=1e-12)


def test_substitute_reaches_what_other_effects_multiply():
    model = model_with("drag_spin", gain=0.3)
    other = substitute(model, {"flight.drag.k": torch.tensor(0.24, dtype=torch.float64)})
    drag = (
        model.rates(STATE)[0]
        - substitute(model, {"flight.drag.k": torch.zeros((), dtype=torch.float64)}).rates(STATE)[0]
    )
    torch.testing.assert_close(other.rates(STATE)[0] - model.rates(STATE)[0], drag, rtol=1e-12, atol=1e-12)


def test_restitution_falls_with_speed_whatever_the_order():
    effects = [EFFECTS["restitution_speed"](slope=0.02, reference=1.0), EFFECTS["restitution"](e=0.9)]
    for given in (effects, effects[::-1]):
        model = AnalyticModel(given)
        assert list(model.bounce) == ["restitution", "restitution_speed"]
        assert model.after_bounce(STATE)[0, 5].item() == pytest.approx((0.9 - 0.02) * 2.0, abs=1e-14)


class Chained(FlightEffect):
    name = "chained"
    sentence = "An effect that changes one that changes another."
    decide = "Nothing."
    coefficients = (Coefficient("c", 0.0, 1.0, "1", -1.0, 1.0),)
    needs = ("drag_spin", "drag")


def test_effects_stand_behind_what_they_need():
    drag, spin, gravity = EFFECTS["drag"](), EFFECTS["drag_spin"](), EFFECTS["gravity"]()
    assert list(AnalyticModel([Chained(), spin, gravity, drag]).flight) == ["gravity", "drag", "drag_spin", "chained"]
    with pytest.raises(ValueError, match=r"got 'chained' without 'drag'\. Add drag to the model or leave chained out"):
        AnalyticModel([Chained(), spin])


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if e.needs])
def test_effects_that_change_another_are_refused_without_it(name):
    (needed,) = EFFECTS[name].needs
    with pytest.raises(
        ValueError,
        match=rf"^effects must come with those that they change; got '{name}' without '{needed}'\. Add {needed} to",
    ):
        AnalyticModel([EFFECTS[name]()])


def test_a_rotating_room_is_a_constant_extra_spin():
    """Coriolis acceleration -2 W x v equals the Magnus force of the spin -2 W / k; centrifugal terms left out."""
    room = np.array([0.0, 0.0, 0.01])
    shifted = STATE.clone()
    shifted[:, 6:] += torch.from_numpy(-2 * room / 0.003)
    difference = (model_with().rates(shifted)[0] - model_with().rates(STATE)[0])[0].detach().numpy()
    np.testing.assert_allclose(difference, -2 * np.cross(room, V), atol=1e-12)


def test_another_time_scale_is_another_g_and_magnus_coefficient():
    """With written time (1 + s) t: velocities are 1 / (1 + s) as large, g by its square; drag stays, spins stay."""
    s = 0.02
    slow = AnalyticModel(
        [EFFECTS["gravity"](g=9.8 / (1 + s) ** 2), EFFECTS["drag"](k=0.12), EFFECTS["magnus"](k=0.003 / (1 + s))]
    )
    stamp = EFFECTS["time_scale"](s=s).stamps(TIMES[0])
    start = STATE * torch.tensor([1.0] * 3 + [1 / (1 + s)] * 3 + [1.0] * 3, dtype=torch.float64)
    seen, true = fly(slow, start, stamp), fly(model_with(), STATE, TIMES[0])
    torch.testing.assert_close(seen[:, :3], true[:, :3], rtol=0, atol=1e-9)


@pytest.mark.parametrize("effect", [*EFFECTS.values(), *GENERIC.values()])
def test_a_place_may_lie_wherever_a_track_may(effect):
    """A diagnosis puts it in the middle of the data, and a golf ball lands 200 m away."""
    for c in effect.coefficients:
        if c.absent is None and c.unit == "m" and c.low < 0.0:
            assert c.low == -MAX_COORDINATE
            assert c.high == MAX_COORDINATE
