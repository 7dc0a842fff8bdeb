"""Dual numbers with written zeros: the same derivatives as torch's own, and closed forms."""

from __future__ import annotations

import pytest
import torch
import torch.autograd.forward_ad as forward

from ballfg.diagnosis.fit.dual import ARITHMETIC, dual_level, make_dual

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # torch's own


def vectors(seed):
    return torch.randn(5, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


PLAIN, WIDE, COUNTS = vectors(1), vectors(2)[:1].expand(5, 3), torch.arange(3)
USES = {
    "plus": lambda x: x + PLAIN,
    "number minus": lambda x: 1.5 - x,
    "minus expanded": lambda x: x - WIDE,
    "times integers": lambda x: x * COUNTS,
    "number over": lambda x: 2.0 / x,
    "over": lambda x: PLAIN / x,
    "addcmul": lambda x: torch.addcmul(PLAIN, x, WIDE),
    "add with a factor": lambda x: torch.add(PLAIN, x, alpha=0.5),
    "minimum": lambda x: torch.minimum(x, PLAIN),
    "cross product": lambda x: torch.linalg.cross(x, PLAIN),
    "power": lambda x: x**2,
    "by a condition": lambda x: torch.where(PLAIN > 0, x, PLAIN) * x,
}


@pytest.mark.parametrize("use", USES.values(), ids=USES.keys())
def test_derivatives_are_torchs_own(use):
    primal, tangent = vectors(3), vectors(4)
    with forward.dual_level():
        wanted = forward.unpack_dual(use(make_dual(primal, tangent)))
        primal_wanted, tangent_wanted = wanted.primal.clone(), wanted.tangent.clone()
    with dual_level():
        found = forward.unpack_dual(use(make_dual(primal, tangent)))
        torch.testing.assert_close(found.primal, primal_wanted, rtol=0, atol=0)
        torch.testing.assert_close(found.tangent, tangent_wanted, rtol=1e-15, atol=0)


def test_a_product_follows_the_product_rule():
    x, dx = vectors(5), vectors(6)
    with dual_level():
        found = forward.unpack_dual(PLAIN * make_dual(x, dx) * make_dual(x, dx))
        torch.testing.assert_close(found.tangent, 2.0 * PLAIN * x * dx)


def test_plain_numbers_stay_plain():
    with dual_level():
        assert forward.unpack_dual(PLAIN + 1.0).tangent is None
        assert forward.unpack_dual(torch.addcmul(PLAIN, PLAIN, WIDE)).tangent is None
    assert torch.Tensor.add in ARITHMETIC
