"""Invariances and properties of the physics over random states; coefficients; the registry."""

from __future__ import annotations

import math

import pytest
import torch

from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.effects.flight import Drag, Gravity
from ballfg.dynamics.effects.registry import effect_class
from ballfg.dynamics.motion.integrate import fly
from ballfg.dynamics.motion.rollout import advance

SURFACES = Surfaces(0.0, -0.76)


def moved(model, state):
    """Through a bounce or two."""
    with torch.no_grad():
        return advance(model, state, torch.full((len(state),), 0.45, dtype=torch.float64), SURFACES)


def turned(state, angle):
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor(((c, -s, 0), (s, c, 0), (0, 0, 1)), dtype=torch.float64)
    return (state.reshape(-1, 3, 3) @ rotation.T).reshape(state.shape)


@pytest.mark.parametrize("angle", [0.3, 1.9, -2.7])
def test_rotation_about_the_vertical(model, states, angle):
    state = states(30)
    torch.testing.assert_close(
        moved(model, turned(state, angle)), turned(moved(model, state), angle), rtol=0, atol=1e-9
    )


def test_shift_along_the_table(model, states):
    state = states(30)
    shift = torch.tensor((1.7, -0.4, 0, 0, 0, 0, 0, 0, 0), dtype=torch.float64)
    torch.testing.assert_close(moved(model, state + shift), moved(model, state) + shift, rtol=0, atol=1e-9)


def test_shift_of_everything_up(model, states):
    state = states(30)
    up = torch.tensor((0, 0, 0.76, 0, 0, 0, 0, 0, 0), dtype=torch.float64)
    dt = torch.full((30,), 0.45, dtype=torch.float64)
    with torch.no_grad():
        raised = advance(model, state + up, dt, Surfaces(0.76, 0.0))
    torch.testing.assert_close(raised, moved(model, state) + up, rtol=0, atol=1e-9)


def test_mirror(model, states):
    """y -> -y: velocities are vectors, spins are axial vectors."""
    state = states(30)
    mirror = torch.tensor((1, -1, 1, 1, -1, 1, -1, 1, -1), dtype=torch.float64)
    torch.testing.assert_close(moved(model, state * mirror), moved(model, state) * mirror, rtol=0, atol=1e-9)


def test_the_random_states_do_bounce(model, states):
    assert bool((moved(model, states(30))[:, 5] != 0).all())
    with torch.no_grad():
        free = fly(model, states(30), torch.full((30,), 0.45, dtype=torch.float64))
    assert float((free - moved(model, states(30))).abs().amax(-1).min()) > 1e-3


def test_drag_takes_energy_and_magnus_gives_none(build, states):
    state = states(50)

    def power(model):
        with torch.no_grad():
            return (model.rates(state)[0] * state[:, 3:6]).sum(-1)

    assert bool((power(build(drag={})) < 0).all())
    assert float(power(build(magnus={})).abs().max()) < 1e-13


def test_without_spin_there_is_no_magnus_force(build, states):
    state = states(10)
    state[:, 6:] = 0.0
    with torch.no_grad():
        assert float(build(magnus={}).rates(state)[0].abs().max()) == 0.0


@pytest.mark.parametrize(
    ("spin", "axis", "sign"),
    [((0, 100.0, 0), 2, -1), ((0, -100.0, 0), 2, 1), ((0, 0, 100.0), 1, 1), ((0, 0, -100.0), 1, -1)],
    ids=["topspin dives", "backspin lifts", "anticlockwise turns left", "clockwise turns right"],
)
def test_signs_of_magnus(build, spin, axis, sign):
    state = torch.tensor([[0, 0, 0, 5.0, 0, 0, *spin]], dtype=torch.float64)
    with torch.no_grad():
        force = build(magnus={}).rates(state)[0][0]
    assert math.copysign(1, force[axis].item()) == sign
    assert force[axis].abs().item() == pytest.approx(0.0028 * 100 * 5)


def test_effects_add_up(build, states):
    state = states(20)
    with torch.no_grad():
        whole = build(gravity={}, drag={}, magnus={}).rates(state)[0]
        parts = sum(build(**{name: {}}).rates(state)[0] for name in ("gravity", "drag", "magnus"))
    torch.testing.assert_close(whole, parts, rtol=0, atol=1e-13)


def test_order_of_effects_does_not_matter(model, states):
    effects = [*model.flight.values(), *model.bounce.values()]
    torch.testing.assert_close(moved(AnalyticModel(reversed(effects)), states(20)), moved(model, states(20)))


def test_spin_rate_is_none_where_nothing_changes_the_spin(build, states):
    assert build(gravity={}, drag={}, magnus={}).rates(states(1))[1] is None
    assert build(spin_decay={}).rates(states(1))[1].shape == (1, 3)


