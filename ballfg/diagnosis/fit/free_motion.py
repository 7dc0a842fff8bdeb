"""Columns of free motion: accelerations in short bins of flight, and kicks of velocity and spin after contacts.

They stand for whatever a model lacks. Their priors are those of a white process noise.
"""

from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.response import ArcResponse, weighted

BIN = 0.04
"""s, approximate duration of a constant acceleration: no bin extends across a contact."""
ACCELERATION = 0.6
"""m/s^2/sqrt(Hz), prior density of a bin's white acceleration: 3 m/s^2 over 40 ms. A steady force then appears damped
by a sixth to a third on arcs of 0.3 s. A wider prior damps less and shows more noise."""
CONTACT_VELOCITY, CONTACT_SPIN = 0.2, 20.0
"""m/s and rad/s, priors of the kicks after a contact, per axis."""


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
