"""What happens between two samples, as a dynamics factor of its own that joins others in one batch."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.integrate import MAX_STEP
from ballfg.dynamics.model import BallModel
from ballfg.estimate.segmentation import Segmentation
from ballfg.factors.bridge import Bridge
from ballfg.factors.dynamics import ContactFactors, DynamicsFactors, FlightFactors, RestFactors
from ballfg.factors.noise import ProcessNoise
from ballfg.state import STATE_DIM

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """How the ball gets from one sample to the next.

    Attributes:
        heights: m, the surfaces met, in order.
        times: s since the interval's start, when they are met, as far as known when the factor was made.
        rest: m, the surface on which the ball lies all the time; None if it does not.
        hit: something hits the ball at an unknown moment.
        linked: False where nothing is known of what happened; the next state starts anew.
    """

    heights: tuple[float, ...] = ()
    times: tuple[float, ...] = ()
    rest: float | None = None
    hit: bool = False
    linked: bool = True

    def same(self, other: Motion) -> bool:
        """Whether both are the same events, at whatever moments."""
        mine = (self.heights, self.rest, self.hit, self.linked)
        return mine == (other.heights, other.rest, other.hit, other.linked)

    def covariance(self, dt: Array, noise: ProcessNoise) -> Array:
        """(1, 9, 9) process noise over dt (1,) s; the same as in `ballfg.estimate.problem`."""
        covariance = noise.flight(dt)
        for time in self.times:
            covariance += noise.contact(dt, np.array([time]))
        if self.hit:
            covariance += noise.hit(dt)
        return covariance


FLIGHT = Motion()


class Interval:
    """One linked interval: its factor, and the last answer that its torch batch gave.

    Args:
        index: number of the earlier state.
        motion: what happens.
        dt: s.
        model: the ball, augmented where coefficients are estimated.
        noise: of the motion.

    Attributes:
        slot: where iSAM2 keeps the factor; None before it does.
        covariance: (9, 9) of the process noise.
    """

    def __init__(self, index: int, motion: Motion, dt: float, model: BallModel, noise: ProcessNoise) -> None:
        self.index = index
        self.motion = motion
        duration = np.array([dt])
        covariance = motion.covariance(duration, noise)
        self.kind = _kind(model, motion, np.array([index]), duration, covariance)
        self.bridge = Bridge(self.kind, on_miss="row")
        self.covariance = covariance[0]
        self.slot: int | None = None
        steps = 1 if motion.heights else int(np.ceil(dt / MAX_STEP - 1e-9))
        self.group = (type(self.kind), len(motion.heights), steps)


def _kind(model: BallModel, motion: Motion, states: NDArray[np.int64], dt: Array, covariance: Array) -> DynamicsFactors:
    if motion.heights:
        return ContactFactors(model, states, dt, covariance, np.array([motion.heights]))
    if motion.rest is not None:
        return RestFactors(model, states, dt, covariance, np.array([motion.rest]))
    return FlightFactors(model, states, dt, covariance)


def evaluate(intervals: Sequence[Interval], start: Array, after: Array, coefficients: Array) -> tuple[list[Array], int]:
    """Residuals and Jacobians of some intervals, one torch call for all that share a motion, kept in their bridges.

    Args:
        intervals: k of them.
        start: (k, 9) states at which they begin.
        after: (k, 9) states at which they end.
        coefficients: (p,).
    Returns: for each interval the propagated state and its Jacobian side by side, (9, 1 + 9 + p); number of calls.
    """
    groups: dict[tuple[type, int, int], list[int]] = {}
    for k, interval in enumerate(intervals):
        groups.setdefault(interval.group, []).append(k)
    result: list[Array] = [np.empty(0)] * len(intervals)
    for members in groups.values():
        batch = _merged([intervals[k].kind for k in members])
        point = np.concatenate((start[members], np.broadcast_to(coefficients, (len(members), len(coefficients)))), axis=1)
        moved, jacobian = batch.propagate(torch.from_numpy(point), slice(None))
        pieces = np.concatenate((moved.numpy()[:, :STATE_DIM, None], jacobian.numpy()[:, :STATE_DIM]), axis=2)
        for row, k in enumerate(members):
            result[k] = pieces[row]
            store(intervals[k], start[k], after[k], coefficients, pieces[row])
    return result, len(groups)


def store(interval: Interval, start: Array, after: Array, coefficients: Array, piece: Array) -> None:
    """Whiten one interval's propagation and keep it for iSAM2's question; `piece` as from `evaluate`."""
    root = interval.kind.whitening[0]
    residual = root @ (after - piece[:, 0])
    by_start = -(root @ piece[:, 1:])
    inputs: tuple[Array, ...] = (start, after)
    blocks: tuple[Array, ...] = (by_start[:, :STATE_DIM], root)
    if len(coefficients):
        inputs, blocks = (*inputs, coefficients), (*blocks, by_start[:, STATE_DIM:])
    interval.bridge.keep(0, inputs, residual, blocks)


def _merged(kinds: Sequence[DynamicsFactors]) -> DynamicsFactors:
    """One batch out of kinds that share a motion."""
    if len(kinds) == 1:
        return kinds[0]
    batch = copy.copy(kinds[0])
    for name in ("variables", "dt", "whitening", "heights"):
        if hasattr(batch, name):
            setattr(batch, name, np.concatenate([getattr(kind, name) for kind in kinds]))
    return batch


def motions_of(segmentation: Segmentation, times: Array) -> list[Motion]:
    """The motion of every interval of a track or window.

    Args: segmentation: of n samples.  times: (n,) s.
    """
    count = len(times) - 1
    heights: list[list[tuple[float, float]]] = [[] for _ in range(count)]
    for contact in sorted(segmentation.contacts, key=lambda c: c.time):
        if 0 <= contact.interval < count:
            heights[contact.interval].append((contact.height, contact.time - float(times[contact.interval])))
    rests: dict[int, float] = {}
    for rest in segmentation.rests:
        rests.update(dict.fromkeys(range(max(rest.first, 0), min(rest.last, count - 1) + 1), rest.height))
    hits, restarts = set(segmentation.hits.tolist()), set(segmentation.restarts.tolist())
    return [
        Motion(
            heights=tuple(h for h, _ in met),
            times=tuple(t for _, t in met),
            rest=None if met else rests.get(i),
            hit=i in hits,
            linked=i not in restarts,
        )
        if met or i in rests or i in hits or i in restarts
        else FLIGHT
        for i, met in enumerate(heights)
    ]


def coefficient_count(model: BallModel) -> int:
    """How many coefficients are estimated with the states."""
    return len(model.names) if isinstance(model, AugmentedModel) else 0
