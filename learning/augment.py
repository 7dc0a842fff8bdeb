"""Augments a shot by a rotation about the vertical and a horizontal shift."""

import math

import numpy as np
import torch
from torch import Tensor

SHIFT = 1.0  # m, largest shift along x and along y: the size of a table, so that no place in the room is special


def augmentation(seed: int, epoch: int, track: int) -> tuple[Tensor, Tensor]:
    """The rotation and shift of one track in one epoch, independent of batch and process. Height is never shifted.

    Returns: (angle, shift): () rad, uniform in [-pi, pi); (2,) m along x and y, uniform in [-SHIFT, SHIFT). float64.
    """
    draw = np.random.default_rng([seed, epoch, track]).uniform(-1.0, 1.0, 3)
    return torch.tensor(math.pi * draw[0], dtype=torch.float64), torch.from_numpy(SHIFT * draw[1:])


def apply(positions: Tensor, angle: Tensor, shift: Tensor) -> Tensor:
    """Positions (..., 3) m, rotated about the world's z axis by `angle` (...) rad, then shifted by `shift` (..., 2) m.

    Leading dimensions are broadcast: angles (b, 1) and shifts (b, 1, 2) for (b, n, 3) positions of b tracks.
    """
    return rotate(positions, angle) + _horizontal(shift)


def undo(positions: Tensor, angle: Tensor, shift: Tensor) -> Tensor:
    """The inverse of `apply`."""
    return rotate(positions - _horizontal(shift), -angle)


def rotate(vectors: Tensor, angle: Tensor) -> Tensor:
    """Vectors (..., 3) - velocity, spin, acceleration - rotated about the vertical; a shift does not change them."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y, z = vectors.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z], dim=-1)


def _horizontal(shift: Tensor) -> Tensor:
    """(..., 3) from (..., 2)."""
    return torch.cat([shift, torch.zeros_like(shift[..., :1])], dim=-1)
