"""Factors in torch: the residuals that estimation sees, their derivatives, and noise that is learned."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from ballfg.dynamics.motion.contact import fly_through
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.factors.batch import FactorBatch, Noise, Values
from ballfg.factors.dynamics import ContactFactors, DynamicsFactors, FlightFactors, RestFactors
from ballfg.factors.launcher import LauncherSpinFactors
from ballfg.factors.loss import Loss
from ballfg.factors.noise import PROCESS_NOISE, Kicks, ProcessNoise, whitening, whitening_tensor
from ballfg.factors.position import PositionFactors
from ballfg.factors.prior import (
    CoefficientPriorFactors,
    PriorFactors,
    coefficient_prior,
    spin_label,
    spin_prior,
    state_prior,
)

NOISE = ProcessNoise(0.3, 4.0, 0.05, 0.2, 10.0, 5.0, 60.0)
OTHER = ProcessNoise(0.4, 3.0, 0.03, 0.3, 14.0, 8.0, 50.0)
STARTS = [
    [0.0, 0.0, 0.03, 5.0, 0.5, -2.0, 10.0, -150.0, 30.0],
    [0.3, 0.1, 0.05, 4.0, -1.0, -3.5, -40.0, 20.0, 60.0],
    [0.3, 0.1, 0.04, 1.0, -0.3, -3.0, -20.0, 40.0, 60.0],
]
SETTINGS, LAUNCHES = np.array([[2.0, 1.0], [3.0, -1.0]]), np.array([[5.0, 6.0, 7.0], [8.0, 9.0, 10.0]])


def covariance(dt: np.ndarray, kicks: Kicks, noise: ProcessNoise) -> np.ndarray:
    """Of the process noise, as graphs are built with it."""
    total = noise.flight(dt)
    for column in kicks.times.T:
        total = total + noise.contact(dt, column)
    return total + kicks.hit[:, None, None] * noise.hit(dt)


def dynamics(kind: str, model, states: np.ndarray, noise: ProcessNoise) -> DynamicsFactors:
    """Three factors of a kind between pairs of states, with the contacts and hits that it may have."""
    first, dt = 2 * np.arange(3), np.array([0.02, 0.021, 0.019])
    kicks = Kicks.none(3)
    if kind == "flight":
        kicks = Kicks(np.zeros((3, 0)), np.array([False, True, False]))
        return FlightFactors(model, first, dt, covariance(dt, kicks, noise), kicks)
    if kind == "rest":
        return RestFactors(model, first, dt, covariance(dt, kicks, noise), np.array([0.0, -0.3, 0.1]), kicks)
    count = 2 if kind == "two contacts" else 1
    dt = dt * (10 if count == 2 else 1)
    times = np.array([[0.3, 0.7], [0.4, 0.8], [0.5, 0.6]])[:, :count] * dt[:, None]
    kicks = Kicks(times, np.array([False, False, True]))
    return ContactFactors(model, first, dt, covariance(dt, kicks, noise), np.zeros((3, count)), kicks)


@pytest.fixture(params=["plain", "augmented"])
def case(request, model, augmented, coefficients):
    """A model and the coefficients that it takes from the values."""
    return (model, np.zeros(0)) if request.param == "plain" else (augmented, coefficients)


def near(kind: str, model, coefficients: np.ndarray) -> Values:
    """Six states: each pair a start and something near where it leads."""
    start = torch.tensor(STARTS, dtype=torch.float64)
    if kind == "two contacts":
        start[:, 5] = torch.tensor([-0.5, -0.6, -0.55])
    if kind == "rest":
        start[:, 2], start[:, 5] = torch.tensor([0.016, -0.29, 0.12]), 0.01
    whole = model.append(start, torch.from_numpy(coefficients)) if len(coefficients) else start
    dt = torch.tensor([0.02, 0.021, 0.019], dtype=torch.float64) * (10 if kind == "two contacts" else 1)
    with torch.no_grad():
        after = fly_through(model, whole, dt, (0.0,) if kind == "contact" else ())[0][:, :9]
    rng = np.random.default_rng(2)
    moved = after.numpy() + np.repeat((1e-3, 0.05, 5.0), 3) * rng.standard_normal((3, 9))
    return Values(np.stack((start.numpy(), moved), axis=1).reshape(-1, 9), coefficients)


def inputs_of(kind: FactorBatch, values: Values) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(np.array(values.gather(column))) for column in kind.variables.T)


def agreement(kind: FactorBatch, values: Values) -> tuple[float, float]:
    """Differences of torch to `compute`: of residuals, and of Jacobians relative to each row's largest element."""
    rows = kind.linearize(values)
    inputs = inputs_of(kind, values)
    assert (np.linalg.norm(rows.residual, axis=-1) > 0.05).all(), "a zero residual hides errors"
    with torch.no_grad():
        apart = np.abs(kind.residual(inputs).numpy() - rows.residual).max() / np.abs(rows.residual).max()
    worst = 0.0
    for j, given in enumerate(rows.jacobians):
        leaf = inputs[j].clone().requires_grad_(True)
        residual = kind.residual((*inputs[:j], leaf, *inputs[j + 1 :]))
        by_row = [torch.autograd.grad(residual[:, i].sum(), leaf, retain_graph=True)[0] for i in range(kind.dim)]
        expected = torch.stack(by_row, dim=1).numpy()
        scale = np.maximum(np.abs(expected).max(axis=2), 1e-6 * np.abs(expected).max())[..., None]
        worst = max(worst, float((np.abs(given - expected) / scale).max()))
    print(f"{type(kind).__name__}: {apart:.0e} {worst:.0e}")  # shown by -s
    return float(apart), worst