def test_a_model_without_effects_flies_straight(build, states):
    acceleration, spin_rate = build().rates(states(4))
    assert acceleration.shape == (4, 3)
    assert float(acceleration.abs().max()) == 0.0
    assert spin_rate is None


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_describes_itself(name):
    effect = EFFECTS[name]()
    assert effect.name == name
    assert effect.kind in ("flight", "bounce", "measurement")
    assert effect.sentence.endswith(".")
    assert effect.decide.endswith(".")
    assert set(effect.needs) <= set(EFFECTS)
    assert any(c.absent is not None for c in effect.coefficients)
    for c in effect.coefficients:
        assert c.low <= c.default <= c.high
        assert c.sigma >= 0
        assert c.absent is None or c.low <= c.absent <= c.high
        parameter = getattr(effect, c.name)
        assert parameter.dtype == torch.float64
        assert parameter.requires_grad
        assert parameter.item() == c.default
        for bad in (c.low - 1e-6, c.high + 1e-6, math.nan, math.inf):
            with pytest.raises(ValueError, match=rf"{name}\.{c.name} must lie in \[.*\] .*; got .*Check its unit\."):
                EFFECTS[name](**{c.name: bad})
        EFFECTS[name](**{c.name: c.low})
        EFFECTS[name](**{c.name: c.high})


def test_unknown_coefficient():
    with pytest.raises(ValueError, match=r"^effect 'drag' has no coefficient 'cd'; it has k$"):
        Drag(cd=0.4)


def test_unknown_effect_and_wrong_kind():
    with pytest.raises(ValueError, match=r"^there is no flight effect 'gale'; known ones: gravity, drag, "):
        effect_class("gale", "flight")
    with pytest.raises(ValueError, match=r"^there is no bounce effect 'drag'; known ones: restitution, friction"):
        effect_class("drag", "bounce")


def test_an_effect_given_twice():
    with pytest.raises(ValueError, match=r"^effects must differ; 'drag' was given twice\. Remove one\.$"):
        AnalyticModel([Drag(), Gravity(), Drag()])


@pytest.mark.parametrize("radius", [0.0, 20.0, -0.02, math.nan])
def test_bad_radius(radius):
    with pytest.raises(ValueError, match=r"^radius must be 0\.001 to 1 m; got .*\. Is it in millimetres\?$"):
        AnalyticModel([], radius=radius)


@pytest.mark.parametrize("inertia", [0.0, 1.1, math.nan])
def test_bad_inertia(inertia):
    with pytest.raises(ValueError, match=r"^inertia_factor must lie in \(0, 1\]; got .*thin shell has 2/3"):
        AnalyticModel([], inertia_factor=inertia)


def test_coefficient_sigmas(model, network):
    sigmas = coefficient_sigmas(model)
    assert sigmas["flight.drag.k"] == Drag.coefficients[0].sigma
    assert set(sigmas) <= {name for name, _ in model.named_parameters()}
    assert "flight.gravity.g" not in sigmas  # as good as known
    assert coefficient_sigmas(network) == {}


def test_printing_a_model_shows_ball_and_effects(model):
    text = repr(model)
    assert "radius=0.02 m, inertia_factor=0.666667" in text
    assert "(magnus): Magnus()" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"table_height": math.nan}, r"table_height must be finite; got nan\. Correct it \(unit: m\)\."),
        ({"floor_height": 0.0}, "floor_height must lie below table_height 0 m; got 0 m"),
        ({"edge_sigmas": (0, -1, 0, 0)}, r"edge_sigmas must be finite and not negative, in m; got \(0, -1, 0, 0\)"),
        ({"extent": (1, 0, 0, 1)}, r"extent must be \(x_low, x_high, y_low, y_high\); got \(1, 0, 0, 1\)"),
    ],
)
def test_bad_surfaces(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        Surfaces(**arguments)


def test_surfaces():
    surfaces = Surfaces.table_tennis(0.7)
    assert surfaces.heights() == (0.7, pytest.approx(-0.06))
    assert Surfaces(0.1).heights() == (0.1,)
    assert Surfaces() == Surfaces(0.0, None, None)  # the frame's origin lies on it
    state = torch.zeros((3, 9), dtype=torch.float64)
    state[:, 2] = torch.tensor((1.0, 0.71, 0.69))
    assert surfaces.height_below(state, 0.0).tolist() == [0.7, 0.7, pytest.approx(-0.06)]
    beside = Surfaces(0.7, 0.0, (1.0, 2.0, 0.0, 1.0))
    assert beside.height_below(state, 0.0).tolist() == [0.0, 0.0, 0.0]
    assert beside.level_below(state, 0.0).tolist() == [0.7, 0.7, 0.0]
    assert Surfaces(0.7).lowest() == -math.inf
