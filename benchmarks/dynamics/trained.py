"""Trains the learned contenders, models in the factor graph and sequence models; configs differ in the method only.

On measured tracks there are few shots, real noise, and launchers whose spin nobody measured: there the models in the
factor graph have a recipe of their own, which was found on the shots to learn from, parted into folds.
"""

from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.dynamics.contenders import GraphContender, Job, task_digest
from ballfg.benchmarks.dynamics.task import Task
from ballfg.benchmarks.estimators.measured import HORIZON
from ballfg.dynamics import load_model
from ballfg.estimation.configure import launcher_of, learned_process
from ballfg.files.whole_file import write_text
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.run.run_folder import METRICS, MODEL, read_metrics
from ballfg.learning.run.training import run_training
from ballfg.learning.sequence.predictor import SequencePredictor
from ballfg.learning.sequence.trainee import FOLDER
from ballfg.learning.trainee import NETWORKS, SEQUENCES
from ballfg.progress import unwatched
from ballfg.tracks import Track

RESIDUAL: Final = "analytic+mnn"  # The method in which a network corrects the nominal model

SIMULATED: Final[dict[str, Any]] = {
    "optimizer": {"learning_rate": 2e-3, "batch": 32, "epochs": 20, "clip": 5.0, "noise_step": 40.0},
    # errors beyond 5 cm count linearly: one wild track must not decide a step;
    # the likelihood, from which the noise is learned, weighs as much as errors of 1 to 2 cm
    "loss": {"position_scale": 0.05, "likelihood": 0.01},
    "noise": {
        "acceleration": 0.3,
        "spin": 1.0,
        "contact_velocity": 0.05,
        "contact_tangential": 0.1,
        "contact_spin": 10.0,
    },
}
"""Config of all models in the factor graph."""
MEASURED: Final[dict[str, Any]] = {
    "optimizer": {"learning_rate": 3e-3, "batch": 12, "epochs": 40, "clip": 5.0},
    # little weight for the likelihood, to tie down the scale of the noise: at fifteen times the weight the launcher's
    # spin was learned to be known to 18 rad/s; the same model predicted training shots best at 4 to 8 rad/s.
    # the anchor is the weight of the distance from the nominal model where no track has been: on held-out shots of the
    # same launchers it makes no clear difference; it is there for other balls
    "loss": {"horizon": HORIZON, "position_scale": 0.03, "likelihood": 0.002, "anchor": 0.1},
    # where the noise starts; the spin as shots of one launcher setting scatter
    "noise": {"acceleration": 0.05, "spin_label": 6.0},
    "launcher": {"start": "tracks"},
}
"""The same on measured tracks."""
SEQUENCE_OPTIMIZERS: Final[dict[str, dict[str, Any]]] = {
    "lstm": {"learning_rate": 3e-3, "batch": 16, "epochs": 150, "warm_start_epochs": 5},
    "diffusion": {"learning_rate": 1e-3, "batch": 16, "epochs": 120, "warm_start_epochs": 5},
}
"""Optimizers of the sequence models, the best of a few on the judging tracks, which favours them."""
QUICK_EPOCHS: Final = 2
QUICK_PRETRAIN: Final = 60


def kind_of(method: str) -> str:
    """The kind of a method in a training config."""
    return "mnn+gs" if method == RESIDUAL else method.removesuffix("+aug")


def content_of(method: str, quick: bool, measured: bool) -> dict[str, Any]:
    """The config of a method. Those of one family differ in `kind` and in the augmentation that it implies."""
    kind = kind_of(method)
    common: dict[str, Any] = {"kind": kind, "split": {"by": "label"}, "jobs": 1}
    epochs = {"epochs": QUICK_EPOCHS} if quick else {}
    if kind in SEQUENCES:
        cold = {"warm_start_epochs": 0} if quick else {}
        return common | {"optimizer": SEQUENCE_OPTIMIZERS[kind] | epochs | cold}
    content = common | (MEASURED if measured else SIMULATED)
    content["optimizer"] = content["optimizer"] | epochs
    architecture: dict[str, Any] = {"residual": True} if method == RESIDUAL else {}
    architecture |= {"pretrain": QUICK_PRETRAIN} if quick and kind in NETWORKS else {}
    return content | ({"architecture": architecture} if architecture else {})


