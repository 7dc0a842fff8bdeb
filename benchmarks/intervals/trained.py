"""Tests networks in other rooms: each pair of measured datasets trains a residual MNN, which predicts all others.

The noise is that of the observed parts of the judged tracks, as in `ballfg predict`; for comparison the nominal model,
judged in the same way. Nothing of the judged datasets is used but these parts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from ballfg.benchmarks.estimators.measured import OBSERVE
from ballfg.benchmarks.intervals.suite import add_judged, estimated, judge, known_surfaces, median_rmse
from ballfg.benchmarks.results import Results
from ballfg.dynamics import BallModel, load_model, nominal_model
from ballfg.estimation.configure import fitted_settings
from ballfg.estimation.track_prediction import TrackPrediction
from ballfg.learning import TrainConfig, run_training
from ballfg.progress import progress
from ballfg.tracks import Dataset, read_dataset

NOMINAL: Final = "nominal"
TRAINED: Final = "residual mnn+gs"


@dataclass(frozen=True)
class TrainedPlan:
    """Amount of training: epochs, and pairs of datasets (None for all)."""

    epochs: int
    pairs: int | None


FULL: Final = TrainedPlan(epochs=4, pairs=None)
QUICK: Final = TrainedPlan(epochs=1, pairs=1)


def run_trained(results: Results, folders: Sequence[Path], plan: TrainedPlan, jobs: int) -> None:
    """Rows of all pairs: `a + b -> c`. Raises: ValueError: fewer than three datasets, or two of one name."""
    datasets = [read_dataset(folder) for folder in folders]
    names = [dataset.info.name for dataset in datasets]
    if len(datasets) < 3 or len(set(names)) < len(names):
        raise ValueError(f"data must be three datasets or more, of names that differ; got {names}. Repeat --data.")
    nominal = [_judged(nominal_model(dataset.ball), dataset, jobs) for dataset in datasets]
    for name, judged in zip(names, nominal, strict=True):
        add_judged(results, name, NOMINAL, judged, whole=False)
    pairs = list(combinations(range(len(datasets)), 2))[: plan.pairs]
    for pair in progress(pairs, len(pairs), "pairs of datasets trained and judged"):
        with TemporaryDirectory() as folder:
            run_training(_config([folders[k] for k in pair], plan.epochs, results.seed), Path(folder) / "run")
            for k, dataset in enumerate(datasets):
                if k in pair:
                    continue
                file = Path(folder) / "run" / "model.yaml"
                model = load_model(file, radius=dataset.ball.radius, room=dataset.info.name)
                judged = _judged(model.requires_grad_(False), dataset, jobs)
                case = f"{names[pair[0]]} + {names[pair[1]]} -> {names[k]}"
                add_judged(results, case, TRAINED, judged, whole=False)
                ratio = median_rmse(judged) / median_rmse(nominal[k])
                results.add(case, TRAINED, "error_ratio", "1", ratio, len(estimated(judged)))


def _config(folders: Sequence[Path], epochs: int, seed: int) -> TrainConfig:
    return TrainConfig.model_validate(
        {
            "kind": "mnn+gs",
            "seed": seed,
            "data": [str(folder) for folder in folders],
            "architecture": {"residual": True},
            "launcher": {"labels": ["group"]},
            "observe": OBSERVE,
            "split": {"by": "alternate"},
            "loss": {"horizon": 0.3},
            "optimizer": {"epochs": epochs},
            "jobs": 1,
        }
    )


def _judged(model: BallModel, dataset: Dataset, jobs: int) -> list[TrackPrediction]:
    settings = fitted_settings(dataset, model, OBSERVE)
    return judge(model, known_surfaces(dataset), settings, list(dataset), jobs)
