"""The spin embedding: settings become a spin along the flight."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from ballfg.dynamics.networks.spin_embedding import SOFT_SPEED, SpinEmbedding


def local_spins(*rows):
    return torch.tensor(rows, dtype=torch.float64)


@pytest.fixture
def levels():
    """Topspin about the across axis, sidespin about the vertical, as an analytic launcher has it."""
    return SpinEmbedding(("topspin", "sidespin"), {}, local_spins((0.0, 40.0, 0.0), (0.0, 0.0, -25.0)))


def test_axes_are_those_of_the_launcher(levels):
    velocity = np.array([3.0, -4.0, 1.5])
    settings = levels.settings({"topspin": 2.0, "sidespin": -3.0, "group": "a"})
    spin = levels.spin(settings, torch.from_numpy(velocity)).detach().numpy()
    across = np.array([4.0, 3.0, 0.0]) / 5.0  # z x forward
    expected = 2.0 * 40.0 * across + np.array([0.0, 0.0, 75.0])
    softness = (SOFT_SPEED / 5.0) ** 2
    np.testing.assert_allclose(spin, expected, rtol=softness, atol=1e-12)
    forward = SpinEmbedding(("x",), {}, local_spins((1.0, 0.0, 0.0))).spin(
        torch.ones(1).double(), torch.tensor(velocity)
    )
    np.testing.assert_allclose(forward.detach(), (0.6, -0.8, 0.0), rtol=softness)


def test_settings_of_numbers_and_text():
    embedding = SpinEmbedding(("group", "topspin"), {"group": ("flat", "back")}, None)
    assert embedding.names == ("group=flat", "group=back", "topspin")
    assert embedding.settings({"group": "back", "topspin": 3}).tolist() == [0.0, 1.0, 3.0]
    assert embedding.weight.shape == (3, 3)
    assert bool((embedding.weight == 0).all())


def test_what_is_not_known_has_no_settings():
    embedding = SpinEmbedding(("group", "topspin"), {"group": ("flat", "back")})
    assert embedding.settings({"topspin": 1.0}) is None
    assert embedding.settings({"group": "flat"}) is None
    assert embedding.settings({"group": "side", "topspin": 1.0}) is None


def test_turning_the_velocity_turns_the_spin(levels):
    angle = 0.7
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]], dtype=torch.float64
    )
    rng = torch.Generator().manual_seed(0)
    settings, velocity = (torch.randn(9, k, generator=rng, dtype=torch.float64) for k in (2, 3))
    there = levels.spin(settings, velocity @ turn.T)
    assert torch.allclose(there, levels.spin(settings, velocity) @ turn.T, rtol=0, atol=1e-12)


def test_a_mirrored_launch_has_the_other_sidespin(levels):
    mirror = torch.tensor((1.0, -1.0, 1.0), dtype=torch.float64)
    velocity = torch.tensor((3.0, 1.0, 0.4), dtype=torch.float64)
    spin = levels.spin(local_spins(2.0, 3.0), velocity)
    other = levels.spin(local_spins(2.0, -3.0), velocity * mirror)
    assert torch.allclose(other, -mirror * spin, rtol=1e-13, atol=0)  # a pseudovector


def test_smooth_without_a_direction(levels):
    settings, velocity = local_spins(2.0, 3.0), torch.zeros(3, dtype=torch.float64, requires_grad=True)
    spin = levels.spin(settings, velocity)
    assert spin.tolist() == [0.0, 0.0, -75.0]
    (gradient,) = torch.autograd.grad(spin.sum(), velocity)
    assert bool(gradient.isfinite().all())


def test_derivatives(levels):
    rng = torch.Generator().manual_seed(0)
    settings, velocity = (torch.randn(4, k, generator=rng, dtype=torch.float64) for k in (2, 3))
    velocity.requires_grad_(True)

    def spin(velocity, weight):
        return torch.func.functional_call(_Spin(levels), {"embedding.weight": weight}, (settings, velocity))

    weight = levels.weight.detach().clone().requires_grad_(True)
    assert torch.autograd.gradcheck(spin, (velocity, weight))
    assert torch.autograd.gradgradcheck(spin, (velocity, weight))


class _Spin(torch.nn.Module):
    def __init__(self, embedding):
        super().__init__()
        self.embedding = embedding

    def forward(self, settings, velocity):
        return self.embedding.spin(settings, velocity)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((), {}), r"labels must be names that differ, at least one; got \(\)\. Name each label once\.$"),
        ((("a", "a"), {}), r"labels must be names that differ"),
        ((("a",), {"b": ("x",)}), r"categories must be of labels; got 'b'\. Add it to labels or remove it\.$"),
        ((("a",), {"a": ()}), r"categories\['a'\] must be values that differ, at least one; got \(\)\.$"),
        ((("a",), {"a": ("x", "x")}), r"categories\['a'\] must be values that differ"),
        ((("a",), {}, torch.zeros(2, 3)), r"initial must have shape \(1, 3\); got \(2, 3\)\.$"),
    ],
)
def test_what_is_wrong_is_said(arguments, message):
    with pytest.raises(ValueError, match=message):
        SpinEmbedding(*arguments)


def test_a_number_must_be_one(levels):
    with pytest.raises(ValueError, match=r"label 'topspin' must be a number; got 'high'\. Declare its values as"):
        levels.settings({"topspin": "high", "sidespin": 1.0})
