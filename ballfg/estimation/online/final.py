"""Computes the final estimate of a streamed track: the window's minimum and the states that left the window."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.events import SIGMA_FACTOR
from ballfg.estimation.online.state import Sample
from ballfg.estimation.online.windows.interval import without_bias
from ballfg.estimation.online.windows.stream_window import StreamWindow
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation.result import Contact, Segmentation
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.settle import Earlier
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY
from ballfg.tracks import Track


@dataclass(frozen=True)
class Frozen:
    """A state (9,) when it left the window: with its observation, and its covariance with the coefficients."""

    sample: Sample
    state: Array
    joint: Array


def freeze(window: StreamWindow, count: int) -> list[Frozen]:
    """The window's oldest states with their covariances."""
    kept = zip(window.samples, window.states, window.joint_covariances(count), strict=False)
    return [Frozen(sample, state, without_bias(joint, window.width)) for sample, state, joint in kept]


def unknown(sample: Sample, settings: Settings, p: int) -> Frozen:
    """A state known by its observation alone, because its window could not be solved."""
    state, sigma = np.zeros(STATE_DIM), np.empty(STATE_DIM + p)
    state[POSITION], sigma[POSITION] = sample.position, sample.sigma
    sigma[VELOCITY], sigma[SPIN] = settings.velocity_prior, settings.spin_prior
    sigma[STATE_DIM:] = list(settings.coefficients.values())
    return Frozen(sample, state, np.diag(sigma**2))


def final_estimate(
    smoother: Smoother, window: StreamWindow, track: Track, found: Segmentation, frozen: Sequence[Frozen]
) -> Estimate:
    """The result over a whole track, from the events in the window and the states before it."""
    first = window.first
    part = track.between(float(track.times[first]), float(track.times[-1]))
    problem = smoother.problem(part, found)
    settled = smoother.settle(problem, Earlier(window.values, window.summaries()))
    if not first:  # what has left the window is not known well enough
        problem, settled = smoother.bridged(problem, settled)
    late = smoother.result(problem, settled, begins=not first)
    if not frozen:
        return late
    joints = np.array([f.joint for f in frozen])
    contacts, hits = list[Contact](), list[int]()
    for k, (before, state) in enumerate(pairwise(frozen)):
        motion, start = state.sample.motion, before.sample.time
        if motion.linked:
            contacts += [Contact(k, start + t, h) for t, h in zip(motion.times, motion.heights, strict=True)]
        if motion.hit or not motion.linked:
            hits.append(k)
    quality = np.array([int(np.argmin(np.abs(SIGMA_FACTOR - f.sample.factor))) for f in frozen], dtype=np.int8)
    return replace(
        late,
        times=track.times,
        states=np.concatenate((np.array([f.state for f in frozen]), late.states)),
        covariances=np.concatenate((joints[:, :STATE_DIM, :STATE_DIM], late.covariances)),
        other_sides=np.concatenate((np.zeros((len(frozen), STATE_DIM, STATE_DIM)), late.other_sides)),
        cross_covariances=np.concatenate((joints[:, :STATE_DIM, STATE_DIM:], late.cross_covariances)),
        contacts=(*contacts, *(replace(c, interval=c.interval + first) for c in late.contacts)),
        hits=np.concatenate((np.array(hits, dtype=np.int64), late.hits + first)),
        quality=np.concatenate((quality, late.quality)),
    )
