"""Dual numbers of torch's forward mode, without torch's remark on itself."""

from __future__ import annotations

import warnings

import torch.autograd.forward_ad as forward
from torch import Tensor


def make_dual(primal: Tensor, tangent: Tensor) -> Tensor:
    """A tensor with a tangent, within `forward.dual_level()`.

    The first one makes torch 2.13 compile rules of its own with `torch.jit.script`, which warns that it is deprecated:
    nothing that a caller could mend, and an error where warnings are errors.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", DeprecationWarning)
        return forward.make_dual(primal, tangent)
