"""Effects that nobody declares: their formulas, their names, and that they change the tracks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from ballfg.dynamics import EFFECTS, AnalyticModel, Effect, Flight, FlightEffect, model_from_dict, nominal_model
from ballfg.dynamics.model import substitute
from ballfg.simulate import UNDECLARED, MeasurementNoise, SimulatedTrack, SimulationConfig, parse_effects, simulate
from ballfg.simulate.composition import true_model
from ballfg.simulate.undeclared import MeasurementEffect

STATE = torch.tensor([[1.2, 0.3, 1.1, 5.0, -1.0, 2.0, 40.0, -150.0, 60.0]], dtype=torch.float64)
ONE_OF_EACH = {
    "wind": "wind.x=0.3",
    "gust_region": "gust_region.y=0.5",
    "drag_speed": "drag_speed.slope=0.02",
    "drag_spin": "drag_spin.gain=0.3",
    "magnus_saturation": "magnus_saturation.strength=0.5",
    "pull": "pull.strength=0.3",
    "restitution_speed": "restitution_speed.slope=0.02",
    "time_offset": "time_offset.z=0.004",
    "frame_tilt": "frame_tilt.x=0.01",
    "scale": "scale.z=0.01",
    "spin_decay": "spin_decay.rate=0.3",
    "tangential_restitution": "tangential_restitution.e_t=0.4",
}


def run(*effects: str) -> list[SimulatedTrack]:
    noise = MeasurementNoise(position=0.0, spin=0.0)
    return list(simulate(SimulationConfig(tracks=6, seed=2, noise=noise, undeclared=parse_effects(effects))))


@pytest.fixture(scope="module")
def plain() -> list[SimulatedTrack]:
    return run()


def acceleration(model: AnalyticModel, state: Tensor = STATE) -> np.ndarray:
    with torch.no_grad():
        return model.rates(state)[0].numpy()


def added(*effects: str) -> np.ndarray:
    """(3,) m/s^2 that effects add to the nominal model's acceleration in `STATE`."""
    model = nominal_model()
    return (acceleration(true_model(model, parse_effects(effects))) - acceleration(model))[0]


def test_every_own_effect_is_tried_here() -> None:
    assert set(UNDECLARED) - set(EFFECTS) <= set(ONE_OF_EACH)


@pytest.mark.parametrize("text", ONE_OF_EACH.values(), ids=ONE_OF_EACH.keys())
def test_each_effect_changes_the_tracks(text: str, plain: list[SimulatedTrack]) -> None:
    distances = []
    for changed, old in zip(run(text), plain, strict=True):
        n = min(len(changed.track), len(old.track))
        distances.append(np.abs(changed.track.positions[:n] - old.track.positions[:n]).max())
        assert changed.track.labels["topspin"] == old.track.labels["topspin"]
    assert 1e-3 < max(distances) < 1.0  # not every track shows every effect: a ball that slides does not grip


@pytest.mark.parametrize("name", [n for n in ONE_OF_EACH if issubclass(UNDECLARED[n], MeasurementEffect)])
def test_measurement_effects_leave_the_truth_alone(name: str, plain: list[SimulatedTrack]) -> None:
    for changed, old in zip(run(ONE_OF_EACH[name]), plain, strict=True):
        np.testing.assert_array_equal(changed.true_states, old.true_states)


@pytest.mark.parametrize("name", [n for n in UNDECLARED if n not in EFFECTS])
def test_own_effects_do_nothing_at_their_defaults(name: str) -> None:
    effect = UNDECLARED[name]()
    if isinstance(effect, MeasurementEffect):
        with torch.no_grad():  # as in a simulation: where derivatives are wanted, the motion is asked at zero too
            np.testing.assert_array_equal(effect.positions(STATE, lambda s, t: s * np.nan), STATE[:, :3])
    else:
        model = nominal_model()
        changed = true_model(model, [effect])
        np.testing.assert_array_equal(acceleration(changed), acceleration(model))
        np.testing.assert_array_equal(changed.bounce(STATE).detach(), model.bounce(STATE).detach())


