"""Makes tasks of measured tracks: learn from every second shot, observe a quarter of a second, predict the rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Final

import numpy as np

from ballfg.benchmarks.dynamics.task import Task, TaskShot
from ballfg.benchmarks.estimators.measured import HORIZON, OBSERVE
from ballfg.dynamics import nominal_model
from ballfg.estimation import Estimate, Smoother, dataset_settings, dataset_surfaces
from ballfg.estimation.batch import estimate_tracks
from ballfg.prediction.apexes import measured_apexes
from ballfg.progress import progress
from ballfg.tracks import Dataset, Track
from ballfg.tracks.stamps import STAMP_TOLERANCE

LEAST_OBSERVED: Final = 10  # Samples of a quarter of a second that a shot must have: fewer do not show where it goes

GROUP: Final = "group"
"""The label of a launcher and its setting. Tracks without it are one group of their dataset's name."""


@dataclass(frozen=True)
class Measured:
    """Measured tracks."""

    datasets: Sequence[Dataset]  # one model learns from all of them; it is judged on each
    transfer: Dataset | None = None  # the models are judged on it, but learn nothing from it; None for none
    transfer_tracks: int | None = None  # how many of its first tracks; None for all


def measured_tasks(data: Measured, jobs: int, most: int | None) -> list[Task]:
    """A task for each dataset, of at most so many of its first tracks (None: all)."""
    every = [*data.datasets, *([] if data.transfer is None else [data.transfer])]
    names, radii = [d.info.name for d in every], {d.info.ball.radius for d in every}
    if len(set(names)) < len(names):
        raise ValueError(f"datasets must have names that differ; got {', '.join(names)}. Rename one in dataset.yaml.")
    if len(radii) > 1:
        raise ValueError(f"datasets must be of one kind of ball; got radii {sorted(radii)} m. Compare them apart.")
    tasks = [measured_task(dataset, jobs, most) for dataset in data.datasets]
    if data.transfer is not None:
        limits = [limit for limit in (data.transfer_tracks, most) if limit is not None]
        tasks.append(measured_task(data.transfer, jobs, min(limits, default=None), learn=False))
    return tasks


def measured_task(dataset: Dataset, jobs: int, tracks: int | None = None, *, learn: bool = True) -> Task:
    """The shots of a dataset, the first, third, fifth ... to learn from and the others to judge by.

    A shot ends at the first hit that the smoother finds in it: what a racket does is not the ball's dynamics. Its
    bounces are those of the smoother. Tracks that end within the observed part, or begin with hardly a sample, are left
    out.

    Args: tracks: how many of the first ones; None for all.  learn: False: all shots are to judge by.
    """
    model = nominal_model(dataset.info.ball)
    given, surfaces = dataset_settings(dataset, model), dataset_surfaces(dataset)
    listed = list(islice(dataset, tracks))
    found = estimate_tracks(Smoother(model, surfaces, given), listed, len(listed), jobs)
    smoothed = progress(found, len(listed), "tracks smoothed for their bounces")
    grouped = [replace(t, labels={**t.labels, GROUP: t.labels.get(GROUP, dataset.info.name)}) for t in listed]
    made = [measured_shot(track, estimate) for track, estimate in zip(grouped, smoothed, strict=True)]
    shots = tuple(shot for shot in made if shot is not None)
    least = 2 if learn else 1
    if len(shots) < least:
        raise ValueError(
            f"{dataset.path}: a comparison needs {least} tracks that last longer than {OBSERVE:g} s before anything "
            f"hits the ball; got {len(shots)} of {len(listed)}. Give a dataset with longer tracks."
        )
    return Task(
        case=dataset.info.name,
        info=dataset.info,
        surfaces=surfaces,
        # a learned model has no coefficients to estimate with each track: to be equal, no model has
        settings=replace(given, coefficients={}),
        launcher=None,
        launcher_labels=(GROUP,),
        observe={"seconds": OBSERVE},
        truth=None,
        train=shots[::2] if learn else (),
        validation=shots[1::2] if learn else shots,
    )


def measured_shot(track: Track, estimate: Estimate) -> TaskShot | None:
    """A measured track up to the first hit that its estimate has; None if nothing is left to predict."""
    last = int(estimate.hits[0]) if len(estimate.hits) else len(track) - 1
    track = track.until(float(track.times[last]))
    since = track.seconds
    observed = int((since <= OBSERVE + STAMP_TOLERANCE).sum())
    if observed < LEAST_OBSERVED or observed >= len(track):
        return None
    end = since[observed - 1] + HORIZON + STAMP_TOLERANCE
    bounces = np.array([c.time for c in estimate.contacts if track.times[0] < c.time < track.times[-1]])
    apexes, apex_times = measured_apexes(track.times, track.positions, bounces)
    return TaskShot(
        track=track,
        reference=track.positions,
        observed=observed,
        judged=int((since <= end).sum()),
        bounces=bounces,
        apexes=apexes,
        apex_times=apex_times,
    )
