"""What estimators say of a ball at the first sample after its bounce, where the bounce may not have happened yet.

    python -m tests.estimation.both_sides --count 500 --seed 7

prints, for four noises and for each estimator, how often the truth lies far outside of what is stated (NEES above 30),
how often 90 % intervals hold it, and how sharp they are. The true balls are drawn from what the settings say of them:
spin, coefficients (the table's height among them), scatter of the flight and of the bounce; with `--exact` every ball
has the model's own coefficients and no scatter.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import chi2
from torch import Tensor

from ballfg.arrays import Array
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.motion.rollout import advance
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.filters.ekf import ExtendedKalmanFilter
from ballfg.estimation.online.online import Online
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.noise import ProcessNoise
from ballfg.live.tracker import Tracker
from ballfg.prediction.state import BallState
from ballfg.simulation import table_tennis
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY, VZ
from ballfg.tracks import Track

MODEL = table_tennis().model
SURFACES = Surfaces(0.0)
NOISES = ((0.005, 120.0), (0.003, 120.0), (0.002, 200.0), (0.001, 200.0))
"""m and Hz: standard deviation of a coordinate, rate."""
BEFORE = 8
"""Samples before the bounce, at least."""
AFTER = 12
"""Samples after the bounce that are made."""
SUBSTEPS = 4
"""Of an interval, after each of which the flight scatters."""
FAR = 30.0
"""NEES above which a statement is called wrong: 1 in 2,500 by chance."""


@dataclass(frozen=True)
class Bounced:
    """A ball that bounces once.

    Attributes:
        track: of it.  truth: (n, 9) states.  first: index of the first sample after the bounce.
    """

    track: Track
    truth: Array
    first: int

    def until(self, last: int) -> Track:
        """The track up to a sample, which is its last."""
        return Track(self.track.times[: last + 1], self.track.positions[: last + 1], name=self.track.name)


class Scattered(AugmentedModel):
    """A model whose impacts scatter.

    Args: model, names: as of `AugmentedModel`.  noise: of the impacts.  rng: draws.
    """

    def __init__(self, names: tuple[str, ...], noise: ProcessNoise, rng: np.random.Generator) -> None:
        super().__init__(MODEL, names)
        along = float(np.hypot(noise.contact_velocity, noise.contact_tangential))
        self._sigma = np.array([along, along, noise.contact_velocity, *[noise.contact_spin] * 3])
        self._rng = rng

    def after_bounce(self, state: Tensor) -> Tensor:
        """State and coefficients just after an impact."""
        after = super().after_bounce(state).clone()
        after[..., 3:STATE_DIM] += torch.from_numpy(self._sigma * self._rng.standard_normal((*after.shape[:-1], 6)))
        return after


def settings_of(noise: float) -> Settings:
    """Those of measured tracks with a noise of so many m."""
    return Settings.for_measured(MODEL, position_noise=(noise,) * 3)


def bounced(count: int, seed: int, noise: float, rate: float, exact: bool = False) -> list[Bounced]:
    """Balls with one bounce each, from half a flight before it to `AFTER` samples after it.

    Args: count, seed: of balls.  noise: m, of a coordinate.  rate: Hz.  exact: no scatter, the model's coefficients.
    """
    rng, found = np.random.default_rng(seed), list[Bounced]()
    while len(found) < count:
        times, states = _flown(count, rng, rate, settings_of(noise), exact)
        for truth in states:
            jumps = np.flatnonzero(np.diff(truth[:, VZ]) > 0.5)
            if len(jumps) == 0 or jumps[0] + 1 < BEFORE or (len(jumps) > 1 and jumps[1] - jumps[0] < AFTER):
                continue
            n = jumps[0] + 1 + AFTER
            if n > len(times):
                continue
            measured = truth[:n, POSITION] + noise * rng.standard_normal((n, 3))
            track = Track(times[:n], measured, name=f"ball {len(found)}")
            found.append(Bounced(track, truth[:n], int(jumps[0]) + 1))
    return found[:count]


@torch.no_grad()
def _flown(count: int, rng: np.random.Generator, rate: float, settings: Settings, exact: bool) -> tuple[Array, Array]:
    """Times (n,) and true states (count, n, 9) of balls."""
    process, names = settings.process, tuple(settings.coefficients)
    model = AugmentedModel(MODEL, names) if exact else Scattered(names, process, rng)
    times = np.arange(int(0.45 * rate) + AFTER) / rate
    start = np.column_stack(
        (
            np.zeros((count, 2)),
            rng.uniform(0.15, 0.5, count),
            rng.uniform(2.0, 8.0, count),
            rng.uniform(-1.0, 1.0, count),
            rng.uniform(-2.5, 1.0, count),
            rng.normal(0.0, settings.spin_prior, (count, 3)),
            model.means().numpy() + (not exact) * _drawn(settings, rng, count),
        )
    )
    state, states = torch.from_numpy(start), [start[:, :STATE_DIM]]
    h = 1.0 / rate / SUBSTEPS
    for _ in times[1:]:
        for _ in range(SUBSTEPS):
            state = advance(model, state, torch.full((count,), h, dtype=torch.float64), SURFACES)
            if not exact:
                kick = rng.standard_normal((count, 6)) * np.sqrt(h)
                state[:, VELOCITY] += torch.from_numpy(process.acceleration * kick[:, :3])
                state[:, SPIN] += torch.from_numpy(process.spin * kick[:, 3:])
        states.append(state[:, :STATE_DIM].numpy().copy())
    return times, np.stack(states, axis=1)


def _drawn(settings: Settings, rng: np.random.Generator, count: int) -> Array:
    """(count, p) by which coefficients differ from the model's."""
    sigmas = np.array(list(settings.coefficients.values()))
    return np.asarray(sigmas * rng.standard_normal((count, len(sigmas))))


