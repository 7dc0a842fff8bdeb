"""From shots to a sequence model with its data, and back to a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

from ballfg.learning.config.training import TrainConfig
from ballfg.learning.sequence.architecture import SequenceArchitecture, SequenceKind
from ballfg.learning.sequence.launcher import LauncherSettings
from ballfg.learning.sequence.predictor import SequencePredictor
from ballfg.learning.sequence.trainee import SequenceTrainee
from ballfg.learning.shots import Shot
from ballfg.tracks import Track

FOLDER = "model"


def build_sequence(
    config: TrainConfig, shots: Sequence[Shot], train: Sequence[int], launcher: LauncherSettings
) -> SequenceTrainee:
    """A sequence model that sees the same shots as a dynamics model would.

    Raises: ValueError: if no training shot can be used.
    """
    usable = [_usable(shot) for shot in shots]
    return SequenceTrainee(
        [track for track, _ in usable],
        [observed for _, observed in usable],
        train,
        architecture=SequenceArchitecture.of(cast(SequenceKind, config.kind)),
        launcher=launcher,
        seed=config.seed,
        augment=config.augmented,
    )


def export_sequence(trainee: SequenceTrainee, folder: Path) -> Path:
    """Write the predictor; returns its folder."""
    path = folder / FOLDER
    trainee.predictor().save(path)
    return path


def load_sequence(folder: Path) -> SequencePredictor:
    """The predictor of a training's folder."""
    return SequencePredictor.load(folder / FOLDER)


def _usable(shot: Shot) -> tuple[Track, int]:
    """The samples that measure the ball, and how many of them are observed."""
    keep, track = shot.usable, shot.track
    sigmas = None if track.sigmas is None else track.sigmas[keep]
    kept = replace(track, times=track.times[keep], positions=track.positions[keep], sigmas=sigmas)
    return kept, int(keep[: shot.observed].sum())
