"""Tracks of one bounce without spin labels, and how often an estimate of them ends in a false minimum.

    python -m tests.estimation.smoother.one_bounce --count 500 --seed 5

prints for four settings how many estimates end above what a start from the truth finds.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.motion.rollout import rollout
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.loss import Loss
from ballfg.simulation import table_tennis
from ballfg.tracks import Track

MODEL = table_tennis().model
SURFACES = Surfaces(0.0)
SETTINGS = {
    "as they are": Settings(),
    "squared losses, spin prior of 100 rad/s": Settings(
        loss=Loss("squared"), spin_loss=Loss("squared"), spin_prior=100.0
    ),
    "noise of 0.5 mm": Settings(position_noise=(0.0005,) * 3),
    "coefficients estimated": Settings.for_measured(MODEL),
}
RATES = (60, 100, 120, 200)  # Hz
FALSE = 0.05
"""Of the objective, above that of a start from the truth."""


def one_bounce(count: int, seed: int, spin: float, noise: float) -> list[tuple[Array, Track]]:
    """True states (n, 9) and measured tracks.

    Args: count, seed: of tracks.  spin: rad/s, standard deviation per axis.  noise: m, of a coordinate.
    """
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        place, velocity = rng.uniform(0.15, 0.45), (rng.uniform(2, 8), rng.uniform(-1, 1), rng.uniform(-2.5, 1.0))
        start = np.array([0.0, 0.0, place, *velocity, *rng.normal(0.0, spin, 3)])
        rate = rng.choice(RATES)
        times = np.arange(int(rng.uniform(0.3, 0.8) * rate)) / rate
        states = flown(start, times)
        bounces = np.flatnonzero(np.diff(states[:, 5]) > 1.0)
        if len(bounces) == 0:
            continue
        end = len(times) if len(bounces) < 2 else bounces[1]
        if bounces[0] < 6 or end - bounces[0] < 6:
            continue
        found.append((states[:end], measured(states[:end], times[:end], rng, noise)))
    return found


def flown(start: Array, times: Array) -> Array:
    """(n, 9) states of the nominal model at the times."""
    with torch.no_grad():
        states = rollout(MODEL, torch.from_numpy(start)[None], torch.from_numpy(times), SURFACES)
    return np.asarray(states.numpy().reshape(len(times), 9))


def measured(states: Array, times: Array, rng: np.random.Generator, noise: float) -> Track:
    """The track of states with noise of `noise` m."""
    return Track(times, states[:, :3] + rng.normal(0.0, noise, (len(times), 3)))


def excess(truth: Array, track: Track, settings: Settings) -> float:
    """By how much the objective at the end lies above that of a start from the truth."""
    smoother = Smoother(MODEL, SURFACES, settings)
    problem = smoother.problem(track)
    solution = smoother.settle(problem)
    from_truth = smoother.optimizer.minimize(solution.graph, problem.start(truth.copy()))
    return float(solution.minimum.error - from_truth.error)


def main() -> None:
    """Counts false minima for each of `SETTINGS`."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--spin", type=float, default=80.0)
    chosen = parser.parse_args()
    for name, settings in SETTINGS.items():
        tracks = one_bounce(chosen.count, chosen.seed, chosen.spin, settings.position_noise[0])
        above = [excess(truth, track, settings) > FALSE for truth, track in tracks]
        print(
            f"{name}: {sum(above)} of {len(above)} end above the start from the truth by more than {FALSE:g}",
            flush=True,
        )


if __name__ == "__main__":
    main()