def pushed(settings: Settings) -> Callable[[Bounced, int], BallState]:
    """The state that `Online.push` gives of a sample."""
    online = Online(MODEL, SURFACES, settings)

    def state(ball: Bounced, sample: int) -> BallState:
        online.reset()
        track = ball.until(sample)
        return [online.push(t, p) for t, p in zip(track.times.tolist(), track.positions, strict=True)][-1]

    return state


def live(settings: Settings) -> Callable[[Bounced, int], BallState]:
    """The state that `Tracker.push` gives of a sample."""

    def state(ball: Bounced, sample: int) -> BallState:
        tracker, track = Tracker(MODEL, SURFACES, settings), ball.until(sample)
        told = [tracker.push(t, p) for t, p in zip(track.times.tolist(), track.positions, strict=True)]
        (last,) = [update.state for update in told[-1] if update.state is not None]
        return last

    return state


def filtered(settings: Settings) -> Callable[[Bounced, int], BallState]:
    """The extended Kalman filter's state at a sample."""
    ekf = ExtendedKalmanFilter(MODEL, SURFACES, settings)
    return lambda ball, sample: ekf.estimate(ball.until(sample)).last


def smoothed(settings: Settings) -> Callable[[Bounced, int], BallState]:
    """The smoother's state at the end of a track that ends with a sample."""
    smoother = Smoother(MODEL, SURFACES, settings)
    return lambda ball, sample: smoother.estimate(ball.until(sample)).last


ESTIMATORS = {"push": pushed, "live": live, "EKF": filtered, "track end": smoothed}


@dataclass(frozen=True)
class Held:
    """What states say beside the truth.

    Attributes:
        nees: (n,) squared error over covariance.  whole: (n, 9) errors in the stated standard deviations.
        sharpness: (n,) m/s, standard deviation of the vertical velocity.
    """

    nees: Array
    errors: Array
    sharpness: Array

    @staticmethod
    def of(states: Iterator[tuple[BallState, Array]]) -> Held:
        """Of states and true ones (9,)."""
        nees, errors, sharpness = [], [], []
        for state, truth in states:
            error = state.state - truth
            nees.append(float(error @ np.linalg.solve(state.covariance, error)))
            errors.append(error / state.sigmas)
            sharpness.append(float(state.sigmas[VZ]))
        return Held(np.array(nees), np.array(errors), np.array(sharpness))

    @property
    def wrong(self) -> float:
        """Share of statements that are far off."""
        return float((self.nees > FAR).mean())

    @property
    def inside(self) -> Array:
        """(10,) share of truths in the 90 % interval of each component, and in the region of all together."""
        each = (np.abs(self.errors) < 1.645).mean(axis=0)
        return np.append(each, (self.nees < chi2.ppf(0.9, STATE_DIM)).mean())

    def __str__(self) -> str:
        each = " ".join(f"{100 * share:3.0f}" for share in self.inside[:-1])
        return (
            f"NEES > {FAR:g}: {100 * self.wrong:5.1f} %   NEES mean {self.nees.mean():9.1f}   in 90 %: {each}"
            f"   together {100 * self.inside[-1]:3.0f}   sigma of v_z: median {np.median(self.sharpness):.3f}, "
            f"mean {self.sharpness.mean():.3f} m/s"
        )


def held(name: str, balls: list[Bounced], noise: float, shift: int = 0) -> Held:
    """What an estimator says of balls, `shift` samples after the first one beyond the bounce."""
    state = ESTIMATORS[name](settings_of(noise))
    return Held.of((state(ball, ball.first + shift), ball.truth[ball.first + shift]) for ball in balls)


def main() -> None:
    """Prints a line for each noise and estimator."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--shift", type=int, default=0, help="samples after the first one beyond the bounce")
    parser.add_argument("--only", choices=ESTIMATORS, nargs="*", default=list(ESTIMATORS))
    chosen = parser.parse_args()
    for noise, rate in NOISES:
        balls = bounced(chosen.count, chosen.seed, noise, rate, chosen.exact)
        for name in chosen.only:
            print(f"{1e3 * noise:g} mm, {rate:g} Hz, {name:9}: {held(name, balls, noise, chosen.shift)}", flush=True)


if __name__ == "__main__":
    main()
