"""Effects that nobody declares: their names, what a true model is, and that they change the tracks as they should."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from ballfg.dynamics import EFFECTS, AnalyticModel, Flight, FlightEffect, nominal_model
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.model import substitute
from ballfg.dynamics.model_file import model_from_dict
from ballfg.simulation import MeasurementNoise, SimulationConfig, parse_effects, simulate, table_tennis
from ballfg.simulation.balls import with_model
from ballfg.simulation.motion import true_model
from ballfg.simulation.synthetic import SimulatedTrack
from ballfg.simulation.undeclared import UNDECLARED
from ballfg.tracks.track import SPIN_LABELS

STATE = torch.tensor([[1.2, 0.3, 1.1, 5.0, -1.0, 2.0, 40.0, -150.0, 60.0]], dtype=torch.float64)
MOTION = {
    "gravity": "gravity.g=9.7",
    "drag": "drag.k=0.14",
    "magnus": "magnus.k=0.0032",
    "spin_decay": "spin_decay.rate=0.3",
    "wind": "wind.x=0.3",
    "wind_shear": "wind_shear.y=1",
    "gust_region": "gust_region.y=0.5",
    "drag_speed": "drag_speed.slope=0.02",
    "drag_spin": "drag_spin.gain=0.3",
    "magnus_saturation": "magnus_saturation.strength=0.5",
    "buoyancy": "buoyancy.a=0.15",
    "restitution": "restitution.e=0.9",
    "friction": "friction.mu=0.3",
    "tangential_restitution": "tangential_restitution.e_t=0.4",
    "table_height": "table_height.offset=0.005",
    "restitution_speed": "restitution_speed.slope=0.02",
    "table_tilt": "table_tilt.y=0.01",
    "pull": "pull.strength=0.3",
    "thick_air": "thick_air.growth=0.3",
    "side_lean": "side_lean.strength=0.1",
}
POSITIONS = {
    "time_offset": "time_offset.z=0.004",
    "velocity_lag": "velocity_lag.lag=0.003",
    "frame_tilt": "frame_tilt.x=0.01",
    "scale": "scale.z=0.01",
    "radial_bias": "radial_bias.offset=0.005",
    "distortion": "distortion.k=0.005",
}
STAMPS_AND_LABELS = {
    "time_scale": "time_scale.s=0.01",
    "counted_frames": "counted_frames.missing=0.25",
    "spin_label_scale": "spin_label_scale.s=0.1",
    "spin_label_offset": "spin_label_offset.x=10",
    "spin_label_frame": "spin_label_frame.yy=-1",
}
OWN = ("pull", "thick_air", "side_lean")


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


def spins(simulated: SimulatedTrack) -> np.ndarray:
    return np.array([simulated.track.labels[name] for name in SPIN_LABELS])


def test_every_effect_is_tried_here() -> None:
    assert set(UNDECLARED) == {*MOTION, *POSITIONS, *STAMPS_AND_LABELS} == {*EFFECTS, *OWN}


@pytest.mark.parametrize("name", [*MOTION, *POSITIONS])
def test_each_effect_changes_the_tracks(name: str, plain: list[SimulatedTrack]) -> None:
    distances = []
    for changed, old in zip(run((MOTION | POSITIONS)[name]), plain, strict=True):
        n = min(len(changed.track), len(old.track))
        distances.append(np.abs(changed.track.positions[:n] - old.track.positions[:n]).max())
        assert changed.track.labels["topspin"] == old.track.labels["topspin"]
    assert 1e-3 < max(distances) < 1.0  # not every track shows every effect: a ball that slides does not grip


@pytest.mark.parametrize("name", [*POSITIONS, *STAMPS_AND_LABELS])
def test_measurement_effects_leave_the_truth_alone(name: str, plain: list[SimulatedTrack]) -> None:
    for changed, old in zip(run((POSITIONS | STAMPS_AND_LABELS)[name]), plain, strict=True):
        np.testing.assert_array_equal(changed.true_states, old.true_states)
        np.testing.assert_array_equal(changed.true_times, old.true_times)


def test_stamps_and_labels_are_written_as_the_effects_say(plain: list[SimulatedTrack]) -> None:
    texts = (*(t for n, t in STAMPS_AND_LABELS.items() if n != "counted_frames"), "spin_label_frame.xx=2")
    (scale,) = parse_effects([STAMPS_AND_LABELS["time_scale"]])
    model = true_model(nominal_model(), [scale])
    for changed, old in zip(run(*texts), plain, strict=True):
        np.testing.assert_array_equal(changed.track.positions, old.track.positions)
        np.testing.assert_allclose(changed.track.times, 1.01 * old.track.times, rtol=1e-15)
        back = model.true_stamps(torch.from_numpy(changed.track.times)).detach()
        np.testing.assert_allclose(back, changed.true_times, rtol=0, atol=1e-12)
        np.testing.assert_allclose(spins(changed), 1.1 * np.array([2, -1, 1]) * spins(old) + [10, 0, 0], rtol=1e-13)


def test_label_noise_and_jitter_come_on_top() -> None:
    effects = parse_effects([STAMPS_AND_LABELS["time_scale"], STAMPS_AND_LABELS["spin_label_scale"]])
    noise = MeasurementNoise(jitter=0.0005)
    pair = [list(simulate(SimulationConfig(tracks=3, noise=noise, undeclared=u))) for u in ((), effects)]
    for old, changed in zip(*pair, strict=True):
        jitter = old.track.times - old.true_times
        np.testing.assert_allclose(changed.track.times, 1.01 * changed.true_times + jitter, rtol=0, atol=1e-15)
        noise_of_label = spins(old) - old.true_states[0, 6:]
        expected = 1.1 * changed.true_states[0, 6:] + noise_of_label
        np.testing.assert_allclose(spins(changed), expected, rtol=0, atol=1e-12)


def test_a_declared_measurement_effect_acts_too(plain: list[SimulatedTrack]) -> None:
    content = {"flight": {"gravity": {}}, "bounce": {}, "measurement": {"scale": {"z": 0.01}}}
    ball = with_model(table_tennis(), model_from_dict(content))
    noise = MeasurementNoise(position=0.0)
    for simulated in simulate(SimulationConfig(tracks=2, noise=noise, ball=ball)):
        expected = simulated.true_states[:, :3] * [1, 1, 1.01]
        np.testing.assert_allclose(simulated.track.positions, expected, rtol=1e-15)


@pytest.mark.parametrize("name", OWN)
def test_own_effects_do_nothing_at_their_defaults(name: str) -> None:
    model = nominal_model()
    changed = true_model(model, [UNDECLARED[name]()])
    np.testing.assert_array_equal(acceleration(changed), acceleration(model))
    np.testing.assert_array_equal(changed.after_bounce(STATE).detach(), model.after_bounce(STATE).detach())


def test_formulas_of_own_effects() -> None:
    position, v = STATE[0, :3].numpy(), STATE[0, 3:6].numpy()
    way = np.array([1.4, 0.5, 1.5]) - position
    np.testing.assert_allclose(added("pull.strength=0.3"), 0.3 * way / np.sqrt(way @ way + 0.09), rtol=1e-10)
    drag = -0.12 * np.linalg.norm(v) * v
    beyond = 1.2 - 0.2
    soft = (beyond + np.sqrt(beyond**2 + 0.01)) / 2
    np.testing.assert_allclose(added("thick_air.growth=0.3", "thick_air.start_x=0.2"), 0.3 * soft * drag, rtol=1e-10)
    assert np.abs(added("thick_air.growth=0.3", "thick_air.start_x=9")).max() < 1e-3 * np.abs(drag).max()
    across = np.cross([0, 0, 1], v) / np.sqrt(v @ v + 0.01)
    np.testing.assert_allclose(added("side_lean.strength=0.3"), 0.3 * v[2] * across, rtol=1e-10)


def test_thick_air_and_side_lean_have_derivatives_at_rest() -> None:
    for name in OWN:
        model = true_model(nominal_model(), [UNDECLARED[name]()])
        states = (STATE * torch.tensor([[0.0], [1.0]], dtype=torch.float64)).requires_grad_()
        inputs = (states, *(p for n, p in model.named_parameters() if f".{name}." in n))
        first = torch.autograd.grad(model.rates(states)[0].square().sum(), inputs, create_graph=True)
        second = torch.autograd.grad(sum(g.sum() for g in first), inputs, allow_unused=True)
        assert all(bool(g.isfinite().all()) for g in (*first, *second) if g is not None)


@pytest.mark.parametrize("name", OWN)
def test_coefficients_of_own_effects_may_differ_from_row_to_row(name: str) -> None:
    model = true_model(nominal_model(), [UNDECLARED[name]()])
    states = STATE * torch.tensor([[1.0], [0.8], [1.1]], dtype=torch.float64)
    share = torch.tensor([[0.1], [0.2], [0.4]], dtype=torch.float64)
    rows = {f"flight.{name}.{c.name}": c.default + share * c.sigma for c in UNDECLARED[name].coefficients}
    together = substitute(model, rows).rates(states)[0]
    for i in range(3):
        alone = substitute(model, {n: value[i, 0] for n, value in rows.items()})
        torch.testing.assert_close(together[i], alone.rates(states[i : i + 1])[0][0])


def test_time_offset_reads_a_coordinate_later(plain: list[SimulatedTrack]) -> None:
    frame = 0.01
    for changed, old in zip(run(f"time_offset.z={frame}"), plain, strict=True):
        np.testing.assert_allclose(changed.track.positions[:-1, 2], old.track.positions[1:, 2], atol=1e-9)
        np.testing.assert_allclose(changed.track.positions[:, :2], old.track.positions[:, :2], rtol=0, atol=1e-15)


def test_a_declared_effect_can_have_another_true_value() -> None:
    model = nominal_model()
    changed = true_model(model, parse_effects(["drag.k=0.15"]))
    assert changed.flight["drag"].k.item() == 0.15  # type: ignore[operator]
    assert model.flight["drag"].k.item() == 0.12  # type: ignore[operator]
    assert list(changed.flight) == list(model.flight)


class Lift(FlightEffect):
    name = "lift"
    sentence = "An effect of a user's own."
    decide = "Nothing."
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
    with pytest.raises(ValueError, match=r"got 'drag_spin' without 'drag'\. Add drag to the model"):
        true_model(model, parse_effects(["drag_spin.gain=0.2"]))


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["wnd.x=1"], "Did you mean 'wind'"),
        (["zzz.x=1"], "Known ones: gravity, drag, "),
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
