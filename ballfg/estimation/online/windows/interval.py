"""An interval is a dynamics factor between two samples; a filter predicts new states over it."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array, plain
from ballfg.dynamics.compiled.flight import white_acceleration
from ballfg.dynamics.motion.limits import steps_over
from ballfg.estimation.smoother.motion import FLIGHT, Motion
from ballfg.factors.batch import merge
from ballfg.factors.bridge import Bridge, checked
from ballfg.factors.dynamics import ContactFactors, DynamicsFactors, FlightFactors, RestFactors, whiten
from ballfg.factors.noise import ProcessNoise
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel


class Interval:
    """One linked interval: its factor, and the last result of its torch batch.

    Args:
        batch: one row, between states i and i + 1 of the stream.  motion: events in the interval.
        covariance: (9, 9) of the process noise.

    Attributes:
        slot: place of the factor in iSAM2; None outside of it.
        group: intervals of one group can be evaluated together.
    """

    def __init__(self, batch: DynamicsFactors, motion: Motion, covariance: Array) -> None:
        self.batch = batch
        self.motion = motion
        self.covariance = covariance
        self.index = int(batch.variables[0, 0])
        self.bridge = Bridge(batch, on_miss="row")
        self.slot: int | None = None
        steps = 1 if motion.heights else steps_over(float(batch.dt[0]))
        self.group = (type(batch), len(motion.heights), steps)


class IntervalMaker:
    """Makes intervals; the root of the noise in flight, whose correlation does not depend on dt, is only scaled."""

    def __init__(self, model: BallModel, noise: ProcessNoise) -> None:
        self.model = model
        self.noise = noise
        covariance = noise.flight(np.ones(1))
        scale = np.sqrt(np.diagonal(covariance[0]))
        self._template = FlightFactors(model, np.zeros(1, dtype=np.int64), np.ones(1), covariance).prepared()
        self._root = self._template.whitening * scale
        self._correlation = covariance[0] / (scale[:, None] * scale)

    def make(self, index: int, motion: Motion, dt: float) -> Interval:
        """The interval from state `index` of the stream to the next, dt s later."""
        if motion == FLIGHT:
            return self._flight(index, dt)
        states, duration = np.array([index]), np.array([dt])
        covariance = motion.covariance(duration, self.noise)
        batch: DynamicsFactors
        if motion.heights:
            batch = ContactFactors(self.model, states, duration, covariance, np.array([motion.heights]))
        elif motion.rest is not None:
            batch = RestFactors(self.model, states, duration, covariance, np.array([motion.rest]))
        else:
            batch = FlightFactors(self.model, states, duration, covariance)
        return Interval(batch.prepared(), motion, covariance[0])

    def _flight(self, index: int, dt: float) -> Interval:
        scale = np.empty(STATE_DIM)
        position, _, velocity = white_acceleration(dt, 1.0)
        scale[POSITION] = self.noise.acceleration * math.sqrt(position)
        scale[VELOCITY] = self.noise.acceleration * math.sqrt(velocity)
        scale[SPIN] = self.noise.spin * math.sqrt(dt)
        batch = copy.copy(self._template)
        batch.variables = batch.variables.copy()
        batch.variables[0, :2] = index, index + 1
        batch.dt, batch.whitening = np.array([dt]), self._root / scale
        return Interval(batch, FLIGHT, self._correlation * (scale[:, None] * scale))


def evaluate(intervals: Sequence[Interval], start: Array, after: Array, coefficients: Array) -> list[Array]:
    """Residuals and Jacobians of k intervals, one torch call for all that share a motion, stored in their bridges.

    Args:
        start: (k, 9) states at which they begin; biases may follow these and the next.
        after: (l, 9) states at which the first l of them end; `store` completes the others.  coefficients: (p,).
    Returns: for each interval the propagated state and its Jacobian side by side, (9, 1 + 9 + p).
    Raises: ValueError: if a value of the model is not finite.
    """
    groups: dict[tuple[type, int, int], list[int]] = {}
    for k, interval in enumerate(intervals):
        groups.setdefault(interval.group, []).append(k)
    result: list[Array] = [np.empty(0)] * len(intervals)
    for members in groups.values():
        batch = merge([intervals[k].batch for k in members])
        point = np.empty((len(members), STATE_DIM + len(coefficients)))
        point[:, :STATE_DIM], point[:, STATE_DIM:] = start[members, :STATE_DIM], coefficients
        moved, jacobian = batch.moved(point, slice(None))
        pieces = np.concatenate((moved[:, :STATE_DIM, None], jacobian[:, :STATE_DIM]), axis=2)
        for row, k in enumerate(members):
            result[k] = pieces[row]
        ended = [k for k in members if k < len(after)]  # the first ones: members ascend
        if ended:
            store([intervals[k] for k in ended], start[ended], after[ended], coefficients, pieces[: len(ended)])
    return result


def store(intervals: Sequence[Interval], start: Array, after: Array, coefficients: Array, pieces: Array) -> None:
    """Whitens the propagations of k intervals and stores them for iSAM2's queries; `pieces` as from `evaluate`."""
    root = np.concatenate([interval.batch.whitening for interval in intervals])
    start, after = start[:, :STATE_DIM], after[:, :STATE_DIM]
    residual, by_start = whiten(plain(root), plain(after), plain(pieces[:, :, 0]), plain(pieces[:, :, 1:]))
    inputs: tuple[Array, ...] = (start, after)
    blocks: tuple[Array, ...] = (by_start[..., :STATE_DIM], root)
    if len(coefficients):
        inputs = (*inputs, np.broadcast_to(coefficients, (len(start), len(coefficients))))
        blocks = (*blocks, by_start[..., STATE_DIM:])
    if not (np.isfinite(residual).all() and np.isfinite(by_start).all()):
        checked(intervals[0].batch, slice(None), inputs, residual, blocks)  # says what is not finite
    for interval, own, errors, jacobians in zip(
        intervals, zip(*inputs, strict=True), residual, zip(*blocks, strict=True), strict=True
    ):
        interval.bridge.keep(0, own, errors, jacobians)
