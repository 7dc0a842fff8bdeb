"""Finds samples near a contact or hit where a ball may be on either side, the states to report, and covariances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.motion.arrays import fly, fly_through, gap_jacobian
from ballfg.estimation.plausible import possible
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.sides.hypotheses import ContactHypotheses, HypothesisModel, SampleMeasurement
from ballfg.factors.linear.definite import compatible, definite, variances_positive
from ballfg.state import POSITION, STATE_DIM, VELOCITY, VZ

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

NEGLIGIBLE: Final = 1e-6
"""Probability below which a side is neglected."""
LEAST_SAMPLES: Final = 8
LEAST_TIME: Final = 0.04
"""Samples and s within which the estimator must have found the contact. At 1000 Hz eight samples are over before a ball
whose surface is known to 4 mm shows on which side it is. 2 mm at 1000 Hz chose the time; 1 and 5 mm, and 500 Hz,
judged it."""
MOST_REJECTED: Final = 2
"""Number of consecutive samples without a fitting hypothesis after which another event is assumed."""
GATE: Final = 30.664849
"""Squared whitened distance in three dimensions beyond which a position is rejected: one in a million good ones is."""
FAR: Final = 4.0
"""Standard deviations of a contact's time beyond which a stamp lies on one side of it."""
LEAST_SPEED: Final = 1e-3
"""m/s, least speed across the surface, or jump of the velocity, in the uncertainty of the time of a contact or hit."""
MORE: Final = 3.0
"""Factor on the chance of the less probable side in a covariance,"""
ENOUGH: Final = 0.3
"""up to this. With the chance itself the truth lies within the stated 30 of NEES in 99 of 100 states right after a
bounce, with more it does so in the remaining states too. Chosen on `tests.estimation.both_sides --seed 1`."""
SPREAD: Final = 0.01
"""Chance from which the other side's spread counts fully. A bounce scatters velocity and spin in five directions: a
mixture's covariance has only a share q of that spread, and each of them would add 1 / q to the NEES of a ball that is
on the less probable side after all."""


def widening(near: Array, far: Array, jump: Array, chance: float) -> Array:
    """(9, 9) difference from a covariance of one side of a contact to one that includes both; positive semidefinite.

    Args: near, far: (9, 9) covariances on the two sides.  jump: (9,) from the one to the other.
        chance: of the far side, at most a half.
    """
    share, whole = max(chance, min(MORE * chance, ENOUGH)), min(chance / SPREAD, 1.0)
    root = np.linalg.cholesky(near)  # far - near, in the directions in which it is positive
    half = np.linalg.solve(root, far - near)
    values, axes = np.linalg.eigh(np.linalg.solve(root, half.T))
    more = root @ axes[:, values > 0.0]
    excess = (more * values[values > 0.0]) @ more.T
    return np.asarray(whole * excess + share * np.outer(jump, jump))


@dataclass(frozen=True)
class Shared:
    """Coefficients (p,) estimated with n states, their covariance (p, p), and that with the states (n, 9, p)."""

    mean: Array
    covariance: Array
    cross: Array


def widened_near_contacts(estimate: Estimate, model: BallModel, restarts: Sequence[int] | Index = ()) -> Estimate:
    """The estimate with covariances widened for the chance of the other side of a near contact or hit.

    Args: restarts: those of the hits over which nothing links the two sides.
    """
    if estimate.status.failed:  # its states have no contacts
        return replace(estimate, other_sides=np.zeros_like(estimate.covariances))
    shared = Shared(estimate.coefficients, estimate.coefficient_covariance, estimate.cross_covariances)
    known = (estimate.times, estimate.states, estimate.covariances, estimate.contacts)
    others = widening_near_contacts(*known, model, shared)
    struck = np.setdiff1d(estimate.hits, [*restarts, *(contact.interval for contact in estimate.contacts)])
    others += widening_near_hits(*known[:3], struck, model, shared)
    return replace(estimate, covariances=estimate.covariances + others, other_sides=others)