def test_wind_moves_the_frame_of_all_air_forces() -> None:
    """In a frame that moves with the air there is no wind."""
    wind = np.array([0.5, -0.3, 0.1])
    moved = STATE.clone()
    moved[:, 3:6] -= torch.from_numpy(wind)
    expected = acceleration(nominal_model(), moved) - acceleration(nominal_model())
    np.testing.assert_allclose(added("wind.x=0.5", "wind.y=-0.3", "wind.z=0.1"), expected[0], atol=1e-12)


def test_gust_is_wind_in_its_middle_and_fades() -> None:
    middle = ["gust_region.center_x=1.2", "gust_region.center_y=0.3", "gust_region.center_z=1.1"]
    np.testing.assert_allclose(added("gust_region.x=0.5", *middle), added("wind.x=0.5"), atol=1e-12)
    assert np.abs(added("gust_region.x=0.5", "gust_region.center_x=9")).max() < 1e-12


def test_formulas_of_the_air_effects() -> None:
    k, magnus = 0.12, nominal_model().flight["magnus"].k.item()  # type: ignore[operator]
    v, w = STATE[0, 3:6].numpy(), STATE[0, 6:].numpy()
    speed, ratio = np.linalg.norm(v), 0.02 * np.linalg.norm(w) / np.linalg.norm(v)
    np.testing.assert_allclose(added("drag_speed.slope=0.02"), -k * 0.02 * (speed - 5) * speed * v, rtol=1e-10)
    np.testing.assert_allclose(added("drag_spin.gain=0.3"), -k * 0.3 * ratio * speed * v, rtol=1e-10)
    lost = magnus * np.cross(w, v) * (1 / (1 + 0.5 * ratio) - 1)
    np.testing.assert_allclose(added("magnus_saturation.strength=0.5"), lost, rtol=1e-10)
    way = np.array([1.4, 0.5, 1.5]) - STATE[0, :3].numpy()
    np.testing.assert_allclose(added("pull.strength=0.3"), 0.3 * way / np.sqrt(way @ way + 0.09), rtol=1e-10)


def test_restitution_falls_with_speed() -> None:
    model = model_from_dict({"flight": {}, "bounce": {"restitution": {"e": 0.9}}})
    falling = STATE.clone()
    falling[:, 5] = -4.0
    after = true_model(model, parse_effects(["restitution_speed.slope=0.02"])).bounce(falling)
    assert after[0, 5].item() == pytest.approx((0.9 - 0.02) * 4.0)


def test_frame_tilt_is_a_rotation_and_scale_a_stretch() -> None:
    (tilt,) = parse_effects(["frame_tilt.x=0.1"])
    (scale,) = parse_effects(["scale.y=0.1"])
    assert isinstance(tilt, MeasurementEffect)
    assert isinstance(scale, MeasurementEffect)
    x, y, z = STATE[0, :3].tolist()
    turned = tilt.positions(STATE, lambda s, t: s)[0].tolist()
    assert turned == pytest.approx([x, np.cos(0.1) * y - np.sin(0.1) * z, np.sin(0.1) * y + np.cos(0.1) * z])
    assert scale.positions(STATE, lambda s, t: s)[0].tolist() == pytest.approx([x, 1.1 * y, z])


def test_time_offset_reads_a_coordinate_later(plain: list[SimulatedTrack]) -> None:
    frame = 0.01
    for changed, old in zip(run(f"time_offset.z={frame}"), plain, strict=True):
        np.testing.assert_allclose(changed.track.positions[:-1, 2], old.track.positions[1:, 2], atol=1e-9)
        np.testing.assert_array_equal(changed.track.positions[:, :2], old.track.positions[:, :2])


def test_a_declared_effect_can_have_another_true_value() -> None:
    model = nominal_model()
    changed = true_model(model, parse_effects(["drag.k=0.15"]))
    assert changed.flight["drag"].k.item() == 0.15  # type: ignore[operator]
    assert model.flight["drag"].k.item() == 0.12  # type: ignore[operator]


class Lift(FlightEffect):
    name = "lift"
    sentence = "An effect of a user's own."
    coefficients = ()

    def acceleration(self, flight: Flight) -> Tensor:
        return torch.ones_like(flight.velocity)


