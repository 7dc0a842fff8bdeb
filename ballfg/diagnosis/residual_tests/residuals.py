"""Computes the residuals of a fit: accelerations in flight, kicks at contacts, errors of measured positions.

The first two are like a smoother's: free accelerations in short bins and free kicks after contacts, all estimated
together with the first state of their stretch, under the priors of a white process noise.
"""

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.response import ArcResponse, FittedPath, fitted_path, responses, weighted
from ballfg.diagnosis.result import ContactResiduals, FlightResiduals, MeasurementResiduals, Residuals
from ballfg.state import STATE_DIM

BIN = 0.04
"""s, approximate duration of a constant acceleration: no bin extends across a contact."""
ACCELERATION = 0.6
"""m/s^2/sqrt(Hz), prior density of a bin's white acceleration: 3 m/s^2 over 40 ms. A steady force then appears damped
by a sixth to a third on arcs of 0.3 s. A wider prior damps less and shows more noise."""
CONTACT_VELOCITY, CONTACT_SPIN = 0.2, 20.0
"""m/s and rad/s, priors of the kicks after a contact, per axis."""

_Row = tuple[Any, ...]
"""A row of residuals: the number of the stretch, then the fields of its kind."""


@dataclass(frozen=True)
class Piece:
    """Free kicks of one arc of one stretch: three columns for each of b bins, then six for a contact before the arc.

    Attributes:
        columns: (m, d) whitened responses.
        sigma: (d,) priors.
        times: (b,) s.
        states: (b, 9).
        contact: None for a first arc; else number of the contact, its time, the state before it.
    """

    columns: Array
    sigma: Array
    times: Array
    states: Array
    contact: tuple[int, float, Array] | None


def residuals_of(fit: Fit) -> Residuals:
    """The residuals of a fit.

    Args: fit: at its minimum.
    Returns: accelerations in flight, kicks at contacts and errors of positions, with their covariances.
    """
    path, system = fitted_path(fit), fit.linearised()
    pieces: dict[int, list[Piece]] = defaultdict(list)
    for arc in responses(fit, path):
        for row, piece in zip(arc.rows.tolist(), free_motion(fit, arc), strict=True):
            pieces[row].append(piece)
    flights: list[_Row] = []
    contacts: list[_Row] = []
    for row, own in pieces.items():
        value, covariance = _posterior(system.residual[row], system.by_start[row], own)
        end = 0
        for piece in own:
            for time, state in zip(piece.times, piece.states, strict=True):
                part = slice(end, end := end + 3)
                flights.append((row, time, state, value[part], covariance[part, part]))
            if piece.contact is not None:
                part = slice(end, end := end + 6)
                contacts.append((row, *piece.contact, value[part], covariance[part, part]))
    flight = FlightResiduals(*(np.array(column) for column in zip(*flights, strict=True)))
    return Residuals(fit.problem.stretches.names, flight, _contact(contacts), _measurement(fit, path))


def free_motion(fit: Fit, arc: ArcResponse) -> list[Piece]:
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


def _posterior(residual: Array, by_start: Array, pieces: list[Piece]) -> tuple[Array, Array]:
    """Posterior mean (d,) and covariance (d, d) of all kicks of a stretch, with a free first state."""
    columns = np.concatenate([by_start, *(piece.columns for piece in pieces)], axis=1)
    sigma = np.concatenate([piece.sigma for piece in pieces])
    precision = columns.T @ columns + np.diag(np.concatenate((np.zeros(STATE_DIM), sigma**-2)))
    covariance = np.linalg.inv(precision)
    return (covariance @ (columns.T @ residual))[STATE_DIM:], covariance[STATE_DIM:, STATE_DIM:]


def _contact(found: list[_Row]) -> ContactResiduals:
    if not found:
        none = np.zeros(0, dtype=np.int64)
        empty = np.zeros((0, 3))
        return ContactResiduals(none, none, np.zeros(0), np.zeros((0, STATE_DIM)), empty, empty, np.zeros((0, 6, 6)))
    stretch, number, times, incoming, kick, covariance = (np.array(c) for c in zip(*found, strict=True))
    return ContactResiduals(stretch, number, times, incoming, kick[:, :3], kick[:, 3:], covariance)


def _measurement(fit: Fit, path: FittedPath) -> MeasurementResiduals:
    used, times = fit.problem.stretches.used.numpy(), path.times.T.numpy()
    return MeasurementResiduals(
        stretch=np.nonzero(used)[0],
        times=times[used],
        states=path.states[used],
        since_contact=since_contact(times, path.motion.contacts.numpy())[used],
        position=(fit.problem.stretches.positions.numpy() - fit.predicted.positions)[used],
        sigma=fit.sigmas[used],
    )


def since_contact(times: Array, contacts: Array) -> Array:
    """(n, k) s since the last contact (n, c) before times (n, k), NaN before the first one."""
    after = times[..., None] - contacts[:, None, :]
    after = np.where(after >= 0.0, after, np.inf)
    least = after.min(axis=-1, initial=np.inf)
    return np.where(np.isfinite(least), least, np.nan)
