"""Applies the events of a stream to the window's samples: it changes motions and moves contacts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ballfg.estimation.filters.window_velocity import window_velocities
from ballfg.estimation.online.events import SIGMA_FACTOR, EventTracker, contact_step, first_difference
from ballfg.estimation.online.sample import Sample
from ballfg.estimation.online.windows.stream_window import StreamWindow
from ballfg.estimation.smoother.motion import FLIGHT, Motion, motions_of

LATEST_CHANGE = 80
"""Samples. The segmenter's events are final after 64; older states are never rebuilt."""
YOUNG = 20
"""Number of samples after a contact in which the estimate may still move it to another interval."""


def explain(window: StreamWindow, samples: list[Sample], events: EventTracker) -> list[Sample]:
    """Applies the events to the samples; samples from the first difference on are retracted and returned.

    Args: window: holds the first of the samples.  samples: the wanted content.  events: found in them.
    """
    held = len(window)
    times, positions = np.array([s.time for s in samples]), np.array([s.position for s in samples])
    segmentation = events.segmentation(window.first, times, positions)
    motions = motions_of(events.with_moved_contacts(segmentation, window.first), times)
    measured = np.array([s.measured for s in samples])
    factors = np.where(measured, SIGMA_FACTOR[segmentation.quality], 1.0)  # the loss sets wrong sightings aside
    settled = max(held - LATEST_CHANGE, 0)
    motions[: max(settled - 1, 0)] = [s.motion for s in samples[1:settled]]
    factors[:settled] = [s.factor for s in samples[:settled]]
    start = first_difference(samples[:held], motions, factors)
    reweighed = [k for k in range(held) if samples[k].factor != factors[k]]
    for k, sample in enumerate(samples):
        sample.factor = float(factors[k])
        if k and (k >= held or not sample.motion.same(motions[k - 1])):
            sample.motion = motions[k - 1]
    again = [] if start is None else samples[max(start, 1) : held]
    if again:
        window.retract(max(start or 0, 1))
    staying = [k for k in reweighed if k < len(window)]
    if staying:
        window.reweigh(staying)
    return again


def move_contacts(window: StreamWindow, samples: Sequence[Sample], events: EventTracker) -> Sequence[Sample]:
    """Moves young contacts to their estimated places; the newest one may not have happened yet.

    Args: as for `explain`.
    Returns: the retracted samples, to be appended again.
    """
    n = len(window)
    for k in range(max(n - YOUNG, 1), n):
        motion = samples[k].motion
        if len(motion.heights) != 1 or motion.hit:
            continue
        (height,) = motion.heights
        state = window.theta[k - 1] + window.delta[k - 1]
        step = contact_step(state, events.rise(height), samples[k].time - samples[k - 1].time)
        other = k + step
        if step == 0 or not 1 <= other < n or samples[other].motion != FLIGHT:
            continue
        if events.move(window.first + k - 1, height, step):
            shift = samples[k - 1].time - samples[other - 1].time
            samples[k].motion, samples[other].motion = FLIGHT, Motion(motion.heights, (motion.times[0] + shift,))
            window.retract(min(k, other))
            return samples[min(k, other) :]
    return ()


def tell_velocities(window: StreamWindow, samples: Sequence[Sample]) -> None:
    """Sets rough velocities of the coming samples, by line fits between the events, for the errors of their stamps.

    A start or a hit just before the window's last sample left its velocity undetermined; now there are more samples.

    Args: as for `explain`.
    """
    held = len(window)
    times, positions = np.array([s.time for s in samples]), np.array([s.position for s in samples])
    breaks = [k - 1 for k, s in enumerate(samples) if k and s.motion != FLIGHT]
    velocities = window_velocities(times, positions, breaks)
    last = samples[max(held - 1, 0)].motion
    begins = held > 0 and (held == 1 or last.hit or not last.linked) and held - 1 not in breaks
    for k in range(held - begins, len(samples)):
        samples[k].velocity = velocities[k]
    if begins:
        window.reweigh([held - 1])
