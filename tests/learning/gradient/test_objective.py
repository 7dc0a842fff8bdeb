"""The objective of a batch in torch: the value that estimation minimises, track by track, and its gradient there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.factors.batch import Noise, Values
from ballfg.factors.graph import BallGraph
from ballfg.factors.noise import PROCESS_NOISE
from ballfg.learning.end_to_end.learnables import NoiseScales
from ballfg.learning.gradient.objective import BatchObjective, Layout, rewhitened
from tests.learning.estimates import (
    NOISE,
    SETTINGS,
    Estimates,
    factors_of,
    launcher,
    measured,
    objective_of,
    usual_ball,
)

COEFFICIENTS = {"flight.drag.k": 0.03, "bounce.restitution.e": 0.02}


@pytest.fixture(scope="module", params=["states", "coefficients"])
def estimates(request) -> Estimates:
    coefficients = COEFFICIENTS if request.param == "coefficients" else {}
    settings = replace(SETTINGS, launcher=launcher(), coefficients=coefficients)
    return Estimates(usual_ball(), measured(usual_ball()), settings, NoiseScales(NOISE, learned=True))


def off(values: Values, seed: int) -> Values:
    rng = np.random.default_rng(seed)
    scale = np.repeat((1e-3, 0.02, 3.0), 3)
    return Values(
        values.states + scale * rng.standard_normal(values.states.shape),
        values.coefficients * (1.0 + 0.1 * rng.standard_normal(values.coefficients.shape)),
    )


def test_value_is_the_graph_s(estimates) -> None:
    found = estimates.solve()
    points = [off(s.minimum.values, k) for k, s in enumerate(found)]
    objective = objective_of(found)
    value = objective(objective.layout.pack(points), Noise())
    expected = [s.graph.error(v) for s, v in zip(found, points, strict=True)]
    np.testing.assert_allclose(value.detach().numpy(), expected, rtol=1e-10)
    same = objective(objective.layout.pack(points), estimates.noise.noise())
    np.testing.assert_allclose(same.detach().numpy(), expected, rtol=1e-9)


def test_the_gradient_vanishes_at_the_minimum(estimates) -> None:
    """Its length in posterior standard deviations; what is left, 1e-8 to 1e-6, is the Jacobian of a bounce."""
    found = estimates.solve()
    objective, factors = objective_of(found), factors_of(found)
    point = objective.layout.pack([s.minimum.values for s in found]).requires_grad_(True)
    gradient = objective.gradient(point, Noise()).detach()
    assert float((gradient * factors.solve(gradient)).sum().sqrt()) < 1e-5
    away = objective.layout.pack([off(s.minimum.values, k) for k, s in enumerate(found)]).requires_grad_(True)
    gradient = objective.gradient(away, Noise()).detach()
    assert float((gradient * factors.solve(gradient)).sum().sqrt()) > 1.0


def test_one_track_s_values_are_no_one_else_s(estimates) -> None:
    found = estimates.solve()
    objective = objective_of(found)
    point = objective.layout.pack([s.minimum.values for s in found]).requires_grad_(True)
    owners = objective.layout.owners()
    for k, value in enumerate(objective(point, Noise())):
        (by_point,) = torch.autograd.grad(value, point, retain_graph=True)
        assert bool((by_point[owners != k] == 0.0).all())
        assert bool((by_point[owners == k] != 0.0).any())


def test_changed_noise_is_that_of_graphs_built_with_it(estimates) -> None:
    found = estimates.solve()
    values = [off(s.minimum.values, k) for k, s in enumerate(found)]
    objective = objective_of(found)
    with torch.no_grad():
        estimates.noise.process += torch.tensor([0.1, -0.2, 0.3, -0.1, 0.2])
        process = estimates.noise.noise().process
        value = objective(
            objective.layout.pack(values),
            Noise(process, torch.tensor(1.3, dtype=torch.float64), torch.tensor(0.8, dtype=torch.float64)),
        )
        estimates.noise.position.fill_(np.log(1.3))
        estimates.noise.spin.fill_(np.log(0.8))
    anew = [s.graph.error(v) for s, v in zip(estimates.solve(), values, strict=True)]
    with torch.no_grad():
        for leaf in estimates.noise.parameters():
            leaf.zero_()
    np.testing.assert_allclose(value.detach().numpy(), anew, rtol=1e-9)


def test_layout_packs_and_unpacks() -> None:
    rng = np.random.default_rng(0)
    values = [Values(rng.standard_normal((n, 9)), rng.standard_normal(2)) for n in (3, 1, 4)]
    layout = Layout((3, 1, 4), 2)
    assert (layout.states, layout.starts) == (8, (0, 3, 4))
    point = layout.pack(values)
    states, coefficients = layout.unpack(point)
    for k, (start, one) in enumerate(zip(layout.starts, values, strict=True)):
        np.testing.assert_array_equal(states[start : start + len(one.states)], one.states)
        np.testing.assert_array_equal(coefficients[k], one.coefficients)
    biased = [replace(v, biases=rng.standard_normal((len(v.states), 3))) for v in values]
    layout = Layout((3, 1, 4), 2, 12)
    whole, coefficients = layout.unpack(layout.pack(biased))
    np.testing.assert_array_equal(whole[3:4], np.concatenate((biased[1].states, biased[1].biases), axis=1))
    np.testing.assert_array_equal(coefficients[2], biased[2].coefficients)
    assert layout.owners().bincount().tolist() == [38, 14, 50]
    layout = Layout((3, 1, 4), 2)
    numbered = [Values(np.full((n, 9), float(k)), np.full(2, float(k))) for k, n in enumerate((3, 1, 4))]
    np.testing.assert_array_equal(layout.owners(), layout.pack(numbered))


def test_tracks_with_and_without_memory_do_not_mix() -> None:
    plain = Values(np.zeros((2, 9)), np.zeros(0))
    with pytest.raises(ValueError, match="tracks of a batch must all have measured positions where errors last"):
        BatchObjective([BallGraph(())] * 2, [plain, replace(plain, biases=np.zeros((2, 3)))])


def test_rewhitening_forms() -> None:
    residual = torch.arange(6.0, dtype=torch.float64).view(2, 3)
    assert rewhitened(residual, None) is residual
    torch.testing.assert_close(rewhitened(residual, torch.tensor(2.0, dtype=torch.float64)), 2.0 * residual)
    matrices = torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = torch.stack([m @ r for m, r in zip(matrices, residual, strict=True)])
    torch.testing.assert_close(rewhitened(residual, matrices), expected)


def test_noise_scales_are_what_the_factors_take() -> None:
    """A number that is zero at the start stays zero; a hit's noise stays as it is."""
    scales = NoiseScales(replace(NOISE, contact_tangential=0.0), learned=True)
    assert scales.names == ("acceleration", "spin", "contact_velocity", "contact_spin")
    with torch.no_grad():
        scales.process += torch.tensor([0.1, 0.2, 0.3, 100.0])
        scales.position.fill_(-100.0)
    scales.bound()
    noise, settings = scales.noise(), scales.settings(SETTINGS)
    expected = [getattr(settings.process, name) for name in PROCESS_NOISE]
    np.testing.assert_allclose(noise.process.detach().numpy(), expected, rtol=1e-14)
    assert settings.process.contact_spin == pytest.approx(8.0 * np.exp(12.0))
    assert settings.position_noise == SETTINGS.position_noise
    assert settings.position_scale == pytest.approx(np.exp(-12.0))
    assert settings.process.hit_spin == NOISE.hit_spin
    assert float(noise.position.detach()) == float(noise.spin.detach()) == 1.0
    assert NoiseScales(NOISE, learned=False).noise() == Noise()