def widening_near_contacts(
    times: Array, states: Array, covariances: Array, contacts: Sequence[Contact], model: BallModel, shared: Shared
) -> Array:
    """(n, 9, 9) to be added near contacts for the chance that a ball is on the other side; zero far from them.

    The estimate fixes the order of contact and stamp. The gap between ball and surface at a stamp is known to a sigma,
    including that of the surface's height, and the contact's time to sigma / |v_z|: often 0.1 ms, so that few stamps
    are concerned.

    Args: times, states, covariances: (n,) s, (n, 9), (n, 9, 9).  contacts: with their estimated times.
        model: the ball, its coefficients in columns after the state.
    """
    lacking = np.zeros_like(covariances)
    grouped = [list(met) for _, met in groupby(contacts, key=lambda contact: contact.interval)]
    sides = [(met[0].interval + late, met[-late], met) for met in grouped for late in (0, 1)]
    if not sides:
        return lacking
    stamps = np.array([k for k, _, _ in sides])
    sigmas = gap_sigmas(states[stamps], covariances[stamps], shared, stamps, [c.height for _, c, _ in sides], model)
    speeds = np.maximum(np.abs(states[stamps, VZ]), LEAST_SPEED)
    lags = np.array([(c.time - times[k]) * (1 if k == c.interval else -1) for k, c, _ in sides])
    for (k, _, met), margin in zip(sides, (lags * speeds / sigmas).tolist(), strict=True):
        if margin < FAR and possible(there := _on_other_side(model, times, states, shared.mean, k, met)):
            chance = 0.5 * math.erfc(max(margin, 0.0) / math.sqrt(2.0))
            other = 2 * met[0].interval + 1 - k
            lacking[k] += widening(covariances[k], covariances[other], there - states[k], chance)
    return lacking


def widening_near_hits(
    times: Array, states: Array, covariances: Array, hits: Index, model: BallModel, shared: Shared
) -> Array:
    """(n, 9, 9) to be added next to hits for the chance that a ball is on the other side; zero elsewhere.

    A hit is where the paths before and after it meet. Its time is known to the sigma of their distance over the jump of
    the velocity; where they miss each other by more than that sigma, the miss takes its place.

    Args: times, states, covariances: (n,) s, (n, 9), (n, 9, 9).  hits: (h,) intervals without a contact.
        model: the ball, its coefficients in columns after the state.
    """
    lacking, width = np.zeros_like(covariances), POSITION.stop + 3
    if not len(hits):
        return lacking
    spans = times[hits + 1] - times[hits]
    there, lags, misses = across_hits(model, times, states, shared.mean, hits)
    for late in (0, 1):
        near, far = hits + late, hits + 1 - late
        step = np.tile(np.eye(3, width), (len(hits), 1, 1))
        step[:, :, VELOCITY] = (spans * (1 if late else -1))[:, None, None] * np.eye(3)
        spread = covariances[near][:, POSITION, POSITION] + step @ covariances[far][:, :width, :width] @ step.mT
        jump = there[:, late, VELOCITY] - states[near, VELOCITY]
        speeds = np.maximum(np.linalg.norm(jump, axis=1), LEAST_SPEED)
        along = np.einsum("hi,hij,hj->h", jump, spread, jump) / speeds**2
        sigmas = np.sqrt(np.maximum(along, 0.5 * (misses**2).sum(axis=1)))  # a miss has two components
        margins = np.where(late, spans - lags, lags) * speeds / sigmas
        for row in np.flatnonzero(margins < FAR):
            k = near[row]
            if possible(there[row, late]):
                chance = 0.5 * math.erfc(max(float(margins[row]), 0.0) / math.sqrt(2.0))
                lacking[k] += widening(covariances[k], covariances[far[row]], there[row, late] - states[k], chance)
    return lacking


def across_hits(
    model: BallModel, times: Array, states: Array, coefficients: Array, hits: Index
) -> tuple[Array, Array, Array]:
    """States of a ball if hits lay beyond the ends of their intervals, and where the paths before and after them meet.

    Args: times, states: (n,) s, (n, 9).  coefficients: (p,) in columns after the state.  hits: (h,) intervals.
    Returns: (h, 2, 9) states at both ends; (h,) s from the start of the interval to where the paths are nearest to each
        other, and (h, 3) m between them there.
    """
    spans = times[hits + 1] - times[hits]
    starts = _with_coefficients(states[np.stack((hits + 1, hits), axis=1).ravel()], coefficients)
    flown = fly(model, starts, np.stack((-spans, spans), axis=1).ravel())
    there = flown[:, :STATE_DIM].reshape(-1, 2, STATE_DIM)
    apart = there[:, 0] - states[hits]
    jump = apart[:, VELOCITY]
    lags = -(apart[:, POSITION] * jump).sum(axis=1) / np.maximum((jump**2).sum(axis=1), LEAST_SPEED**2)
    return there, lags, apart[:, POSITION] + lags[:, None] * jump


