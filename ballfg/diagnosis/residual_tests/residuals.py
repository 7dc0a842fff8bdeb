"""Computes the residuals of a fit: accelerations in flight, kicks at contacts, errors of measured positions.

The first two are estimated together with the first state of their stretch, under the priors of a white process noise.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ballfg.diagnosis.fit.patterns import since_contact
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.response import Piece, free_motion
from ballfg.diagnosis.result import ContactResiduals, FlightResiduals, MeasurementResiduals, Residuals
from ballfg.state import STATE_DIM

_Row = tuple[Any, ...]  # A row of residuals: the number of the stretch, then the fields of its kind


def residuals_of(fit: Fit) -> Residuals:
    """The residuals of a fit.

    Args: fit: at its minimum.
    Returns: accelerations in flight, kicks at contacts and errors of positions, with their covariances.
    """
    system = fit.linearised
    pieces: dict[int, list[Piece]] = defaultdict(list)
    for arc in fit.arcs:
        for row, piece in zip(arc.rows.tolist(), free_motion(fit, arc), strict=True):
            pieces[row].append(piece)
    flights: list[_Row] = []
    contacts: list[_Row] = []
    for row, own in pieces.items():
        # all kicks of the stretch together, with a free first state
        columns = np.concatenate([system.by_start[row], *(piece.columns for piece in own)], axis=1)
        sigma = np.concatenate([piece.sigma for piece in own])
        precision = columns.T @ columns + np.diag(np.concatenate((np.zeros(STATE_DIM), sigma**-2)))
        covariance = np.linalg.inv(precision)
        value = (covariance @ (columns.T @ system.residual[row]))[STATE_DIM:]
        covariance, end = covariance[STATE_DIM:, STATE_DIM:], 0
        for piece in own:
            for time, state in zip(piece.times, piece.states, strict=True):
                part = slice(end, end := end + 3)
                flights.append((row, time, state, value[part], covariance[part, part]))
            if piece.contact is not None:
                part = slice(end, end := end + 6)
                contacts.append((row, *piece.contact, value[part], covariance[part, part]))
    flight = FlightResiduals(*(np.array(column) for column in zip(*flights, strict=True)))
    used, times = fit.problem.stretches.used.numpy(), fit.path.times.T.numpy()
    measurement = MeasurementResiduals(
        stretch=np.nonzero(used)[0],
        times=times[used],
        states=fit.path.states[used],
        since_contact=since_contact(times, fit.path.motion.contacts.numpy())[used],
        position=(fit.problem.stretches.positions.numpy() - fit.predicted.positions)[used],
        sigma=fit.sigmas[used],
    )
    return Residuals(fit.problem.stretches.names, flight, _contact(contacts), measurement)


def _contact(found: list[_Row]) -> ContactResiduals:
    shapes: tuple[tuple[int, ...], ...] = ((), (), (), (STATE_DIM,), (6,), (6, 6))
    columns: Iterable[Sequence[Any]] = zip(*found, strict=True) if found else [()] * len(shapes)
    stretch, number, times, incoming, kick, covariance = (
        np.array(column, dtype=kind).reshape(len(found), *shape)
        for column, shape, kind in zip(columns, shapes, ("i8", "i8", "f8", "f8", "f8", "f8"), strict=True)
    )
    return ContactResiduals(stretch, number, times, incoming, kick[:, :3], kick[:, 3:], covariance)