def test_effects_of_ones_own() -> None:
    effects: tuple[Effect, ...] = (Lift(),)
    np.testing.assert_allclose(acceleration(true_model(nominal_model(), effects)), acceleration(nominal_model()) + 1)
    with pytest.raises(ValueError, match="'lift' was given twice"):
        true_model(nominal_model(), (Lift(), Lift()))


def test_an_effect_on_something_absent_is_refused() -> None:
    model = model_from_dict({"flight": {"gravity": {}}, "bounce": {}})
    with pytest.raises(ValueError, match="'drag_spin' changes 'drag', which the model does not declare"):
        true_model(model, parse_effects(["drag_spin.gain=0.2"]))


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["wnd.x=1"], "Did you mean 'wind'"),
        (["zzz.x=1"], "Known ones: wind, "),
        (["wind.v=1"], "no coefficient 'v'. Known ones: x, y, z"),
        (["restitution_speed.slop=1"], "Did you mean 'slope'"),
        (["wind=1"], "NAME.COEFFICIENT=VALUE"),
        (["wind.x"], "NAME.COEFFICIENT=VALUE"),
        (["wind.x=strong"], "must be a number; got 'strong'"),
        (["wind.x=1", "wind.x=2"], "wind.x twice"),
        (["wind.x=300"], r"must lie in \[-20, 20\] m/s"),
    ],
)
def test_bad_effect_texts(texts: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_effects(texts)


@pytest.mark.parametrize("name", ["wind", "gust_region", "drag_speed", "drag_spin", "magnus_saturation", "pull"])
def test_derivatives_of_air_effects_are_finite_without_spin_and_at_rest(name: str) -> None:
    model = true_model(nominal_model(), [UNDECLARED[name]()])
    states = STATE.repeat(3, 1)
    states[0, 6:] = 0.0
    states[1, 3:6] = 0.0
    states[2, 3:] = 0.0
    states.requires_grad_()
    acceleration, _ = model.rates(states)
    inputs = (states, *(p for parameter, p in model.named_parameters() if f".{name}." in parameter))
    first = torch.autograd.grad(acceleration.square().sum(), inputs, create_graph=True)
    second = torch.autograd.grad(sum(g.sum() for g in first), inputs, allow_unused=True)
    assert all(bool(g.isfinite().all()) for g in (*first, *second) if g is not None)


@pytest.mark.parametrize("name", [n for n in UNDECLARED if not issubclass(UNDECLARED[n], MeasurementEffect)])
def test_coefficients_may_differ_from_row_to_row(name: str) -> None:
    coefficients = UNDECLARED[name].coefficients
    model = true_model(nominal_model(), [UNDECLARED[name]()])
    group = "flight" if issubclass(UNDECLARED[name], FlightEffect) else "contact"
    states = STATE * torch.tensor([[1.0], [0.8], [1.1]], dtype=torch.float64) * FALLING
    share = torch.tensor([[0.1], [0.2], [0.4]], dtype=torch.float64)
    for c in coefficients:
        rows = c.default + share * min(c.sigma or 1.0, c.high - c.default)
        together = substitute(model, {f"{group}.{name}.{c.name}": rows})
        for i in range(3):
            alone = substitute(model, {f"{group}.{name}.{c.name}": rows[i, 0]})
            one = states[i : i + 1]
            torch.testing.assert_close(together.rates(states)[0][i], alone.rates(one)[0][0])
            torch.testing.assert_close(together.bounce(states)[i], alone.bounce(one)[0])


FALLING = torch.tensor([1.0, 1, 1, 1, 1, -1, 1, 1, 1], dtype=torch.float64)


def test_time_offset_has_a_derivative_at_zero() -> None:
    effect = UNDECLARED["time_offset"]()
    assert isinstance(effect, MeasurementEffect)
    seen = effect.positions(STATE, lambda states, later: states + later[:, None] * velocities(states))
    (slope,) = torch.autograd.grad(seen[0, 2], [effect.z])
    assert float(slope) == pytest.approx(float(STATE[0, 5]))


def velocities(states: Tensor) -> Tensor:
    return torch.cat((states[:, 3:6], torch.zeros_like(states[:, :6])), dim=-1)
