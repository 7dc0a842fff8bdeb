"""Accounts for balls near the edge of a table: one bounces, its neighbour within the uncertainty falls past.

The mean takes one of the two ways. The covariance gets the second moment, about the mean, of the share that takes the
other (docs/derivations/prediction.md).
"""

from dataclasses import replace

import torch
from torch import Tensor

from ballfg.dynamics.compiled.beliefs.edges import share_over_table
from ballfg.dynamics.compiled.motion import world_of
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.contact import contact_time
from ballfg.dynamics.motion.integrate import fly
from ballfg.dynamics.motion.limits import NEGLIGIBLE
from ballfg.dynamics.motion.rollout import advance
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import STATE_DIM, VZ


@torch.no_grad()
def edge_doubt(model: BallModel, mean: Tensor, covariance: Tensor, h: Tensor, surfaces: Surfaces) -> Tensor | float:
    """Covariance at the end of a step from the balls that take the other way than the mean.

    Args:
        model: of the ball.  mean: (1, d) state at the start of the step.  covariance: (1, d, d) of it.
        h: (1,) s, the step; at most one contact with the table.  surfaces: table and floor.
    Returns: (9, 9); 0 if the ball does not come down to the table's level in the step, or far from every edge.
    """
    height = mean.new_tensor([surfaces.table_height])
    beside = fly(model, mean, h)
    if surfaces.extent is None or not float(model.gap(mean, height)) >= 0.0 > float(model.gap(beside, height)):
        return 0.0
    touch = fly(model, mean, contact_time(model, mean, height))
    if not float(touch[0, VZ]) < 0.0:
        return 0.0
    over = share_over_table(touch[0].numpy(), covariance[0].numpy(), world_of(surfaces, model.radius))
    other = 1.0 - over if bool(surfaces.over_table(touch)) else over
    if other < NEGLIGIBLE:
        return 0.0
    difference = (advance(model, mean, h, replace(surfaces, extent=None)) - beside)[0, :STATE_DIM]
    return other * torch.outer(difference, difference)
