"""How often an estimate notes that positions scatter more than stated, where they do and where they do not.

    python -m tests.estimation.measurement.scatter --count 100 --seed 9

prints it for simulated tracks of three noises and rates, plain, with outliers, dropped samples and an error that lasts,
and for the measured tracks with the noise that is stated or learned there.
"""

from __future__ import annotations

import argparse
import itertools

import numpy as np

from ballfg.dynamics import nominal_model
from ballfg.estimation import Settings
from ballfg.estimation.configure import fitted_settings
from ballfg.estimation.measurement.position_noise import noise_doubts
from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate
from ballfg.tracks import read_dataset
from tests.places import DATA

NOISES, RATES = (0.0005, 0.002, 0.005), (50.0, 120.0, 240.0)  # m, Hz
SORTS: tuple[dict[str, float], ...] = ({}, {"outliers": 0.05}, {"dropout": 0.2}, {"memory": 0.002, "memory_time": 0.02})
SHARES = (1.0, 1 / 2, 1 / 3)
"""Of the true noise, as stated in the settings."""
MEASURED = ("aimy", "ballgun", "robot_rallies", "spindoe")


def noted(count: int, seed: int, noise: float, rate: float, sort: dict[str, float]) -> list[float]:
    """Share of simulated tracks with a note, for each of `SHARES`; what lasts is stated for the first alone."""
    model = nominal_model()
    config = SimulationConfig(tracks=count, rate=rate, seed=seed, noise=MeasurementNoise(position=noise, **sort))
    tracks = [shot.track for shot in simulate(config)]
    found = []
    for share in SHARES:
        lasting = sort.get("memory", 0.0) if share == 1.0 else 0.0
        stated = {"position_noise": (share * noise,) * 3, "memory": (lasting,) * 3, "memory_time": 0.02}
        settings = Settings.for_measured(model, **stated)
        found.append(float(np.mean([bool(noise_doubts(track, settings)) for track in tracks])))
    return found


def main() -> None:
    """Prints the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100, help="tracks of each sort")
    parser.add_argument("--seed", type=int, default=9)
    given = parser.parse_args()
    rows = []
    for noise, rate, sort in itertools.product(NOISES, RATES, SORTS):
        rows.append(noted(given.count, given.seed, noise, rate, sort))
        print(f"{1e3 * noise:g} mm, {rate:g} Hz, {sort}: {', '.join(f'{share:.1%}' for share in rows[-1])}", flush=True)
    means = ", ".join(f"{mean:.2%}" for mean in np.mean(rows, axis=0))
    print(f"noted where the noise is stated rightly, as a half, as a third: {means}; most: {np.max(rows, 0)[0]:.0%}")
    for name in MEASURED:
        dataset = read_dataset(DATA / name)
        settings = fitted_settings(dataset, nominal_model(dataset.info.ball))
        print(f"{name}: {sum(bool(noise_doubts(track, settings)) for track in dataset)} of {len(dataset)}", flush=True)


if __name__ == "__main__":
    main()
