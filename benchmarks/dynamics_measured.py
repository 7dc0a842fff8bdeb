"""Measured tracks as a task: learn from every second shot, observe a quarter of a second, predict what follows."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from ballfg.benchmarks.apex import measured_apexes
from ballfg.benchmarks.dynamics_task import Shot, Task
from ballfg.benchmarks.measured import HORIZON, OBSERVE
from ballfg.cli.progress import progress
from ballfg.dynamics import nominal_model
from ballfg.estimate import Estimate, Smoother, dataset_settings, dataset_surfaces, estimate_tracks
from ballfg.tracks import Dataset, Track

LEAST_OBSERVED: Final = 10
"""Samples of a quarter of a second that a shot must have: fewer do not show where it goes."""
STAMP_TOLERANCE: Final = 1e-9
"""s. A stamp this little after the end of a part belongs to it."""


def measured_task(dataset: Dataset, jobs: int, tracks: int | None = None) -> Task:
    """The shots of a dataset, the first, third, fifth ... to learn from and the others to judge by.

    A shot ends at the first hit that the smoother finds in it: what a racket does is not the ball's dynamics. Its
    bounces are those of the smoother. Tracks that end within the observed part, or begin with hardly a sample, are left
    out.

    Args:
        dataset: measured tracks.
        jobs: processes for the smoothing.
        tracks: how many of the first ones; None for all.
    Raises: ValueError: if fewer than two tracks are left.
    """
    model = nominal_model(dataset.info.ball.radius)
    given, surfaces = dataset_settings(dataset, model), dataset_surfaces(dataset)
    listed = [track for track, _ in zip(dataset, range(tracks or len(dataset)), strict=False)]
    found = estimate_tracks(Smoother(model, surfaces, given), listed, len(listed), jobs)
    smoothed = progress(found, len(listed), "tracks smoothed for their bounces")
    made = [measured_shot(track, estimate) for track, estimate in zip(listed, smoothed, strict=True)]
    shots = [shot for shot in made if shot is not None]
    if len(shots) < 2:
        raise ValueError(
            f"{dataset.path}: a comparison needs two tracks that last longer than {OBSERVE:g} s before anything hits "
            f"the ball; got {len(shots)} of {len(listed)}. Give a dataset with longer tracks."
        )
    return Task(
        case=dataset.info.name,
        info=dataset.info,
        surfaces=surfaces,
        # a learned model has no coefficients to estimate with each track: to be equal, no model has
        settings=replace(given, coefficients={}),
        launcher=None,
        launcher_labels=("group",),
        observe={"seconds": OBSERVE},
        truth=None,
        train=tuple(shots[::2]),
        validation=tuple(shots[1::2]),
    )


def measured_shot(track: Track, estimate: Estimate) -> Shot | None:
    """A measured track up to its first hit; None if nothing is left to predict.

    Args: track: as measured.  estimate: of the whole track.
    """
    last = int(estimate.hits[0]) if len(estimate.hits) else len(track) - 1
    track = track.until(float(track.times[last]))
    since = track.times - track.times[0]
    observed = int((since <= OBSERVE + STAMP_TOLERANCE).sum())
    if observed < LEAST_OBSERVED or observed >= len(track):
        return None
    end = since[observed - 1] + HORIZON + STAMP_TOLERANCE
    bounces = np.array([c.time for c in estimate.contacts if track.times[0] < c.time < track.times[-1]])
    apexes, apex_times = measured_apexes(track.times, track.positions, bounces)
    return Shot(
        track=track,
        reference=track.positions,
        observed=observed,
        judged=int((since <= end).sum()),
        bounces=bounces,
        apexes=apexes,
        apex_times=apex_times,
    )
