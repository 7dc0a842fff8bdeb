"""Computes the response of the samples to accelerations in flight and to kicks right after contacts.

Free ones in short bins of flight and after each contact stand for whatever a model lacks, under the priors of a white
process noise.

To first order, an acceleration a(s) along the fitted motion moves the position measured at time t by P(t) times the
integral over s < t of F(s)^-1 (0, a(s), 0), by variation of constants. F and P are the derivatives of the state and of
the measured position by the state with which an arc of free flight begins. One pass of nine directions for each arc
thus serves every pattern of forces. The columns of P for velocity and spin are the responses to kicks after the
contact.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.autograd.forward_ad as forward
from torch import Tensor

from ballfg.arrays import Array, Index
from ballfg.diagnosis.fit.sensitivity import coefficients_of, with_values
from ballfg.diagnosis.fit.shooting import LEAST_ARC, Arc, Trajectories, shoot
from ballfg.diagnosis.fit.tangents import RepeatedMotion, make_dual, shoot_compiled
from ballfg.dynamics import BallModel
from ballfg.dynamics.compiled.functions import compiled
from ballfg.state import STATE_DIM, VELOCITY

if TYPE_CHECKING:
    from ballfg.diagnosis.fit.problem import Fit

NODE = 0.01  # s. Spacing of the points at which forces act; a pattern of 1 m/s^2 is then right to 13 micrometres
MOST_STRETCHES = 100  # Largest number of stretches in one pass; each takes about a megabyte


@dataclass(frozen=True)
class FittedPath:
    """The fitted motion of n stretches; times (k, n) s and states (n, k, 9) at their samples, from the first on."""

    motion: Trajectories
    times: Tensor
    states: Array


@dataclass(frozen=True)
class ArcResponse:
    """Responses of m stretches to forces and kicks in one of their arcs, with q nodes and k samples."""

    rows: Index  # (m,) numbers of the stretches
    number: int  # Of the arc: 0 is before the first contact, j follows contact j - 1
    begun: Array  # (m,) s since the first sample
    step: Array  # (m,) s between nodes
    incoming: Array  # (m, 9) state before the arc's first contact; the first state itself for arc 0
    nodes: Array  # (m, q, 9) states
    times: Array  # (m, q) s of the nodes since the first sample
    inverse: Array  # (m, q, 9, 3) of the derivative of a node's state by the arc's first state, columns of the velocity
    positions: Array  # (m, k, 3, 9) m, derivative of the measured positions by the arc's first state; zero before it
    passed: Index  # (m, k) number of nodes before each sample

    def response_to(self, acceleration: Array) -> Array:
        """(m, k, 3, p) m by which accelerations (m, q, 3, p) m/s^2 at the nodes move the measured positions."""
        pulled = self.step[:, None, None, None] * (self.inverse @ acceleration)
        gathered = np.concatenate((np.zeros_like(pulled[:, :1]), pulled.cumsum(axis=1)), axis=1)
        return np.asarray(self.positions @ gathered[np.arange(len(self.rows))[:, None], self.passed])

    @property
    def kicks(self) -> Array:
        """(m, k, 3, 6) responses to a unit of velocity (m/s), then of spin (rad/s), at the beginning of the arc."""
        return self.positions[..., VELOCITY.start :]


def fitted_path(fit: "Fit") -> FittedPath:
    """The motion at a fit's minimum."""
    stretches = fit.problem.stretches
    with torch.no_grad():
        model = with_values(fit.model, fit.values, len(stretches))
        times = model.true_stamps(stretches.times.T.unsqueeze(-1)).squeeze(-1)
        starts = torch.from_numpy(fit.unknowns.starts)
        motion = shoot(model, starts, stretches.heights, stretches.contacts, times[-1])
        states = motion.states(times).transpose(0, 1).numpy()
    return FittedPath(motion, times, states)