@pytest.mark.parametrize("kind", ["flight", "contact", "two contacts", "rest"])
def test_dynamics(kind, case) -> None:
    """To rounding, but for the saltation in a bounce: `compute` takes the true rate at the contact (test_jacobians)."""
    model, coefficients = case
    apart, worst = agreement(dynamics(kind, model, None, NOISE), near(kind, model, coefficients))
    assert apart < 1e-9
    assert worst < (1e-10 if kind in ("flight", "rest") else 2e-6)


def others(augmented) -> list[tuple[FactorBatch, Values]]:
    rng = np.random.default_rng(0)
    states, about = Values(rng.standard_normal((4, 9)), np.zeros(0)), rng.uniform(1.0, 9.0, (2, 3))
    who = np.array([0, 2])
    embedding = SpinEmbedding(("topspin", "sidespin"), {}, torch.tensor([[5.0, 50.0, 3.0], [2.0, -4.0, 40.0]]))
    coefficients = Values(states.states, rng.uniform(0.1, 0.3, 5))
    return [
        (PositionFactors(who, about + 1.0, about, Loss("huber")), states),
        (state_prior(1, np.ones(9), rng.uniform(0.1, 9.0, 9)), states),
        (spin_prior(who, about, about, Loss("cauchy")), states),
        (spin_label(who, about, about), states),
        (LauncherSpinFactors(who, SETTINGS, embedding, LAUNCHES), states),
        (coefficient_prior(np.full(5, 5.0), np.linspace(0.1, 2.0, 5)), coefficients),
        (CoefficientPriorFactors(augmented, np.linspace(0.1, 2.0, 5)), coefficients),
        (PriorFactors(who, np.zeros((2, 9)), rng.standard_normal((2, 4, 9))), states),
    ]


def test_all_other_kinds(augmented) -> None:
    for kind, values in others(augmented):
        assert max(agreement(kind, values)) < 1e-13


def test_priors_of_coefficients_follow_the_model(augmented) -> None:
    """The mean that estimation sees is the model's value when the factors were built; torch's is the model's own."""
    kind = CoefficientPriorFactors(augmented, np.full(5, 0.1))
    residual = kind.residual((torch.zeros(1, 5, dtype=torch.float64),))
    gradient = torch.autograd.grad(residual.sum(), augmented.parameters(), allow_unused=True)
    assert sorted(float(g) for g in gradient if g is not None) == pytest.approx([-10.0] * 5)
    own = {name: p.detach() for name, p in augmented.model.named_parameters()}
    np.testing.assert_array_equal(kind.mean[0], [own[name] for name in augmented.names])


def test_a_kind_without_a_torch_residual_says_so() -> None:
    class Silent(FactorBatch):
        def compute(self, rows, inputs) -> tuple:
            return (), ()

    kind = Silent(np.zeros((1, 1), dtype=np.int64), 1)
    with pytest.raises(NotImplementedError, match="Silent has no residual in torch"):
        kind.residual(())
    assert kind.noise_scale(Noise(spin=torch.ones(()))) is None
    assert kind.log_spread() == 0.0


# --- noise


def numbers(noise: ProcessNoise) -> Tensor:
    return torch.tensor([getattr(noise, name) for name in PROCESS_NOISE], dtype=torch.float64)


