"""The learned correction of drag and lift: its functions, its limits, its derivative, and its place in files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ballfg.dynamics import AnalyticModel, load_model, nominal_model, save_model
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.compiled import functions
from ballfg.dynamics.compiled.functions import _rates, _traced
from ballfg.dynamics.effects import generic, registry
from ballfg.dynamics.effects.flight import Drag, Gravity, Magnus
from ballfg.dynamics.effects.generic import DOUBT, DOUBTS, FUNCTIONS, WEIGHTS, AirCorrection, correction_terms
from ballfg.dynamics.motion.integrate import fly, fly_jacobian
from ballfg.state import STANDARD_GRAVITY

LOW, HIGH = -4.0, 4.0


def column(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float64))[..., None]


def random_correction(seed: int = 3) -> AirCorrection:
    rng = np.random.default_rng(seed)
    numbers = {f"{name}_{k}": 0.1 * rng.normal() for name in WEIGHTS for k in range(1, len(FUNCTIONS) + 1)}
    doubts = {f"{prefix}_{k}": rng.normal() for prefix in DOUBT.values() for k in range(1, DOUBTS + 1)}
    return AirCorrection(**{name: 0.3 * rng.normal() for name in WEIGHTS}, **numbers, **doubts)


def model_with(effect: AirCorrection | None) -> AnalyticModel:
    return AnalyticModel([Gravity(), Drag(), Magnus(), *([] if effect is None else [effect])])


def states(count: int = 20) -> torch.Tensor:
    made = np.random.default_rng(5).normal(size=(count, 9)) * np.repeat((0.5, 4.0, 120.0), 3)
    return torch.from_numpy(made)


def test_the_prior_is_as_wide_everywhere() -> None:
    rng = np.random.default_rng(1)
    terms = correction_terms(column(rng.uniform(LOW, HIGH, 500)), column(rng.uniform(LOW, HIGH, 500)))
    np.testing.assert_allclose(terms.square().sum(-1).numpy(), 1.0, rtol=1e-10)


def test_near_the_data_the_covariance_is_the_kernel() -> None:
    """Within one length of the centre, where the terms of fourth and higher degree are small."""
    rng = np.random.default_rng(2)
    places = rng.uniform(-0.5, 0.5, (40, 2))
    terms = correction_terms(column(places[:, 0]), column(places[:, 1])).numpy()
    kernel = np.exp(-0.5 * ((places[:, None] - places[None]) ** 2).sum(-1))
    np.testing.assert_allclose(terms @ terms.T, kernel, atol=0.03)


def test_far_from_the_data_only_the_width_is_left() -> None:
    terms = correction_terms(column(np.array([8.0])), column(np.array([0.0]))).numpy()[0]
    assert np.abs(terms[:-1]).max() < 1e-10
    assert terms[-1] == pytest.approx(1.0)


def test_a_correction_of_zero_is_no_correction() -> None:
    for found, right in zip(model_with(AirCorrection()).rates(states()), model_with(None).rates(states()), strict=True):
        assert (found is None) == (right is None)
        if found is not None and right is not None:
            torch.testing.assert_close(found, right, rtol=0.0, atol=0.0)


def test_the_gains_are_those_of_the_formula() -> None:
    """By hand for one state: weights plus doubts times their directions, times functions, times what others gave."""
    effect, state = random_correction(), states(1)
    values = effect.values()
    found = model_with(effect).rates(state)[0].detach().numpy()[0]
    velocity, spin = state[0, 3:6].numpy(), state[0, 6:].numpy()
    speed, ratio = np.linalg.norm(velocity), 0.02 * np.hypot(np.linalg.norm(spin), generic.SOFT_SPIN)
    share = ratio / (speed + ratio)  # S / (1 + S)
    x, y = (speed - values["speed"]) / values["speed_scale"], (share - values["ratio"]) / values["ratio_scale"]
    squares = x * x / 2**0.5, x * y, y * y / 2**0.5
    cubes = x**3 / 6**0.5, x * x * y / 2**0.5, x * y * y / 2**0.5, y**3 / 6**0.5
    inner = np.exp(-(x * x + y * y) / 2) * np.array([1.0, x, y, *squares, *cubes])
    terms = np.append(inner, (1 - inner @ inner) ** 0.5)
    gains = []
    for force in ("drag", "lift"):
        weights = [
            values[name] + sum(values[f"{name}_{k}"] * values[f"{DOUBT[force]}_{k}"] for k in range(1, DOUBTS + 1))
            for name in WEIGHTS
            if name.startswith(force)
        ]
        gains.append(1.0 + terms @ weights)
    right = (
        -0.12 * gains[0] * speed * velocity
        + 0.0028 * gains[1] * np.cross(spin, velocity)
        - [0.0, 0.0, STANDARD_GRAVITY]
    )
    np.testing.assert_allclose(found, right, rtol=1e-9, atol=1e-9)


def test_its_derivative_is_that_of_differences() -> None:
    model, state, step = model_with(random_correction()), states(), 1e-5
    exact = torch.autograd.functional.jacobian(lambda x: model.rates(x)[0].sum(0), state).transpose(0, 1)
    for k in range(9):
        moved = torch.zeros(9, dtype=torch.float64)
        moved[k] = step
        slope = (model.rates(state + moved)[0] - model.rates(state - moved)[0]).detach() / (2 * step)
        torch.testing.assert_close(exact[..., k], slope, rtol=1e-6, atol=1e-6)


def test_it_is_finite_at_rest() -> None:
    state = torch.zeros(1, 9, dtype=torch.float64)
    model = model_with(random_correction())
    jacobian = torch.autograd.functional.jacobian(lambda x: model.rates(x)[0].sum(0), state)
    assert torch.isfinite(jacobian).all()
    torch.testing.assert_close(model.rates(state)[0][0, :2].detach(), torch.zeros(2, dtype=torch.float64))


def test_a_model_file_keeps_it(tmp_path: Path) -> None:
    effect = random_correction()
    save_model(model_with(effect), tmp_path / "model.yaml")
    found = load_model(tmp_path / "model.yaml")
    assert isinstance(found, AnalyticModel)
    kept = found.flight["air_correction"]
    assert isinstance(kept, AirCorrection)
    assert kept.values() == effect.values()
    assert {name for name, c in found.declared_coefficients().items() if "doubt" in name and c.varies} == {
        f"flight.air_correction.{prefix}_{k}" for prefix in DOUBT.values() for k in range(1, DOUBTS + 1)
    }


def test_an_estimate_carries_only_doubts_that_move_something() -> None:
    drag = [f"drag_{term}_{k}" for term in FUNCTIONS for k in range(1, DOUBTS)]
    model = model_with(AirCorrection(**dict.fromkeys(drag, 0.1)))
    assert set(coefficient_sigmas(model)) == {"flight.drag.k", *(f"flight.air_correction.doubt_{k}" for k in (1, 2, 3))}


def test_machine_code_has_derivatives_by_the_doubts_and_by_no_known_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the names that the source takes: no code is made of it."""
    monkeypatch.setattr(functions, "built", lambda source: source)
    model, section = model_with(random_correction()), "flight.air_correction"
    names = set(_traced(model, _rates).names)
    doubts = {f"{section}.{prefix}_{k}" for prefix in DOUBT.values() for k in range(1, DOUBTS + 1)}
    assert {name for name in names if name.startswith(section)} == doubts
    learned = model_with(random_correction())
    learned.flight["air_correction"].set_sigmas(**dict.fromkeys(WEIGHTS, 0.1))
    assert {f"{section}.{name}" for name in WEIGHTS} | doubts <= set(_traced(learned, _rates).names)