def responses(fit: "Fit") -> Iterator[ArcResponse]:
    """The responses of all arcs, in order of time."""
    for number, arc in enumerate(fit.path.motion.arcs):
        for part in torch.split(torch.arange(len(arc.rows)), MOST_STRETCHES):
            yield _arc_response(fit, number, part)


def weighted(fit: "Fit", positions: Array, rows: Index) -> Array:
    """(m, 3 k + 3, p) rows as in the fit's system, from derivatives (m, k, 3, p) of positions; zero for labels."""
    moved = fit.position_rows(positions, rows)
    return np.concatenate((moved, np.zeros((len(rows), 3, positions.shape[-1]))), axis=1)


def _arc_response(fit: "Fit", number: int, part: Tensor) -> ArcResponse:
    path, arc = fit.path, fit.path.motion.arcs[number]
    rows, begun = arc.rows[part], arc.begun[part]
    contacts, until = path.motion.contacts[rows, number:], path.times[-1, rows]
    if contacts.shape[1]:
        until = torch.where(contacts[:, 0].isnan(), until, contacts[:, 0])
    duration = (until - begun).clamp_min(LEAST_ARC).numpy()
    count = max(1, int(np.ceil(duration.max() / NODE)))
    step = duration / count
    nodes = torch.from_numpy((np.arange(count)[:, None] + 0.5) * step)  # (q, m) s since the arc began
    states, by_first, positions = _shot(fit, number, part, nodes)
    since = path.times[:, rows].T.numpy() - begun.numpy()[:, None]
    return ArcResponse(
        rows=rows.numpy(),
        number=number,
        begun=begun.numpy(),
        step=step,
        incoming=_at(path.motion.arcs[number - 1], rows, begun) if number else arc.nodes[0][part].numpy(),
        nodes=states,
        times=(begun + nodes).T.numpy(),
        inverse=np.asarray(np.linalg.inv(by_first)[..., VELOCITY], dtype=np.float64),
        positions=positions,
        passed=np.clip(np.ceil(since / step[:, None] - 0.5), 0, count).astype(np.int64),
    )


def _at(arc: Arc, rows: Tensor, times: Tensor) -> Array:
    """(m, 9) states of some rows of an arc at times (m,) s."""
    where = torch.searchsorted(arc.rows, rows)
    asked = arc.begun.clone()
    asked[where] = times
    return np.asarray(arc.states(asked.unsqueeze(0))[0, where].numpy())


def _shot(fit: "Fit", number: int, part: Tensor, nodes: Tensor) -> tuple[Array, Array, Array]:
    """States (m, q, 9) at nodes, and derivatives by an arc's first state: theirs, and (m, k, 3, 9) of positions."""
    model, stretches, path, arc = fit.model, fit.problem.stretches, fit.path, fit.path.motion.arcs[number]
    rows, begun, start = arc.rows[part], arc.begun[part], arc.nodes[0][part]
    values = {name: value if isinstance(value, float) else value[rows.numpy()] for name, value in fit.values.items()}
    times, heights = path.times[:, rows] - begun, stretches.heights[rows, number:]
    guesses = path.motion.contacts[rows, number:] - begun.unsqueeze(-1)
    functions = compiled(model) if model.measures_plainly else None
    if functions is None:
        tiled = {n: value if isinstance(value, float) else np.tile(value, STATE_DIM) for n, value in values.items()}
        repeated = with_values(model, tiled, len(rows) * STATE_DIM)  # component by component of the state
        return _dual_shot(repeated, start, heights, guesses, times, nodes)
    unit = np.tile(np.eye(STATE_DIM), (len(rows), 1, 1))
    known = coefficients_of(model, len(rows), values)
    shot = shoot_compiled(functions, known, start.numpy(), unit, heights, guesses, times[-1])
    reached, by_first = RepeatedMotion(shot.arcs, len(rows), STATE_DIM, 3).states(nodes)
    positions = RepeatedMotion(shot.arcs, len(rows), STATE_DIM, 1).states(times.clamp_min(0.0))[1]
    positions *= (times >= 0.0).T[..., None, None]
    return reached.numpy(), by_first.numpy(), positions.numpy()


