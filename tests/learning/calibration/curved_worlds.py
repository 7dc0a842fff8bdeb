"""What a correction learns of curves in simulated worlds: drag by speed, lift that saturates, restitution by speed.

`python -m tests.learning.calibration.curved_worlds --tracks 30 --worlds 10 --seed 1` simulates worlds with curves of
random strength, fits half of twice as many tracks, and prints for the corrected model and for the one that `kind: auto`
chooses the median error of predictions (0.25 s seen, 0.3 s predicted) over that of the true dynamics, and the share of
points of the true drag and lift inside the correction's 90 % band, at the speeds and spin ratios of the judging tracks.
`--nominal` simulates worlds without curves: it prints what `auto` chooses, and what the correction gains.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics import AnalyticModel, load_model
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.bounce import RestitutionSpeed
from ballfg.dynamics.effects.flight import DragSpeed, MagnusSaturation
from ballfg.estimation.batch import estimate_tracks
from ballfg.estimation.noise.forecasts import NINETY
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.auto import CORRECTED, NOMINAL, Fitted, choose_candidate
from ballfg.learning.calibration.correction import learned
from ballfg.learning.calibration.problem import Problem, pose
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.split import tracks_of
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.simulation.motion import true_model
from ballfg.state import SPIN, VELOCITY
from ballfg.tracks import read_dataset
from tests.learning.calibration.measured_groups import errors, finished


def curves(seed: int) -> tuple[Effect, ...]:
    """Of random strength, within what is plausible."""
    rng = np.random.default_rng([seed, 44])
    drag, lift, bounce = rng.uniform(-0.1, 0.1), rng.uniform(0.5, 2.0), rng.uniform(0.0, 0.03)
    return (
        DragSpeed(slope=drag, reference=4.0),
        MagnusSaturation(strength=lift),
        RestitutionSpeed(slope=bounce, reference=3.0),
    )


def inside(model: AnalyticModel, truth: AnalyticModel, force: str, states: Array) -> float:
    """Share of the points of a true force inside its 90 % band, %, at the speeds and spin ratios of states (n, 9)."""
    speed = np.linalg.norm(states[:, VELOCITY], axis=1)
    ratio = model.radius * np.linalg.norm(states[:, SPIN], axis=1) / speed
    found, sigma = learned(model, force, speed, ratio)
    right = gain(truth, force, speed, ratio) / gain(model, force, speed, ratio) * (1.0 + found) - 1.0
    return 100.0 * float((np.abs(right - found) <= NINETY * sigma).mean())


def gain(model: AnalyticModel, force: str, speed: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """(n,) the model's drag along, or lift across, the flight, m/s^2."""
    state = torch.zeros(len(speed), 9, dtype=torch.float64)
    state[:, 3], state[:, 7] = torch.from_numpy(speed), torch.from_numpy(ratio * speed / model.radius)
    still = state.clone()
    still[:, 7] = 0.0
    with torch.no_grad():
        there, without = model.rates(state)[0].numpy(), model.rates(still)[0].numpy()
    return there[:, 0] if force == "drag" else there[:, 2] - without[:, 2]


def world(folder: Path, count: int, seed: int, effects: tuple[Effect, ...]) -> tuple[Problem, AnalyticModel]:
    """The problem of a simulated world, and its true dynamics."""
    write_simulation(folder, SimulationConfig(tracks=2 * count, rate=100.0, seed=seed, undeclared=effects))
    declared = cast(AnalyticModel, load_model(folder / "model.yaml"))
    return pose(read_dataset(folder), declared, CalibrationConfig()), true_model(declared, effects)


def compared(problem: Problem, truth: AnalyticModel, corrected: Fitted, chosen: Fitted | str) -> list[float]:
    """Median errors of the corrected and the chosen model over those of the true dynamics; drag, lift in band, %."""
    judge = list(tracks_of(problem.dataset, problem.split.judge))
    known = replace(problem, model=truth, settings=replace(problem.settings, coefficients={}))
    model, settings = finished(problem, corrected)
    best = finished(known, NOMINAL), (model, settings), finished(problem, chosen)
    right, *others = (np.nanmedian(errors(problem.surfaces, *one, judge)[:, 0]) for one in best)
    smoother = make_estimator("smoother", model, problem.surfaces, settings)
    states = np.concatenate([one.states for one in estimate_tracks(smoother, judge, len(judge), 1)])
    shares = (inside(model, truth, force, states) for force in ("drag", "lift"))
    return [*(other / right for other in others), *shares]


def main() -> None:
    """Prints a line for each world, and the means."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser()
    parser.add_argument("--tracks", type=int, default=30)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--nominal", action="store_true")
    given = parser.parse_args()
    rows = []
    for seed in range(given.seed, given.seed + given.worlds):
        with tempfile.TemporaryDirectory() as written:
            problem, truth = world(Path(written) / "w", given.tracks, seed, () if given.nominal else curves(seed))
            choice, found = choose_candidate(problem)
            gains = ", ".join(f"{one.gain:+.4f} ± {one.gain_error:.4f}" for one in choice.candidates)
            print(f"world {seed}: {choice.chosen}; gains {gains}", flush=True)
            if not given.nominal:
                rows.append(compared(problem, truth, found[CORRECTED], found.get(choice.chosen, choice.chosen)))
                print(" ".join(f"{value:.2f}" for value in rows[-1]), flush=True)
    if rows:
        print("means of: error of the corrected model and of auto's over the true dynamics', drag and lift in band, %")
        print(" ".join(f"{value:.2f}" for value in np.mean(rows, axis=0)))


if __name__ == "__main__":
    main()
