"""The last word on a track: the window minimised to a tight tolerance, and the states that left it before."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.estimation.online.events import SIGMA_FACTOR
from ballfg.estimation.online.isam import Sample
from ballfg.estimation.online.tracker import without_bias
from ballfg.estimation.online.window import Window
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation import Contact, Segmentation
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Earlier, Smoother
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Values
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY
from ballfg.tracks import Track


@dataclass(frozen=True)
class Frozen:
    """A state as it was when it left the window.

    Attributes:
        sample: its observation.  state: (9,).  joint: (9 + p, 9 + p) covariance with the coefficients.
    """

    sample: Sample
    state: Array
    joint: Array


def freeze(window: Window, count: int) -> list[Frozen]:
    """The window's oldest states with their covariances."""
    shared, states, frozen = [COEFFICIENT_KEY] * (window.p > 0), window.states, []
    for k in range(count):
        joint = window.isam.jointMarginalCovariance([STATE_KEY + window.first + k, *shared]).fullMatrix()
        frozen.append(Frozen(window.samples[k], states[k], without_bias(joint, window.width)))
    return frozen


def unknown(sample: Sample, settings: Settings, p: int) -> Frozen:
    """A state of which nothing but its observation is known, because its window could not be solved."""
    state, sigma = np.zeros(STATE_DIM), np.empty(STATE_DIM + p)
    state[POSITION], sigma[POSITION] = sample.position, sample.sigma
    sigma[VELOCITY], sigma[SPIN] = settings.velocity_prior, settings.spin_prior
    sigma[STATE_DIM:] = list(settings.coefficients.values())
    return Frozen(sample, state, np.diag(sigma**2))


class LinearFactors(FactorBatch):
    """A linear factor that marginalised states left: r = sum A_i (v_i - v_i*) - b.

    Args:
        factor: of iSAM2.  values: v*, of the window.  first: number of the window's first state.
    """

    def __init__(self, factor: gtsam.NonlinearFactor, values: Values, first: int) -> None:
        keys = list(factor.keys())
        numbers = [COEFFICIENTS if k == COEFFICIENT_KEY else k - STATE_KEY - first for k in keys]
        self.sees_biases = values.biases is not None  # type: ignore[misc]  # the class's is that of states alone
        self.points = tuple(np.array(values.gather(np.array([n]), with_biases=True)) for n in numbers)
        at = gtsam.Values()
        for key, point in zip(keys, self.points, strict=True):
            at.insert(key, point[0])
        matrix, self.b = factor.linearize(at).jacobian()
        super().__init__(np.array([numbers]), len(self.b))
        widths = [point.shape[1] for point in self.points]
        self.blocks = tuple(np.split(matrix, np.cumsum(widths)[:-1], axis=1))

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Residual (1, r) and Jacobians (1, r, d)."""
        parts = [block @ (x - at)[0] for block, x, at in zip(self.blocks, inputs, self.points, strict=True)]
        return (np.sum(parts, axis=0) - self.b)[None], tuple(block[None] for block in self.blocks)


def final_estimate(
    smoother: Smoother, window: Window, track: Track, found: Segmentation, frozen: Sequence[Frozen]
) -> Estimate:
    """The result over a whole track.

    Args:
        smoother: with the window's model, surfaces and settings.
        window: after the last push.
        track: all of it.
        found: the events among the window's samples.
        frozen: the states that left the window, oldest first.
    """
    first = window.first
    part = track if first == 0 else track.between(float(track.times[first]), float(track.times[-1]))
    values = window.values
    summaries = [LinearFactors(factor, values, first) for factor in (window.shared if first else [])]
    problem = smoother.problem(part, found)
    late = smoother.result(problem, smoother.solve(problem, Earlier(values, summaries)))
    if not frozen:
        return late
    joints = np.array([f.joint for f in frozen])
    contacts, hits, quality = _events_of(frozen)
    return replace(
        late,
        times=track.times,
        states=np.concatenate((np.array([f.state for f in frozen]), late.states)),
        covariances=np.concatenate((joints[:, :STATE_DIM, :STATE_DIM], late.covariances)),
        other_sides=np.concatenate((np.zeros((len(frozen), STATE_DIM, STATE_DIM)), late.other_sides)),
        cross_covariances=np.concatenate((joints[:, :STATE_DIM, STATE_DIM:], late.cross_covariances)),
        contacts=(*contacts, *(replace(c, interval=c.interval + first) for c in late.contacts)),
        hits=np.concatenate((hits, late.hits + first)),
        quality=np.concatenate((quality, late.quality)),
    )


def _events_of(frozen: Sequence[Frozen]) -> tuple[list[Contact], Index, NDArray[np.int8]]:
    """Contacts, hits and qualities of the samples that left the window."""
    contacts, hits = [], []
    for k, state in enumerate(frozen):
        motion = state.sample.motion
        if k and motion.linked:
            start = frozen[k - 1].sample.time
            contacts += [Contact(k - 1, start + t, h) for t, h in zip(motion.times, motion.heights, strict=True)]
        if k and (motion.hit or not motion.linked):
            hits.append(k - 1)
    quality = np.array([int(np.argmin(np.abs(SIGMA_FACTOR - f.sample.factor))) for f in frozen], dtype=np.int8)
    return contacts, np.array(hits, dtype=np.int64), quality
