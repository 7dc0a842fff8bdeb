"""Runs `ballfg-bench estimators`: synthetic tracks by two protocols, or a dataset of measured ones."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ballfg.benchmarks.estimators.measured import HORIZON, OBSERVE, run_measured
from ballfg.benchmarks.estimators.protocols import fair_protocol, paper_protocol
from ballfg.benchmarks.estimators.synthetic_rows import run_consistency, run_protocol
from ballfg.benchmarks.gaussian_settings import StepNoise
from ballfg.benchmarks.results import Results
from ballfg.dynamics import nominal_model
from ballfg.estimation import Settings, dataset_settings
from ballfg.progress import doing
from ballfg.tracks import Dataset


@dataclass(frozen=True)
class Size:
    """The amount of computation.

    Attributes:
        compared: synthetic tracks in each protocol.  consistency: synthetic tracks whose NEES is taken.
        measured: measured tracks at most; None for all.  counts: numbers of observations on the curves.
    """

    compared: int
    consistency: int
    measured: int | None
    counts: Sequence[int]


COUNTS = (5, 6, 7, 8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 70, 80)
FULL = Size(compared=50, consistency=200, measured=None, counts=COUNTS)
QUICK = Size(compared=10, consistency=40, measured=12, counts=(5, 10, 20, 40, 80))
CONSISTENCY_SEED = 1_000_000  # Added to the seed: other tracks than those of the comparison


def run_synthetic(results: Results, out: Path, size: Size, jobs: int) -> list[Path]:
    """Both protocols and the consistency of the smoother. Returns: the pictures written."""
    from ballfg.benchmarks.estimators.pictures import observations_picture

    titles = {
        "paper": "paper's protocol: free flight, true dynamics and spin known",
        "fair": "fair protocol: bounces, declared noise, same settings for all",
    }
    protocols = [paper_protocol(size.compared, results.seed), fair_protocol(size.compared, results.seed)]
    for protocol in protocols:
        print(f"{protocol.name}: {len(protocol.tracks)} tracks; {describe_settings(protocol.settings)}")
    for protocol in protocols:
        with doing(f"{protocol.name}: {len(protocol.tracks)} tracks by all estimators"):
            run_protocol(results, protocol, jobs, size.counts)
    many = fair_protocol(size.consistency, results.seed + CONSISTENCY_SEED, name="consistency")
    with doing(f"consistency: {len(many.tracks)} tracks"):
        run_consistency(results, many, jobs)
    return [
        observations_picture(results.rows, name, title, out / f"estimators_{name}.png")
        for name, title in titles.items()
    ]


def run_dataset(results: Results, dataset: Dataset, out: Path, size: Size, jobs: int) -> list[Path]:
    """Measured tracks. Returns: the pictures written."""
    from ballfg.benchmarks.estimators.pictures import calibration_picture, growth_picture, tracks_picture

    settings = dataset_settings(dataset, nominal_model(dataset.info.ball))
    what = f"{OBSERVE:g} s observed, {HORIZON:g} s predicted, nominal model"
    print(f"{dataset.info.name}: {len(dataset)} tracks; {what}; {describe_settings(settings)}")
    measured = run_measured(results, dataset, size.measured, jobs)
    if measured.unseen:
        print(f"{measured.unseen} tracks end within the observed {OBSERVE:g} s: nothing to predict")
    if not measured.predictions["smoother"]:
        raise ValueError(
            f"{dataset.path}: no track goes on after {OBSERVE:g} s, so that nothing can be predicted. "
            "Give a dataset with longer tracks."
        )
    rows, name = results.rows, re.sub(r"[^\w-]+", "-", measured.name)
    return [
        growth_picture(rows, measured, out / f"growth_{name}.png"),
        calibration_picture(rows, measured, out / f"calibration_{name}.png"),
        tracks_picture(measured, out / f"tracks_{name}.png"),
    ]


def describe_settings(settings: Settings) -> str:
    """Noise and priors in words; of the process noise the terms that act, in SI units."""
    process = settings.process
    unused: tuple[str, ...] = () if settings.find_events else ("hit",)
    unused += ("acceleration", "contact") if isinstance(process, StepNoise) else ()
    terms = [f"{name} {value:g}" for name, value in vars(process).items() if value and not name.startswith(unused)]
    parts = [
        f"position noise {' / '.join(f'{1e3 * s:.2g}' for s in settings.position_noise)} mm",
        "process noise " + ", ".join(terms),
        f"spin label {settings.spin_label_noise:g} rad/s, spin prior {settings.spin_prior:g} rad/s",
        f"velocity prior {settings.velocity_prior:g} m/s",
        f"{settings.loss.name} loss",
    ]
    if settings.coefficients:
        parts.append("coefficients per track: " + ", ".join(settings.coefficients))
    return "; ".join(parts)
