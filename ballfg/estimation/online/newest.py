"""The newest sample of a stream is told with the window's belief, widened where an event is in doubt."""

import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.final import unknown
from ballfg.estimation.online.first_rest import FirstRest
from ballfg.estimation.online.hop_doubt import HopDoubt
from ballfg.estimation.online.state import Measurement, OnlineState, Sample
from ballfg.estimation.online.windows.stream_window import StreamWindow
from ballfg.estimation.plausible import possible
from ballfg.estimation.result import Status
from ballfg.estimation.sides.hypotheses import HypothesisModel, SampleMeasurement
from ballfg.estimation.sides.monitor import ContactMonitor, ContactState
from ballfg.estimation.sides.struck import AGREES, HitDoubt, RestDoubt, beside
from ballfg.estimation.smoother.motion import FLIGHT
from ballfg.estimation.smoother.problem import coefficient_means
from ballfg.factors.linear.definite import definite, variances_positive
from ballfg.state import STATE_DIM

if TYPE_CHECKING:
    from ballfg.estimation.online.online import Online

SURELY = 0.5 * AGREES
"""Squared innovation of the window below which a sample agrees with its flight: another prediction need not tell. On
`aimy` both are alike to 1e-5 where no state moved, and never differ by half; the states of `strokes`, `robot_rallies`
and `ballgun` are the same bits with and without this limit."""


@dataclass(frozen=True)
class Update:
    """What an observation did to the window; `innovation` is whitened, the rest as of `OnlineState`."""

    status: Status
    innovation: Array
    revised: int = 0
    rebuilt: bool = False


