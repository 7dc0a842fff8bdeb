"""Vectors seen in the axes of a tilted plane: the shortest turn that takes the vertical into the plane's normal."""

import torch
from torch import Tensor


def to_plane(vector: Tensor, slope: Tensor) -> Tensor:
    """A vector (..., 3) of the world in the axes of a plane that rises by `slope` (..., 2) along x and y.

    With the normal n and q = n_x v_x + n_y v_y the turn of n into the vertical is (v_t - n_t (q / (1 + n_z) + v_z),
    q + n_z v_z), t for the two horizontal components; turning back has the opposite sign of n_t.
    """
    upright = (1.0 + slope.square().sum(-1, keepdim=True)).rsqrt()
    return _turn(vector, -slope * upright, upright)


def from_plane(vector: Tensor, slope: Tensor) -> Tensor:
    """The vector (..., 3) of the world whose components in the plane's axes are given; undoes `to_plane`."""
    upright = (1.0 + slope.square().sum(-1, keepdim=True)).rsqrt()
    return _turn(vector, slope * upright, upright)


def _turn(vector: Tensor, across: Tensor, upright: Tensor) -> Tensor:
    along, vertical = vector[..., :2], vector[..., 2:]
    part = (across * along).sum(-1, keepdim=True)
    return torch.cat((along - across * (part / (1.0 + upright) + vertical), part + upright * vertical), dim=-1)
