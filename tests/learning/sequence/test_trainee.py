from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.learning.sequence.data import LauncherSettings
from ballfg.learning.sequence.predictor import SequenceArchitecture, SequenceKind, SequencePredictor
from ballfg.learning.sequence.trainee import SequenceTrainee
from ballfg.tracks import Track

LABELS = ("topspin", "sidespin", "speed")
kinds = pytest.mark.parametrize("kind", ["lstm", "diffusion"])


def trainee_of(kind: SequenceKind, tracks: list[Track], *, seed: int = 0, augment: bool = True) -> SequenceTrainee:
    return SequenceTrainee(
        tracks,
        [25] * len(tracks),
        range(8),
        architecture=SequenceArchitecture(kind, 16),
        launcher=LauncherSettings(LABELS),
        seed=seed,
        augment=augment,
    )


@kinds
def test_shards_add_up_to_the_batch(kind: SequenceKind, tracks: list[Track]) -> None:
    trainee = trainee_of(kind, tracks)
    whole = trainee.loss(range(8), epoch=2)
    shards = [trainee.loss(numbers, epoch=2) for numbers in ([5, 0, 1], [7, 6, 2, 3, 4])]
    assert whole.tracks == sum(shard.tracks for shard in shards) == 8
    assert whole.points == sum(shard.points for shard in shards) == sum(len(track) - 25 for track in tracks[:8])
    assert float(whole.total.detach()) == pytest.approx(sum(float(s.total.detach()) for s in shards), rel=1e-5)
    assert whole.squared_error == pytest.approx(sum(shard.squared_error for shard in shards), rel=1e-5)


@kinds
def test_judge_is_the_error_of_predictions(kind: SequenceKind, tracks: list[Track]) -> None:
    trainee = trainee_of(kind, tracks)
    judged = trainee.judge([8, 9])
    predictor = SequencePredictor(SequenceArchitecture(kind, 16), LauncherSettings(LABELS), trainee.module)
    squares = [
        np.square(predictor.predict(track, 25, track.times[25:]) - track.positions[25:]).sum() for track in tracks[8:10]
    ]
    assert judged.squared_error == pytest.approx(sum(squares), rel=1e-5)
    assert not judged.total.requires_grad
    assert judged.failed == ()


def test_the_lstm_s_loss_without_augmentation_is_what_is_judged(tracks: list[Track]) -> None:
    trainee = trainee_of("lstm", tracks, augment=False)
    trained, judged = trainee.loss([1, 2], epoch=4), trainee.judge([1, 2])
    assert float(trained.total.detach()) == pytest.approx(float(judged.total), rel=1e-5)
    assert trained.squared_error == pytest.approx(judged.squared_error, rel=1e-5)


@kinds
def test_the_same_seed_trains_to_the_same_bits(kind: SequenceKind, tracks: list[Track]) -> None:
    states = []
    for seed in (0, 0, 1):
        trainee = trainee_of(kind, tracks, seed=seed)
        optimizer = torch.optim.AdamW(trainee.groups()[0]["params"], lr=1e-3)
        for epoch in range(2):
            optimizer.zero_grad()
            trainee.loss(range(4), epoch).total.backward()
            optimizer.step()
        states.append(torch.cat([value.flatten() for value in trainee.module.parameters()]))
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])


@kinds
def test_augmentation_draws_anew_each_epoch(kind: SequenceKind, tracks: list[Track]) -> None:
    trainee = trainee_of(kind, tracks)
    losses = [float(trainee.loss([3], epoch).total.detach()) for epoch in (0, 1, 0)]
    assert losses[0] == losses[2] != losses[1]


def test_tracks_that_cannot_be_used_are_named(tracks: list[Track]) -> None:
    short = Track(tracks[0].times[:20], tracks[0].positions[:20], labels=tracks[0].labels, name="short")
    unlabelled = replace(tracks[1], name="unlabelled", labels={"topspin": 1.0})
    trainee = trainee_of("lstm", [*tracks[:8], short, unlabelled])
    judged = trainee.judge([8, 2, 9])
    assert judged.tracks == 1
    assert [name for name, _ in judged.failed] == ["short", "unlabelled"]
    assert "observed must lie in 2 .. 20" in judged.failed[0][1]
    assert "labels of track 'unlabelled' must be known launcher settings" in judged.failed[1][1]
    nothing = trainee.loss([8], epoch=0)
    assert (nothing.tracks, nothing.points, float(nothing.total)) == (0, 0, 0.0)
    assert not nothing.total.requires_grad


def test_a_training_part_that_cannot_be_used_is_refused(tracks: list[Track]) -> None:
    short = [
        Track(track.times[:25], track.positions[:25], labels=track.labels, name=str(i))
        for i, track in enumerate(tracks)
    ]
    with pytest.raises(ValueError, match=r"train must hold a track with observations and a rest; got none \(times of"):
        trainee_of("lstm", short)


def test_scales_come_from_the_training_part_only(tracks: list[Track]) -> None:
    far = Track(tracks[8].times, 100 * tracks[8].positions, labels=tracks[8].labels, name="far")
    a, b = trainee_of("lstm", tracks), trainee_of("lstm", [*tracks[:8], far])
    assert float(a.module.frame.horizontal) == float(b.module.frame.horizontal)