def gap_sigmas(
    states: Array,
    covariances: Array,
    shared: Shared,
    stamps: Array,
    heights: Sequence[float],
    model: BallModel,
    lags: Array | float = 0.0,
) -> Array:
    """(m,) m, standard deviations of the gaps between balls and surfaces, `lags` s of flight after their stamps."""
    whole = _with_coefficients(states, shared.mean)
    _, slopes = gap_jacobian(model, whole, np.array(heights))
    own, rest = slopes[:, :STATE_DIM], slopes[:, STATE_DIM:]
    own[:, VZ] += lags
    variance = (own[:, None] @ covariances @ own[:, :, None])[:, 0, 0]
    if len(shared.mean):
        variance += np.einsum("mi,ij,mj->m", rest, shared.covariance, rest)
        variance += 2.0 * np.einsum("mi,mij,mj->m", own, shared.cross[stamps], rest)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _on_other_side(
    model: BallModel, times: Array, states: Array, coefficients: Array, stamp: int, met: Sequence[Contact]
) -> Array:
    """(9,) the state at a stamp if the nearest contact of its interval lay beyond it; NaN or absurd where none fits.

    Args: met: contacts of one interval, which begins or ends with the stamp.
    """
    first, heights = met[0].interval, [contact.height for contact in met]
    start, dt = first, times[stamp] - times[first]
    if stamp == first and len(met) == 1:
        start, dt = first + 1, times[first] - times[first + 1]
    passed = heights[:1] if start == stamp else heights[:-1]
    state = _with_coefficients(states[start : start + 1], coefficients)
    after, _ = fly_through(model, state, np.array([dt]), passed)
    return after[0, :STATE_DIM]


def _with_coefficients(states: Array, coefficients: Array) -> Array:
    if not len(coefficients):
        return states
    return np.column_stack((states, np.tile(coefficients, (len(states), 1))))


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
    """Runs beside an estimator and follows both hypotheses of a ball near a contact."""

    def __init__(self, model: HypothesisModel) -> None:
        self.model = model
        self._hypotheses: ContactHypotheses | None = None
        self._samples = 0
        self._elapsed = 0.0
        self._rejected = 0

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
            if not self.model.may_touch(*before, dt, told=bounced(1)):
                return None
            self._start(*before)
        return self._step(dt, measured, bounced)

    def run(
        self,
        before: tuple[Array, Array],
        steps: Sequence[tuple[float, SampleMeasurement]],
        bounced: Callable[[int], bool],
    ) -> ContactState | None:
        """The state to report at the last of several samples, by times in s to each and measurements, as of `step`."""
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
        self._samples, self._elapsed, self._rejected = 0, 0.0, 0

    def _step(self, dt: float, measured: SampleMeasurement, bounced: Callable[[int], bool]) -> ContactState | None:
        assert self._hypotheses is not None
        before = self._hypotheses
        new = before.sides[0].log_weight > np.log(NEGLIGIBLE)  # the bounce may lie in this interval
        after = before.step(dt, measured)
        self._rejected = self._rejected + 1 if after.nearest > GATE else 0
        if self._rejected:
            after = before.step(dt, SampleMeasurement())
        self._samples, self._elapsed = self._samples + 1, self._elapsed + dt
        self._hypotheses = after
        state = self._state(after, bounced, new=new) if self._rejected < MOST_REJECTED else None
        if state is None or (self._samples >= LEAST_SAMPLES and self._elapsed >= LEAST_TIME):
            self.reset()
        return state

    def _state(
        self, hypotheses: ContactHypotheses, bounced: Callable[[int], bool], *, new: bool
    ) -> ContactState | None:
        """None if hypotheses and estimator agree on which side is certain, or if no state is possible."""
        sides = hypotheses.sides
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
