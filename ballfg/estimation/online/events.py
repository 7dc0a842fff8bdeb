"""Keeps the segmenter's current events on a stream and applies them to the samples of the window."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.filters.window_velocity import WINDOW, window_velocities
from ballfg.estimation.online.state import Sample
from ballfg.estimation.online.windows.stream_window import StreamWindow
from ballfg.estimation.segmentation.batch import BREAKS, SIDE, assembled
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import Event, EventKind, Quality, Segmentation
from ballfg.estimation.segmentation.segmenter import Segmenter
from ballfg.estimation.segmentation.settings import SegmentationSettings
from ballfg.estimation.smoother.motion import FLIGHT, Motion, eventful_motions
from ballfg.estimation.smoother.problem import QUALITY_SIGMA
from ballfg.state import STANDARD_GRAVITY, VZ, Z

SIGMA_FACTOR = np.array([QUALITY_SIGMA.get(quality, 1.0) for quality in Quality])
"""Standard deviation of a sample of each quality, in multiples of a good one's."""
UNUSABLE = QUALITY_SIGMA[Quality.SHIFTED]
"""Multiple of the standard deviation from which a sample does not influence its state."""
MOVE_MARGIN = 0.02
"""Share of an interval by which the estimated contact must lie outside before it moves, against oscillation."""
MOST_MOVES = 6
"""Largest number of moves of one contact."""
LATEST_CHANGE = 80
"""Samples. The segmenter's events are final after 64; older states are never rebuilt."""
YOUNG = 20
"""Number of samples after a contact in which the estimate may still move it to another interval."""


LONGEST_UNSEEN = 0.3
"""s. Longest gap over which the number of bounces is known at once: over a longer one the unknown acceleration alone
moves the ball by the height of a hop. Simulated gaps of 0.15 to 0.4 s chose it; others of 0.3 to 0.45 s, with
other noise and rates, judged it."""


class EventTracker:
    """Keeps a segmenter's final and pending events and turns them into a segmentation of the window.

    Args:
        surfaces: table and floor.  physics: of the ball.
        find_events: False leaves contacts only, as the smoother does.
    """

    def __init__(self, surfaces: Surfaces, physics: SegmentationPhysics, find_events: bool) -> None:
        self.settings = SegmentationSettings(longest_unseen=LONGEST_UNSEEN)
        self.physics = physics
        self.find_events = find_events
        self.segmenter = Segmenter(surfaces, physics, self.settings)
        self._final: list[Event] = []
        self._pending: tuple[Event, ...] = ()
        self._moves: dict[tuple[int, float], list[int]] = {}  # steps of each contact, by the place it was found at

    def copy(self) -> "EventTracker":
        """An event tracker with the same samples, independent of this one."""
        other = copy.copy(self)
        other.segmenter = self.segmenter.copy()
        other._final = list(self._final)
        other._moves = {place: list(steps) for place, steps in self._moves.items()}
        return other

    def push(self, time: float, position: Array, sigma: Array) -> bool:
        """Takes in a sample; True if the explanation of the window may have changed."""
        decision = self.segmenter.push(time, position, sigma)
        before = (*self._final, *self._pending)
        self._final += decision.final
        self._pending = decision.pending
        after = (*self._final, *self._pending)
        changed = len(before) != len(after) or any(a is not b for a, b in zip(before, after, strict=True))
        resting = [e.kind for e in after if e.kind in _REST_KINDS][-1:] == [EventKind.REST]
        newest = self.segmenter.count - 1  # a contact with just enough samples after it is distinguished from a hit
        due = any(e.kind is EventKind.CONTACT and e.index + SIDE == newest for e in self._pending)
        return changed or resting or due

    def segmentation(self, first: int, times: Array, positions: Array) -> Segmentation:
        """The best explanation of samples first, first + 1, ... at (n,) s and (n, 3) m, numbered from 0."""
        old = [e for e in self._final if e.index < first and e.kind in _REST_KINDS][-1:]
        open_rest = [e for e in old if e.kind is EventKind.REST]  # the last rest, unless the ball left it
        self._final = open_rest + [e for e in self._final if e.index >= first]
        events = [
            replace(e, index=e.index - first)
            for e in (*self._final, *self._pending)
            if e.index >= first or e.kind is EventKind.REST
        ]
        found = assembled(events, times, positions, self.physics, self.settings)
        return found if self.find_events else found.only_contacts()

    def with_moved_contacts(self, segmentation: Segmentation, first: int) -> Segmentation:
        """The segmentation with its contacts at their refined places."""
        if not self._moves:
            return segmentation
        self._moves = {place: steps for place, steps in self._moves.items() if place[0] >= first - 1}
        contacts = [
            replace(c, interval=c.interval + sum(self._moves.get((c.interval + first, c.height), ())))
            for c in segmentation.contacts
        ]
        return replace(segmentation, contacts=tuple(contacts))

    def move(self, interval: int, height: float, step: int) -> bool:
        """Assigns the contact in an interval of the stream to a neighbour; False if it moved too often."""
        for place, steps in self._moves.items():
            if place[1] == height and place[0] + sum(steps) == interval:
                if len(steps) >= MOST_MOVES:
                    return False
                steps.append(step)
                return True
        self._moves[interval, height] = [step]
        return True

    def rise(self, height: float, state: Array) -> float:
        """m, z of the ball's centre when it touches a surface declared at `height` below a state (9,)."""
        return height + self.physics.rise(*state[:2].tolist()) + self.physics.radius


