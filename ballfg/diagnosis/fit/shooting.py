"""Integrates motion from a first state through a known sequence of contacts, smoothly in all arguments.

Only the times of the given contacts are solved for, each from a guess: a rollout, which finds them itself, can add or
lose one by a small change.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ballfg.dynamics import BallModel
from ballfg.dynamics.model import take_rows
from ballfg.dynamics.motion.contact import contact_time
from ballfg.dynamics.motion.flight_step import derivative, rk4_step
from ballfg.dynamics.motion.integrate import fly
from ballfg.dynamics.motion.limits import MAX_STEP
from ballfg.dynamics.motion.paths import hermite
from ballfg.state import VELOCITY

LONGEST_STEP, LONGEST_WAY = 0.04, 0.4
"""s and m of one integration step: twice those of a rollout below 20 m/s, the rollout's own above. A flight of a second
then ends within a micrometre of the rollout's, far below the resolution of any camera. Steps become no shorter than a
rollout's, however fast a state that a fit tries."""
LEAST_ARC = 1e-3  # s. Least duration of an arc between two contacts for the choice of its steps


@dataclass(frozen=True)
class Arc:
    """Flight of some rows from one contact to the next."""

    rows: Tensor  # (m,) their numbers
    begun: Tensor  # (m,) s, beginning of each
    step: Tensor  # (m, 1) s
    nodes: Tensor  # (j + 1, m, 9) states
    slopes: Tensor  # (j + 1, m, 9) their derivatives by time

    def states(self, times: Tensor) -> Tensor:
        """(k, m, 9) states at times (k, m) s; beyond the last node by the last polynomial."""
        place = (times - self.begun) / self.step[:, 0]
        index = place.detach().nan_to_num(nan=0.0).floor().clamp(0, len(self.nodes) - 2).long()
        theta = (place - index).unsqueeze(-1)
        where = index.unsqueeze(-1).expand(-1, -1, self.nodes.shape[-1])
        ends = (a.gather(0, where + j) for j in (0, 1) for a in (self.nodes, self.slopes))
        return hermite(theta, self.step, *ends)


@dataclass(frozen=True)
class Trajectories:
    """The motion of r rows: arcs in order of time; (r, c) s of contacts, NaN if there is none or it is not reached."""

    arcs: tuple[Arc, ...]
    contacts: Tensor

    def states(self, times: Tensor) -> Tensor:
        """(k, r, 9) states at times (k, r) s since the start."""
        result = self.arcs[0].states(times)
        for arc in self.arcs[1:]:
            asked = times[:, arc.rows]
            inside = (asked.detach() >= arc.begun.detach()).unsqueeze(-1)
            within = torch.where(inside, arc.states(asked), result[:, arc.rows])
            result = result.index_copy(1, arc.rows, within)
        return result


def shoot(model: BallModel, start: Tensor, heights: Tensor, guesses: Tensor, ends: Tensor) -> Trajectories:
    """The motion of rows of balls.

    Args:
        model: coefficients may have one value per row, shape (r, 1).
        start: (r, 9) at time 0.
        heights: (r, c) m, declared heights of the surfaces in order of contact; NaN after the last.
        guesses: (r, c) s, approximate times of contact.
        ends: (r,) s, durations.
    Returns:
        The motion, differentiable backward and forward in start and coefficients. A row that misses a contact is NaN
        from there on.
    """
    rows, begun, own = torch.arange(len(start)), torch.zeros_like(start[:, 0]), model
    arcs: list[Arc] = []
    contacts = torch.full_like(heights, torch.nan)
    last = torch.full_like(ends, torch.nan).unsqueeze(-1)  # no arc ends with a contact after the last one
    for height, guess in zip(*(torch.cat((a, last), dim=1).T for a in (heights, guesses)), strict=True):
        meets = ~height[rows].isnan()
        until = torch.where(meets, guess[rows], ends[rows])
        arc = _fly_arc(own, rows, start, begun, until - begun.detach())
        arcs.append(arc)
        if not bool(meets.any()):
            break
        own, count = take_rows(own, meets, len(rows)), len(arc.nodes) - 1
        rows, near = rows[meets], arc.nodes[-1][meets]
        tau = contact_time(own, near, height[rows])
        lost = tau.isnan()
        start = own.after_bounce(fly(own, near, tau.masked_fill(lost, 0.0)))
        start = torch.where(lost.unsqueeze(-1), torch.nan, start)
        begun = begun[meets] + count * arc.step[meets, 0] + tau.masked_fill(lost, 0.0)
        contacts[rows, len(arcs) - 1] = begun.detach().masked_fill(lost, torch.nan)
    return Trajectories(tuple(arcs), contacts)


def steps_of_arc(state: Tensor, duration: Tensor) -> tuple[int, Tensor]:
    """Number of equal steps for arcs of durations (m,) s from states (m, 9), and their lengths (m,) s.

    Rows that missed a contact have no duration and do not count.
    """
    duration = duration.clamp_min(LEAST_ARC)
    fastest = float(state[:, VELOCITY].detach().square().sum(-1).nan_to_num(nan=0.0).max().sqrt())
    longest = min(LONGEST_STEP, max(MAX_STEP, LONGEST_WAY / max(fastest, 1.0)))
    count = max(1, math.ceil(float(duration.nan_to_num(nan=LEAST_ARC).max()) / longest))
    return count, duration / count


def _fly_arc(model: BallModel, rows: Tensor, state: Tensor, begun: Tensor, duration: Tensor) -> Arc:
    count, lengths = steps_of_arc(state, duration)
    step = lengths.unsqueeze(-1)
    nodes, slopes = [state], [derivative(model.rates, state)]
    for _ in range(count):
        state = rk4_step(model.rates, state, step, slopes[-1])
        nodes.append(state)
        slopes.append(derivative(model.rates, state))
    return Arc(rows, begun, step, torch.stack(nodes), torch.stack(slopes))
