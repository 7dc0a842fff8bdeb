"""A test for declared coefficients that change from the first track of a recording to the last.

Another table, another ball or another day: tracks of several sessions in one dataset contradict each other, though none
of them shows a pattern of its own. The columns of the block are those of the declared coefficients, times the number of
the track.
"""

import numpy as np

from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.system import System
from ballfg.diagnosis.remains.patterns import Block
from ballfg.diagnosis.result import Array

DRIFT = "recording"
"""Kind of the block, as in reports."""


def drift_block(fit: Fit, system: System) -> Block | None:
    """One column for each free coefficient: one prior sigma below its value at the first track, one above at the last.

    Args: system: of the fit, linearised at its minimum.
    Returns: None if there is nothing free, or one track only.
    """
    free = fit.problem.free
    number = fit.problem.stretches.track.astype(np.float64)
    if not free or np.ptp(number) == 0.0:
        return None
    order = 2.0 * (number - number.min()) / np.ptp(number) - 1.0
    sigmas = np.array([c.sigma for c in free.values()])
    columns = order[:, None, None] * system.by_common[..., : len(free)] * sigmas
    return Block(DRIFT, quantities=tuple(free), axes=("",), values=np.eye(len(free)), columns=columns)


def describe_drift(fit: Fit, block: Block, strengths: Array) -> str:
    """The coefficient that changes most and its values, in words; strengths: (1, f) of the block's columns."""
    most = int(np.argmax(np.abs(strengths[0])))
    name, coefficient = block.quantities[most], fit.problem.free[block.quantities[most]]
    change = np.array((-1.0, 1.0)) * strengths[0, most] * coefficient.sigma
    first, last = np.clip(fit.unknowns.values[name] + change, coefficient.low, coefficient.high)
    unit = "" if coefficient.unit == "1" else f" {coefficient.unit}"
    return f"recording: {name} changes from {first:.3g} to {last:.3g}{unit} between the first tracks and the last"
