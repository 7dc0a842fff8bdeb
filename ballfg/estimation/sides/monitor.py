"""Finds the samples at which a ball may be on either side of a contact, and the states to report there."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import chdtri

from ballfg.arrays import Array
from ballfg.estimation.plausible import possible
from ballfg.estimation.result import Estimate
from ballfg.estimation.sides.hypotheses import ContactHypotheses, HypothesisModel, SampleMeasurement
from ballfg.estimation.sides.widening import widening
from ballfg.factors.linear.definite import compatible, definite, variances_positive
from ballfg.state import STATE_DIM

NEGLIGIBLE: Final = 1e-6
"""Probability below which a side is neglected."""
LONGEST: Final = 8
"""Number of samples within which the estimator must have found the contact."""
MOST_REJECTED: Final = 2
"""Number of consecutive samples without a fitting hypothesis after which another event is assumed."""
GATE_CHANCE: Final = 1e-6
"""Share of good positions that are rejected."""


@dataclass(frozen=True)
class ContactState:
    """The state to report near a contact: the more probable side's, widened by the other one.

    Attributes:
        mean: (d,) state, coefficients and bias on the more probable side.  covariance: (d, d) on that side alone.
        other: (9, 9) to be added to the state's covariance.  bounced: True if that side has bounced.
    """

    mean: Array
    covariance: Array
    other: Array
    bounced: bool

    @property
    def widened(self) -> Array:
        """(d, d) covariance that includes both sides."""
        covariance = self.covariance.copy()
        covariance[:STATE_DIM, :STATE_DIM] += self.other
        return covariance


class ContactMonitor:
    """Runs beside an estimator and follows both hypotheses of a ball near a contact.

    Args: model: of the ball.
    """

    def __init__(self, model: HypothesisModel) -> None:
        self.model = model
        self._hypotheses: ContactHypotheses | None = None
        self._samples = 0
        self._rejected = 0

    def copy(self) -> ContactMonitor:
        """An independent monitor in the same state."""
        return copy.copy(self)

    def reset(self) -> None:
        """Drops the hypotheses, after an event other than flight and bounce."""
        self._hypotheses = None

    def step(
        self, before: tuple[Array, Array], dt: float, measured: SampleMeasurement, bounced: Callable[[int], bool]
    ) -> ContactState | None:
        """The state to report at the next sample; None far from a contact, where the estimator's own is valid.

        Args:
            before: the estimator's mean (d,) and covariance (d, d) of state, coefficients and bias a sample ago, dt s.
            bounced: True if, by the estimator, the ball has bounced within that number of last intervals.
        """
        if self._hypotheses is None:
            if not self.model.may_touch(*before, dt):
                return None
            self._start(*before)
        return self._step(dt, measured, bounced)

    def run(
        self,
        before: tuple[Array, Array],
        steps: Sequence[tuple[float, SampleMeasurement]],
        bounced: Callable[[int], bool],
    ) -> ContactState | None:
        """The state to report at the last of several samples; arguments as of `step`.

        Args: steps: time in s to each sample, and its measurements.
        """
        self._start(*before)
        state = None
        for dt, measured in steps:
            state = None if self._hypotheses is None else self._step(dt, measured, bounced)
        return state

    def update(self, measured: SampleMeasurement, bounced: Callable[[int], bool]) -> ContactState | None:
        """The state to report after a further measurement at the same stamp; arguments as of `step`."""
        if self._hypotheses is None:
            return None
        self._hypotheses = self._hypotheses.updated(measured)
        return self._state(self._hypotheses, bounced, new=True)

    def _start(self, mean: Array, covariance: Array) -> None:
        self._hypotheses = ContactHypotheses.start(self.model, mean, covariance)
        self._samples = self._rejected = 0

    def _step(self, dt: float, measured: SampleMeasurement, bounced: Callable[[int], bool]) -> ContactState | None:
        assert self._hypotheses is not None
        before = self._hypotheses
        new = before.sides()[0].log_weight > np.log(NEGLIGIBLE)  # the bounce may lie in this interval
        after = before.step(dt, measured)
        self._rejected = self._rejected + 1 if after.nearest > chdtri(3, GATE_CHANCE) else 0
        if self._rejected:
            after = before.step(dt, SampleMeasurement())
        self._samples += 1
        self._hypotheses = after
        state = self._state(after, bounced, new=new) if self._rejected < MOST_REJECTED else None
        if state is None or self._samples >= LONGEST:
            self.reset()
        return state

    def _state(
        self, hypotheses: ContactHypotheses, bounced: Callable[[int], bool], *, new: bool
    ) -> ContactState | None:
        """None if hypotheses and estimator agree on which side is certain, or if no state is possible."""
        sides = hypotheses.sides()
        chances = np.exp([side.log_weight for side in sides])
        if not np.isfinite(chances).all():
            return None
        near = int(chances[1] > chances[0])
        chance = float(chances[1 - near])
        if chance < NEGLIGIBLE and bool(near) == bounced(self._samples) and not (near and new):
            return None
        mean, covariance = sides[near].means[0], sides[near].covariances[0]
        if not (possible(mean[:STATE_DIM]) and variances_positive(covariance)):
            return None
        covariance, own, other = definite(covariance), slice(STATE_DIM), np.zeros((STATE_DIM, STATE_DIM))
        if chance >= NEGLIGIBLE:
            jump = (sides[1 - near].means[0] - mean)[own]
            other = widening(covariance[own, own], sides[1 - near].covariances[0, own, own], jump, chance)
        return ContactState(mean, covariance, other, bool(near))


def with_contact_states(estimate: Estimate, found: Mapping[int, ContactState]) -> Estimate:
    """The estimate with other states at some samples; its coefficients keep their values."""
    others = estimate.other_sides
    others = others.copy() if len(others) else np.zeros_like(estimate.covariances)
    if not found or estimate.status.failed:
        return replace(estimate, other_sides=others)
    own, shared = slice(STATE_DIM), slice(STATE_DIM, STATE_DIM + len(estimate.coefficients))
    states, covariances = estimate.states.copy(), estimate.covariances.copy()
    cross = estimate.cross_covariances.copy()
    for k, state in found.items():
        states[k], others[k], covariances[k] = state.mean[own], state.other, state.widened[own, own]
        alone, with_shared = state.covariance[None, own, own], state.covariance[None, own, shared]
        cross[k] = compatible(with_shared, alone, estimate.coefficient_covariance)[0]
    return replace(estimate, states=states, covariances=covariances, other_sides=others, cross_covariances=cross)
