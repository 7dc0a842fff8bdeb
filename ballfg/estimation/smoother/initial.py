"""Guesses all states from the samples and the events, as a start of the minimisation."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.contact import fly_through
from ballfg.estimation.filters.window_velocity import window_velocities
from ballfg.estimation.launcher import SpinLabel
from ballfg.estimation.segmentation.result import Contact, Quality, Segmentation
from ballfg.factors.batch import Values
from ballfg.factors.dynamics import model_width
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY, VZ, Z
from ballfg.tracks import Track


def initial_states(
    track: Track,
    contacts: tuple[Contact, ...],
    segmentation: Segmentation,
    model: BallModel,
    label: SpinLabel | None,
) -> Array:
    """(n, 9) states from the sliding window: measured positions, mean velocities of windows without events.

    The spin is the label's, or zero, up to the first contact; each contact changes it by the model. A resting ball is
    put on its surface and rolls.
    """
    states = np.zeros((len(track), STATE_DIM))
    states[:, POSITION] = bridged_positions(track, segmentation)
    breaks = np.unique([c.interval for c in contacts] + segmentation.hits.tolist() + segmentation.restarts.tolist())
    states[:, VELOCITY] = window_velocities(track.times, states[:, POSITION], breaks.astype(np.int64))
    if label is not None:
        states[:, SPIN] = label.spin
    for contact in sorted(contacts, key=lambda c: c.time):
        _start_contact(states, contact, model)
    for rest in segmentation.rests:
        _start_rest(states[rest.first : rest.last + 2], rest.height, model)
    return states


def bridged_positions(track: Track, segmentation: Segmentation) -> Array:
    """(n, 3) m: measured positions, with lines between neighbours in place of outliers and shifted runs."""
    trusted = segmentation.quality <= Quality.WIDE
    if trusted.all() or not trusted.any():
        return track.positions.copy()
    columns = [np.interp(track.times, track.times[trusted], axis[trusted]) for axis in track.positions.T]
    return np.stack(columns, axis=-1)


def _start_contact(states: Array, contact: Contact, model: BallModel) -> None:
    """Moves the state before a contact to where it can reach the contact, and gives later states the spin after it."""
    before = torch.from_numpy(states[contact.interval].copy())
    with torch.no_grad():
        gap = float(model.gap(before, contact.height))
        if gap < 0.0:
            states[contact.interval, Z] -= gap
        states[contact.interval, VZ] = before[VZ] = min(float(before[VZ]), -LEAST_FALL)
        states[contact.interval + 1 :, SPIN] = model.after_bounce(before)[SPIN].numpy()


def _start_rest(states: Array, height: float, model: BallModel) -> None:
    """Puts states on a surface, rolling: saturated friction does not determine the direction of the spin."""
    states[:, Z] -= model.gap(torch.from_numpy(states), height).detach().numpy()
    states[:, VZ] = 0.0
    states[:, SPIN.start] = -states[:, VELOCITY.start + 1] / model.radius
    states[:, SPIN.start + 1] = states[:, VELOCITY.start] / model.radius


LEAST_FALL = 0.05
"""m/s, least downward speed of a guess before a contact."""


def move_contacts(
    values: Values, times: Array, old: Sequence[tuple[int, float]], new: Sequence[tuple[int, float]], model: BallModel
) -> Values:
    """Values for a continued search after contacts moved: a state after its contact is now before it, or vice versa.

    Args:
        values: the states for the old contacts.
        times: (n,) s.
        old: interval and height of each contact so far.  new: the same of the next contacts.
        model: gives the state at the end of the first interval that gained or lost a contact, from that at its start.
    """
    states = values.states.copy()
    changed = sorted({i for i, _ in set(old) ^ set(new)})
    for interval in changed:
        if interval - 1 in changed:
            continue  # the contact entered or left this interval; the state after both is right already
        heights = tuple(height for i, height in new if i == interval)
        start = torch.from_numpy(np.concatenate((states[interval], values.coefficients[: model_width(model)]))[None])
        gap = float(model.gap(start, heights[0])[0].detach()) if heights else 0.0
        if gap < 0.0 < states[interval, VZ]:  # it was on the way up, from below: before the contact it mirrors that
            states[interval, [Z, VZ]] -= (2.0 * gap, 2.0 * states[interval, VZ])
            start[0, :STATE_DIM] = torch.from_numpy(states[interval])
        with torch.no_grad():
            after, _ = fly_through(model, start, torch.from_numpy(np.diff(times[interval : interval + 2])), heights)
        if bool(after.isfinite().all()):
            states[interval + 1] = after[0, :STATE_DIM].numpy()
    return replace(values, states=states)
