"""Balls that hop out: hops as low as the noise, and whether the smoother is ever sure of a wrong state there.

    python -m tests.estimation.low_bounces --count 200 --seed 11

prints for two settings how many tracks end with status OK, and how many of these are, at some sample, further from the
truth than their covariance of position and velocity allows.
"""

from __future__ import annotations

import argparse

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics import Surfaces, nominal_model
from ballfg.dynamics.motion.limits import REST_SPEED
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.state import STANDARD_GRAVITY, VZ, Z
from ballfg.tracks import Track
from tests.estimation.nees import nees
from tests.estimation.smoother.one_bounce import flown

MODEL, SURFACES = nominal_model(), Surfaces(0.0)
LYING = 0.017
"""m, height of the centre of a nominal ball that lies on the table."""
NOISE = 0.002
"""m, of a coordinate."""
SETTINGS = {
    "exact model": Settings(position_noise=(NOISE,) * 3),
    "coefficients estimated": Settings.for_measured(MODEL, position_noise=(NOISE,) * 3),
}
LIMIT = 30.0
"""Squared distance in standard deviations, of 6 components; one in 26,000 is further away by chance."""
BESIDE = 0.002
"""s. A sample this close to a bounce may be on either side of it."""


def hopping_out(count: int, seed: int, noise: float = NOISE) -> list[tuple[Array, Track]]:
    """True states (n, 9) and measured tracks of balls whose first hop is about 4 to 20 mm high; later ones are lower.

    Args: count, seed: of tracks.  noise: m, of a coordinate.
    """
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        rate = float(rng.choice((120, 150, 200)))
        times = np.arange(int(rng.uniform(0.4, 1.0) * rate)) / rate
        height = LYING + np.exp(rng.uniform(*np.log((0.004, 0.02))))
        velocity = (*rng.uniform(-1.0, 1.0, 2), rng.uniform(-0.2, 0.2))
        states = flown(np.array([0.0, 0.0, height, *velocity, *rng.normal(0.0, 20.0, 3)]), times)
        found.append((states, Track(times, states[:, :3] + rng.normal(0.0, noise, (len(times), 3)))))
    return found


def beside_bounces(states: Array) -> Array:
    """(n,) bool: which true states are within `BESIDE` of a bounce."""
    height, rise = states[:, Z] - LYING, states[:, VZ]
    speed = np.sqrt(rise**2 + 2.0 * STANDARD_GRAVITY * np.maximum(height, 0.0))
    return np.asarray((speed > REST_SPEED) & ((speed - np.abs(rise)) / STANDARD_GRAVITY < BESIDE))


def main() -> None:
    """Counts for each of `SETTINGS` the tracks that are sure of a wrong state."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=11)
    chosen = parser.parse_args()
    for name, settings in SETTINGS.items():
        smoother, fine, wrong, anywhere = Smoother(MODEL, SURFACES, settings), 0, 0, 0
        for states, track in hopping_out(chosen.count, chosen.seed):
            estimate = smoother.estimate(track)
            far = nees(estimate, states, slice(0, 6)) > LIMIT
            if estimate.status is Status.OK:
                fine, anywhere = fine + 1, anywhere + bool(far.any())
                wrong += bool((far & ~beside_bounces(states)).any())
        print(
            f"{name}: {fine} of {chosen.count} ok; NEES of position and velocity above {LIMIT:g} with status OK: "
            f"{wrong}, and {anywhere} with samples within {1e3 * BESIDE:g} ms of a bounce",
            flush=True,
        )


if __name__ == "__main__":
    main()
