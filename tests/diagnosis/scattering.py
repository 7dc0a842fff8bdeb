"""How often diagnoses name an effect where tracks only differ from each other: drag, bounce, lift or wind of their own.

`python -m tests.diagnosis.scattering --sets 3 --seed 5`; not part of the test run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import ballfg as bf
from ballfg.simulation import MeasurementNoise, SimulationConfig, parse_effects, simulate
from ballfg.simulation.synthetic import dataset_info
from ballfg.tracks.dataset import Dataset, dataset_in_memory

TRACKS = 40  # Number of tracks of a set
Own = Callable[[np.ndarray], list[str]]
WORLDS: dict[str, Own] = {
    "drag": lambda g: [f"drag.k={0.12 * (1.0 + 0.12 * g[0]):.6f}"],
    "bounce": lambda g: [f"restitution.e={min(0.9 * (1.0 + 0.03 * g[1]), 0.995):.6f}"],
    "drag and bounce": lambda g: [
        f"drag.k={0.12 * (1.0 + 0.08 * g[0]):.6f}",
        f"restitution.e={min(0.93 * (1.0 + 0.04 * g[1]), 0.995):.6f}",
    ],
    "lift": lambda g: [f"magnus.k={0.0029 * (1.0 + 0.2 * g[0]):.6f}"],
    "light winds": lambda g: [f"wind.x={0.15 * g[0]:.5f}", f"wind.y={0.15 * g[1]:.5f}"],
    "winds": lambda g: [f"wind.x={0.5 * g[0]:.5f}", f"wind.y={0.5 * g[1]:.5f}"],
}


def scattered(own: Own, seed: int, tracks: int = TRACKS) -> Dataset:
    """Shots whose physics differ: 100 Hz, 2 mm, launcher settings and no spin labels."""
    rng, shots = np.random.default_rng(seed), []
    for number in range(tracks):
        config = SimulationConfig(
            tracks=1,
            seed=1000 * seed + number,
            noise=MeasurementNoise(position=0.002),
            spin_labels=False,
            undeclared=tuple(parse_effects(own(rng.standard_normal(2)))),
        )
        (shot,) = simulate(config)
        shots.append(replace(shot.track, name=f"{number:03d}"))
    return dataset_in_memory(dataset_info(config), shots)


def main() -> None:
    """Diagnoses all sets; prints the names of each and what differs, then how many sets have a name."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=3, help="of each world")
    parser.add_argument("--seed", type=int, default=5)
    chosen = parser.parse_args()
    false = []
    for world, own in WORLDS.items():
        for seed in range(chosen.seed, chosen.seed + chosen.sets):
            found = bf.diagnose(scattered(own, seed), SimulationConfig().ball.model)
            names = [finding.name for finding in found.findings]
            false.append(bool(names))
            print(f"{world}, seed {seed}: {', '.join(names) or 'no name'}. {' '.join(found.remarks)}", flush=True)
    print(f"{sum(false)} of {len(false)} sets with a false name")


if __name__ == "__main__":
    main()