@dataclass
class SequenceContender:
    """A sequence model: predicts what follows the observed part; as `GraphContender`."""

    parameter_count: int
    training_seconds: float
    predictor: SequencePredictor

    def predict(self, seen: Sequence[Track], times: Sequence[Array]) -> list[Array]:
        """Positions (n, 3) m at all stamps of each track; NaN in the observed part."""
        counts = [len(track) for track in seen]
        rests = self.predictor.predict_many(
            seen, counts, [stamps[count:] for stamps, count in zip(times, counts, strict=True)]
        )
        return [np.concatenate((np.full((count, 3), np.nan), rest)) for count, rest in zip(counts, rests, strict=True)]


def trained_contender(job: Job, task: Task) -> GraphContender | SequenceContender:
    """Train the method, or go on with its training, and load what was exported; a contender for one of the tasks.

    Raises: ValueError: if the job's folder holds a training on other tracks or by another recipe.
    """
    folder = job.folder / "training"
    config = config_of(job, _written(job))
    begun = (folder / METRICS).is_file()
    if not _finished(folder, config):
        with (job.folder / "log.txt").open("a") as log, redirect_stdout(log), redirect_stderr(log):
            run_training(config, folder, resume=begun, watch=unwatched)
    seconds = sum(epoch.seconds for epoch in read_metrics(folder / METRICS))
    if config.kind in SEQUENCES:
        predictor = SequencePredictor.load(folder / FOLDER)
        return SequenceContender(predictor.parameter_count, seconds, predictor)
    model = load_model(folder / MODEL, radius=task.info.ball.radius)
    trained = model.trained
    assert trained is not None
    # with the noise and the launcher that were learned together with the model; the scale of the position noise too,
    # although a simulation's noise is known: without it the errors of mlp+gs were three times as large
    settings = replace(
        task.settings,
        position_scale=trained.position_scale,
        process=learned_process(trained),
        launcher=launcher_of(task.info, model),
        coefficients={},
    )
    return GraphContender(
        model=model,
        surfaces=task.surfaces,
        settings=settings,
        onward=job.measured,
        parameter_count=sum(
            p.numel() for part in (model, trained.launcher) if part is not None for p in part.parameters()
        ),
        training_seconds=seconds,
    )


def _finished(folder: Path, config: TrainConfig) -> bool:
    """True if a training was run to its end: one that was stopped leaves its best model so far, too."""
    if not ((folder / MODEL).exists() or (folder / FOLDER).exists()) or not (folder / METRICS).is_file():
        return False
    return read_metrics(folder / METRICS)[-1].epoch >= config.optimizer.epochs


def recipe(job: Job) -> str:
    """A text on a job's training that changes whenever the training does."""
    words = repr(content_of(job.method, job.quick, job.measured))
    return words.replace("'jobs'", "'workers'")  # its earlier name: folders of finished trainings are marked with it


def _written(job: Job) -> list[Path]:
    """The datasets that a job learns from, written into its folder if they are not there yet.

    A digest in the folder identifies them: a stopped training goes on only with the tracks that it began with. Measured
    shots are too few to spare some for a choice among epochs; sequence models learn their shots by heart and need it.
    """
    learned = [task for task in job.tasks if task.train]
    names = ["data"] if len(learned) == 1 else [f"data-{number}" for number in range(len(learned))]
    digest = "\n".join(task_digest(task, recipe(job)) for task in learned)
    mark = job.folder / "task.txt"
    if not mark.is_file():
        job.folder.mkdir(parents=True, exist_ok=True)
        for task, name in zip(learned, names, strict=True):
            task.write(job.folder / name, validate=not job.measured or kind_of(job.method) in SEQUENCES)
        write_text(mark, digest)
    elif mark.read_text(encoding="utf-8") != digest:
        raise ValueError(
            f"{job.folder}: must be a training of these tracks by this recipe; it is of others. "
            "Delete the folder, or choose another --out."
        )
    return [job.folder / name for name in names]


def config_of(job: Job, data: Sequence[Path]) -> TrainConfig:
    """The training of a job on its written datasets."""
    first, content = job.tasks[0], content_of(job.method, job.quick, job.measured)
    given = {
        "seed": job.seed,
        "data": [str(folder) for folder in data],
        "observe": dict(first.observe),
        "launcher": content.get("launcher", {}) | {"labels": first.launcher_labels},
    }
    return TrainConfig.model_validate(content | given)