def _dual_shot(
    model: BallModel, start: Tensor, heights: Tensor, guesses: Tensor, times: Tensor, nodes: Tensor
) -> tuple[Array, Array, Array]:
    """The same in dual numbers, for every model."""
    m, times = len(start), times.repeat(1, STATE_DIM)
    with forward.dual_level():
        directions = torch.eye(STATE_DIM, dtype=torch.float64).repeat_interleave(m, dim=0)
        first = make_dual(start.repeat(STATE_DIM, 1), directions)
        motion = shoot(model, first, heights.repeat(STATE_DIM, 1), guesses.repeat(STATE_DIM, 1), times[-1])

        def at(asked: Tensor) -> Tensor:
            moved = motion.states(asked.clamp_min(0.0))
            return torch.where((asked >= 0.0).unsqueeze(-1), moved, forward.unpack_dual(moved).primal)

        def later(delay: Tensor) -> Tensor:
            return at(times + (delay.squeeze(-1) if delay.dim() else delay))

        measured = forward.unpack_dual(model.measured(at(times), later)).tangent
        reached = forward.unpack_dual(motion.states(nodes.repeat(1, STATE_DIM)))
    by_first = reached.tangent.reshape(-1, STATE_DIM, m, STATE_DIM).permute(2, 0, 3, 1)
    positions = measured.reshape(-1, STATE_DIM, m, 3).permute(2, 0, 3, 1)
    return reached.primal[:, :m].transpose(0, 1).numpy(), by_first.numpy(), positions.numpy()


BIN = 0.04  # s, approximate duration of a constant acceleration: no bin extends across a contact
ACCELERATION = 0.6
"""m/s^2/sqrt(Hz), prior density of a bin's white acceleration: 3 m/s^2 over 40 ms. A steady force then appears damped
by a sixth to a third on arcs of 0.3 s. A wider prior damps less and shows more noise."""
CONTACT_VELOCITY, CONTACT_SPIN = 0.2, 20.0  # m/s and rad/s, priors of the kicks after a contact, per axis


@dataclass(frozen=True)
class Piece:
    """Free kicks of one arc of one stretch: three columns for each of b bins, then six for a contact before the arc."""

    columns: Array  # (m, d) whitened responses
    sigma: Array  # (d,) priors
    times: Array  # (b,) s
    states: Array  # (b, 9)
    contact: tuple[int, float, Array] | None
    """None for a first arc; else number of the contact, its time, the state before it."""


def free_motion(fit: "Fit", arc: ArcResponse) -> list[Piece]:
    """One piece for each stretch of an arc."""
    m, q = arc.times.shape
    counts = np.maximum(1, np.rint(arc.step * q / BIN).astype(np.int64))
    number = (np.arange(q) * counts[:, None]) // q
    width = int(counts.max())
    indicator = (number[..., None] == np.arange(width)).astype(np.float64)
    acceleration = np.einsum("mqb,ac->mqabc", indicator, np.eye(3)).reshape(m, q, 3, 3 * width)
    columns = weighted(fit, arc.response_to(acceleration), arc.rows)
    kicks = weighted(fit, arc.kicks, arc.rows)
    pieces = []
    for i, count in enumerate(counts.tolist()):
        first = np.searchsorted(number[i], np.arange(count + 1))
        middle = (first[:-1] + first[1:] - 1) // 2
        length = arc.step[i] * q / count
        times = arc.begun[i] + (np.arange(count) + 0.5) * length
        own, sigma = columns[i, :, : 3 * count], np.full(3 * count, ACCELERATION / np.sqrt(length))
        contact = None
        if arc.number:
            own = np.concatenate((own, kicks[i]), axis=1)
            sigma = np.concatenate((sigma, np.repeat((CONTACT_VELOCITY, CONTACT_SPIN), 3)))
            contact = (arc.number - 1, float(arc.begun[i]), arc.incoming[i])
        pieces.append(Piece(own, sigma, times, arc.nodes[i, middle], contact))
    return pieces