@pytest.mark.parametrize("name", ["doubt_2", "lift_vs", "drag_one_1"])
def test_derivatives_by_any_of_its_numbers_are_central_differences(name: str) -> None:
    """By doubts in machine code, by numbers that it takes as known in torch."""
    model = AugmentedModel(model_with(random_correction()), (f"flight.air_correction.{name}",))
    start = torch.cat((states(6), model.means().detach().expand(6, 1)), dim=1)
    dt, step = torch.full((6,), 0.02, dtype=torch.float64), 1e-5
    _, jacobian = fly_jacobian(model, start, dt)
    moved = torch.zeros(10, dtype=torch.float64)
    moved[9] = step
    slope = (fly(model, start + moved, dt) - fly(model, start - moved, dt))[:, :9] / (2.0 * step)
    assert slope.abs().max() > 1e-5
    torch.testing.assert_close(jacobian[:, :9, 9], slope.detach(), rtol=1e-6, atol=1e-8)


def test_other_weights_move_the_machine_code() -> None:
    model, dt = model_with(random_correction()), torch.full((6,), 0.02, dtype=torch.float64)
    before = fly(model, states(6), dt)
    with torch.no_grad():
        dict(model.named_parameters())["flight.air_correction.drag_one_1"].add_(0.3)
    after = fly(model, states(6), dt)
    assert (after - before).abs().max() > 1e-4
    torch.testing.assert_close(after, fly(model_like(model), states(6), dt), rtol=0.0, atol=1e-12)


def model_like(model: AnalyticModel) -> AnalyticModel:
    """Another model with the same numbers."""
    effect = model.flight["air_correction"]
    assert isinstance(effect, AirCorrection)
    return model_with(AirCorrection(**effect.values()))


def test_a_diagnosis_does_not_look_for_it() -> None:
    assert "air_correction" not in registry.EFFECTS
    assert not any("air_correction" in name for name in nominal_model().declared_coefficients())