class Newest:
    """Follows both sides of a contact, and samples that contradict the flight.

    Args: owner: the estimator.  further: number of coefficients and biases beside a state of its window.
    """

    def __init__(self, owner: "Online", further: int) -> None:
        self.model, self.settings, self.world = owner.model, owner.settings, owner.world
        self.monitor = ContactMonitor(HypothesisModel(owner.ball, owner.surfaces, owner.settings, further))
        self.hit = HitDoubt(owner.settings, owner.events.settings)
        self.rest = RestDoubt(owner.events.settings)
        self.first = FirstRest(self.monitor.model, owner.events.settings)
        self.hops = HopDoubt(owner)

    def copy(self) -> "Newest":
        """The same, which further samples leave as it is."""
        other = copy.copy(self)
        other.monitor, other.hit = copy.copy(self.monitor), copy.copy(self.hit)
        other.rest, other.first, other.hops = copy.copy(self.rest), copy.copy(self.first), copy.copy(self.hops)
        return other

    def after(
        self, window: StreamWindow, samples: list[Sample], before: tuple[Array, Array] | None, update: Update
    ) -> OnlineState:
        """The state after a new sample, the last one. Args: before: the belief at the one before it, if it counts."""
        contact = self._near_contact(samples, before)
        state = self._state(window, samples[-1], contact, update)
        state = self._in_doubt_of_rolling(state)
        state = self._in_doubt_of_rest(state, samples, before)
        state = self._in_doubt_of_a_hit(state, samples, None if contact is not None else before)
        return self.hops.after(state, samples[-1])

    def joined(self, window: StreamWindow, samples: list[Sample], sighting: Measurement, update: Update) -> OnlineState:
        """The state after a further sighting of the newest sample; a rebuilt window holds it without a contact."""
        contact = None
        if not update.rebuilt:
            seen = SampleMeasurement(factors=[sighting.batch])
            contact = self.monitor.update(seen, lambda count: has_bounced(samples, count))
        return self._state(window, samples[-1], contact, update)

    def rolls_at_first(self, samples: list[Sample], begin: int) -> bool:
        """True if a ball without a spin label, on a surface with the first sample of a stream, more probably rolled.

        Args: samples: of the window.  begin: number of its first one in the stream.
        """
        first = samples[0]
        if not begin and (
            first.label is not None or not first.measured or len(samples) < 2 or samples[1].motion.rest is None
        ):
            self.first.reset()
        else:
            self.first.follow(samples, begin)
        return self.first.rolls

    def _near_contact(self, samples: list[Sample], before: tuple[Array, Array] | None) -> ContactState | None:
        """The state to report on either side of a contact, from the belief a sample before; None far from one."""
        sample = samples[-1]
        motion = sample.motion
        if before is None or motion.hit or not motion.linked or motion.rest is not None:
            self.monitor.reset()
            return None
        factors = [measurement.batch for measurement in sample.measurements]
        measured = SampleMeasurement(sample.position if sample.measured else None, sample.sigma, factors)
        dt = sample.time - samples[-2].time
        return self.monitor.step(before, dt, measured, lambda count: has_bounced(samples, count))

    def _in_doubt_of_a_hit(
        self, state: OnlineState, samples: list[Sample], before: tuple[Array, Array] | None
    ) -> OnlineState:
        """The state, its covariance widened where its sample may have followed a hit that nothing tells yet."""
        sample = samples[-1]
        if before is None or not sample.measured or sample.motion is not FLIGHT or not possible(state.state):
            self.hit.reset()
            return state
        if sample.factor == 1.0 and not state.revised and state.innovation @ state.innovation < SURELY:
            self.hit.reset()
            return state
        dt, measured = sample.time - samples[-2].time, (sample.position, sample.stated, sample.whole)
        joint = self.hit.widened(self.monitor.model, before, dt, measured, (state.mean, state.joint))
        return state if joint is state.joint else replace(state, joint=joint, struck=joint - state.joint)

    def _in_doubt_of_rolling(self, state: OnlineState) -> OnlineState:
        """The state of a ball on the surface where it was first seen, widened as it may have slid, or rolled, there."""
        if not possible(state.state):
            return state
        mean, joint = self.first.beside(state.mean, state.joint)
        return state if joint is state.joint else replace(state, mean=mean, joint=joint)

    def _in_doubt_of_rest(
        self, state: OnlineState, samples: list[Sample], before: tuple[Array, Array] | None
    ) -> OnlineState:
        """The state of a resting ball; where it may have left its surface, the more probable one, widened."""
        sample = samples[-1]
        level = sample.motion.rest
        followed = level is not None or sample.motion is FLIGHT
        if before is None or not followed or not sample.measured or not possible(state.state):
            self.rest.reset()
            return state
        dt, measured, d = sample.time - samples[-2].time, (sample.position, sample.stated), len(state.mean)
        if level is None:
            flying = self.rest.flown(self.monitor.model, dt, measured)
            return state if flying is None else replace(state, mean=flying[0][:d], joint=flying[1][:d, :d])
        found = self.rest.step(self.monitor.model, before, dt, measured, level)
        if found is None:
            return state
        near, joint = beside((state.mean, state.joint), (found[1][:d], found[2][:d, :d]), found[0])
        return replace(state, mean=near[0], joint=joint, struck=joint - near[1])

    def _state(self, window: StreamWindow, sample: Sample, contact: ContactState | None, update: Update) -> OnlineState:
        """The window's belief at the newest sample, or a contact's; without a possible one, that nothing is known."""
        mean, joint = window.newest_belief
        if contact is not None:
            mean, joint = contact.mean[: len(mean)], contact.widened[: len(mean), : len(mean)]
        status = update.status
        if possible(mean[:STATE_DIM]) and variances_positive(joint):
            joint = definite(joint)
        else:
            state, joint = unknown(sample, self.settings)
            mean = np.concatenate((state, coefficient_means(self.model, self.settings)))
            status = status if status.failed else Status.IMPLAUSIBLE
        return OnlineState(
            time=sample.time,
            mean=mean,
            joint=joint,
            coefficient_names=tuple(self.settings.coefficients),
            world=self.world,
            name="stream",
            other_side=None if contact is None else contact.other,
            innovation=update.innovation,
            motion=sample.motion,
            revised=update.revised,
            rebuilt=update.rebuilt,
            status=status,
        )


def has_bounced(samples: list[Sample], count: int) -> bool:
    """True if the window's ball has bounced in the last `count` intervals."""
    return any(sample.motion.heights for sample in samples[-count:])
