"""Compares error budgets with the measured errors of simulated sets: `python -m tests.diagnosis.budgets --sets 20`.

Each set has a world of its own (`tests.estimation.noise.intervals`): noise, memory, jitter, random motion, bounces and
coefficients drawn at random (`--world usual`: those of `Settings.for_measured`), which estimator and budget know.
Nothing but chance and nonlinearity is then left.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from ballfg.diagnosis.budget import EXPECTED, ErrorBudget
from ballfg.diagnosis.error_budget import expected_squares
from ballfg.diagnosis.fit.holdout import EvaluationTrack
from ballfg.diagnosis.search.evaluation import prediction_errors
from ballfg.estimation import Settings
from ballfg.factors.noise import ProcessNoise
from tests.estimation.noise.intervals import KIND, WORLDS, World, worlds


@dataclass(frozen=True)
class Compared:
    """Squared errors of a set, mm^2, expected and measured, and the relative standard error of the latter."""

    budget: ErrorBudget
    scatter: float

    @property
    def ratio(self) -> float:
        """Measured square over expected square."""
        return (self.budget.measured / self.budget.floor) ** 2

    def __str__(self) -> str:
        parts = " ".join(f"{name} {getattr(self.budget, name):.1f}" for name in (*EXPECTED, "left"))
        sums = f"floor {self.budget.floor:.1f}, measured {self.budget.measured:.1f} mm"
        return f"{sums}, ratio of squares {self.ratio:.2f} +- {self.scatter:.2f}; {parts}"


def settings_of(world: World) -> Settings:
    """The true noise of a world."""
    values = world.values
    process = {n: values[n] for n in ("acceleration", "contact_velocity", "contact_tangential", "contact_spin")}
    usual = Settings.for_measured(KIND.model)
    return Settings(
        position_noise=tuple(values[f"position.{a}"] for a in "xyz"),
        memory=tuple(values[f"memory.{a}"] for a in "xyz"),
        memory_time=values["memory_time"] or usual.memory_time,
        stamp_jitter=values["stamp_jitter"],
        process=ProcessNoise(**process),
        spin_prior=values.get("spin_prior", usual.spin_prior),
        spin_label_noise=values.get("spin_label", usual.spin_label_noise),
        coefficients={name: values["coefficients"] * sigma for name, sigma in usual.coefficients.items()},
    )


def compared(world: World, tracks: list[EvaluationTrack]) -> Compared:
    """The budget of a set whose model and noise are right."""
    settings = settings_of(world)
    errors = prediction_errors(KIND.model, tracks, KIND.surfaces, settings)
    found = expected_squares(KIND.model, tracks, KIND.surfaces, settings)
    assert found is not None
    budget = ErrorBudget.of(*found, errors.prediction_rmse_mm, errors.prediction_rmse_mm)
    squares = errors.by_track**2
    return Compared(budget, float(squares.std(ddof=1) / np.sqrt(len(squares)) / squares.mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--world", choices=list(WORLDS), default="drawn")
    given = parser.parse_args()
    rows = []
    for number, (world, tracks) in enumerate(worlds(given.sets, given.seed, WORLDS[given.world])):
        row = compared(world, [EvaluationTrack(track, np.empty(0)) for track in tracks])
        print(f"set {number:2}, {len(tracks)} tracks: {row}")
        rows.append(row)
    ratios, scatters = np.array([r.ratio for r in rows]), np.array([r.scatter for r in rows])
    error = ratios.std() / len(rows) ** 0.5
    print(f"ratio of squares: median {np.median(ratios):.3f}, mean {ratios.mean():.3f} +- {error:.3f}")
    print(f"{(np.abs(ratios - 1.0) < 2.0 * scatters).sum()} of {len(rows)} within two standard errors of 1", flush=True)


if __name__ == "__main__":
    main()