_REST_KINDS = (EventKind.REST, EventKind.LEAVE, *BREAKS)


def contact_step(state: Array, rise: float, dt: float) -> int:
    """The interval of a contact relative to that of `state` (9,): -1, 0 or 1; the centre touches at `rise` m."""
    above, vz = float(state[Z]) - rise, float(state[VZ])
    root = vz * vz + 2 * STANDARD_GRAVITY * above
    if root < 0.0:
        return 0
    time = (vz + math.sqrt(root)) / STANDARD_GRAVITY
    if time < -MOVE_MARGIN * dt:
        return -1
    return 1 if time > (1 + MOVE_MARGIN) * dt else 0


def first_difference(samples: Sequence[Sample], motions: Sequence[Motion], factors: Array) -> int | None:
    """The first sample whose motion or usability differs; None if only noise levels do, which do not go back."""
    for k, (sample, motion, factor) in enumerate(zip(samples, motions, factors, strict=True)):
        if not sample.motion.same(motion) or (sample.factor >= UNUSABLE) != (factor >= UNUSABLE):
            return k
    return None


def path_of(samples: Sequence[Sample]) -> tuple[Array, Array]:
    """Times (n,) s and positions (n, 3) m."""
    return np.array([s.time for s in samples]), np.array([s.position for s in samples])


def explain(window: StreamWindow, samples: list[Sample], events: EventTracker) -> list[Sample]:
    """Applies the events to the samples; those from the first difference on are retracted and returned."""
    held = len(window)
    times, positions = path_of(samples)
    segmentation = events.segmentation(window.first, times, positions)
    found = eventful_motions(events.with_moved_contacts(segmentation, window.first), times)
    settled = max(held - LATEST_CHANGE, 0)  # samples before it stay as they are
    young, old = samples[settled:], held - settled
    motions = [found.get(k, FLIGHT) for k in range(settled - 1, len(samples) - 1)]
    if not settled:
        motions[0] = samples[0].motion
    measured = np.array([sample.measured for sample in young])
    quality = segmentation.quality[settled:]
    factors = np.where(measured, SIGMA_FACTOR[quality], 1.0)  # the loss sets wrong sightings aside
    start = first_difference(young[:old], motions[:old], factors[:old])
    reweighed = [k for k, sample in enumerate(young[:old], settled) if sample.factor != factors[k - settled]]
    for k, (sample, motion, factor) in enumerate(zip(young, motions, factors.tolist(), strict=True)):
        sample.factor = factor
        if k >= old or not sample.motion.same(motion):
            sample.motion = motion
    again = [] if start is None else samples[max(settled + start, 1) : held]
    if again:
        window.retract(held - len(again))
    staying = [k for k in reweighed if k < len(window)]
    if staying:
        window.reweigh(staying)
    return again


def move_contacts(window: StreamWindow, samples: Sequence[Sample], events: EventTracker) -> Sequence[Sample]:
    """The samples retracted, as by `explain`, to move a young contact to its place; the newest may be to come."""
    n = len(window)
    for k in range(max(n - YOUNG, 1), n):
        motion = samples[k].motion
        if len(motion.heights) != 1 or motion.hit:
            continue
        (height,) = motion.heights
        state = window.theta[k - 1] + window.delta[k - 1]
        step = contact_step(state, events.rise(height, state), samples[k].time - samples[k - 1].time)
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
    """
    held = len(window)
    first = max(held - 1 - WINDOW, 0)  # no line reaches further back
    near = samples[first:]
    breaks = [k - 1 for k, sample in enumerate(near) if k and sample.motion != FLIGHT]
    velocities = window_velocities(*path_of(near), breaks)
    last = samples[max(held - 1, 0)].motion
    begins = held > 0 and (held == 1 or last.hit or not last.linked) and held - 1 - first not in breaks
    for k in range(held - begins, len(samples)):
        samples[k].velocity = velocities[k - first]
    if begins:
        window.reweigh([held - 1])