@pytest.mark.parametrize("kind", ["flight", "contact", "two contacts", "rest"])
def test_process_noise_that_is_learned(kind, model) -> None:
    """Rewhitened residuals are those of factors built anew with the other noise; so is the spread."""
    values = near(kind, model, np.zeros(0))
    old, new = dynamics(kind, model, None, NOISE), dynamics(kind, model, None, OTHER)
    residual = old.residual(inputs_of(old, values)).detach()
    change = old.noise_scale(Noise(process=numbers(OTHER)))
    expected = new.residual(inputs_of(new, values)).detach()
    torch.testing.assert_close((change @ residual[..., None])[..., 0], expected, rtol=1e-9, atol=1e-9)
    assert bool((change.triu(1).abs() <= 1e-12 * change.abs().amax()).all())
    grown = -float(change.diagonal(dim1=-2, dim2=-1).log().sum())
    assert new.log_spread() - old.log_spread() == pytest.approx(grown, rel=1e-12)
    same = old.noise_scale(Noise(process=numbers(NOISE)))
    torch.testing.assert_close(same, torch.eye(9, dtype=torch.float64).expand(3, 9, 9), rtol=0, atol=1e-10)
    assert old.noise_scale(Noise(position=torch.ones(()))) is None


def test_other_noise_that_is_learned(augmented) -> None:
    """A common factor, for those kinds whose noise it is."""
    scale, noise = torch.tensor(2.5, dtype=torch.float64), {"PositionFactors": "position"}
    noise |= {"SpinLabelFactors": "spin", "LauncherSpinFactors": "spin"}
    for kind, _ in others(augmented):
        learned = noise.get(type(kind).__name__)
        for name in ("position", "spin"):
            change = kind.noise_scale(Noise(**{name: scale}))
            assert (change is not None) == (learned == name)
            assert change is None or float(change) == pytest.approx(0.4, rel=1e-15)
        assert kind.noise_scale(Noise(process=numbers(NOISE))) is None
    for build, arguments in (
        (PositionFactors, (np.array([0, 2]), LAUNCHES)),
        (spin_label, (np.array([0, 2]), LAUNCHES)),
    ):
        spreads = [build(*arguments, sigma).log_spread() for sigma in (LAUNCHES, 2.5 * LAUNCHES)]
        assert spreads[0] == pytest.approx(np.log(LAUNCHES).sum(), rel=1e-14)
        assert spreads[1] - spreads[0] == pytest.approx(6 * np.log(2.5), rel=1e-12)


@pytest.mark.parametrize("kind", ["flight", "contact", "two contacts", "rest"])
def test_the_spread_is_half_the_log_determinant(kind, model) -> None:
    factors = dynamics(kind, model, None, NOISE)
    whole = covariance(factors.dt, Kicks(factors.kick_times, factors.hit), NOISE)
    scale = np.sqrt(np.diagonal(whole, axis1=1, axis2=2))
    sign, log = np.linalg.slogdet(whole / (scale[:, :, None] * scale[:, None, :]))
    assert (sign == 1.0).all()
    assert factors.log_spread() == pytest.approx(0.5 * log.sum() + np.log(scale).sum(), rel=1e-10)


def test_kicks_add_up_to_the_covariance() -> None:
    """Linear in the squares; contacts a little outside the interval are taken to be at its ends."""
    dt = np.array([0.01, 0.4, 0.02, 0.03])
    times = np.array([[0.004, 0.008], [-0.01, 0.5], [0.0, 0.02], [0.01, 0.01]])
    kicks = Kicks(times, np.array([False, True, False, True]))
    for noise in (NOISE, OTHER):
        summed = np.einsum("q,mqij->mij", np.square(numbers(noise).numpy()), kicks.basis(dt))
        expected = covariance(dt, kicks, noise)
        np.testing.assert_allclose(summed, expected, rtol=1e-12, atol=1e-18)
    rows = np.array([3, 1])
    np.testing.assert_array_equal(kicks[rows].basis(dt[rows]), kicks.basis(dt)[rows])
    np.testing.assert_array_equal(Kicks.none(4).basis(dt)[:, 2:], 0.0)


def test_whitening_in_torch_is_whitening() -> None:
    dt = np.array([0.001, 0.01, 0.3])
    given = NOISE.flight(dt)
    expected = whitening(given)
    found = whitening_tensor(torch.from_numpy(given)).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    unit = found @ given @ found.swapaxes(-1, -2)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(9), unit.shape), atol=1e-12)


@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 1.5), Loss("cauchy", 2.0)], ids=lambda loss: loss.name)
def test_loss_of_a_square(loss) -> None:
    """In torch as in numpy, and smooth at zero, where a norm is not."""
    norm = np.concatenate((np.linspace(0.0, 6.0, 61), [1.5, 2.0]))
    square = torch.from_numpy(norm**2).requires_grad_(True)
    value = loss.of_square(square)
    np.testing.assert_allclose(value.detach().numpy(), loss.value(norm), rtol=1e-14, atol=1e-15)
    (slope,) = torch.autograd.grad(value.sum(), square, create_graph=True)
    np.testing.assert_allclose(2 * slope.detach().numpy(), loss.weight(norm), rtol=1e-12)
    if slope.requires_grad:
        (bend,) = torch.autograd.grad(slope.sum(), square)
        assert bool(bend.isfinite().all())
