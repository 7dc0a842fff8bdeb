"""Shots: where a track is cut, what the estimate may see of it, and why some tracks give none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces, nominal_model, rollout
from ballfg.estimation import Settings, Smoother
from ballfg.estimation.segmentation.result import Quality
from ballfg.estimation.smoother.problem import QUALITY_SIGMA, effective_sigmas
from ballfg.learning.augment import SHIFT, apply, augmentation, rotate, undo
from ballfg.learning.training_data import TrainingShot, part, shots_of
from ballfg.tracks import Track

TABLE = Surfaces(0.0, -0.76)
SETTINGS = Settings(position_noise=(0.002, 0.002, 0.002))
START = (0.0, 0.0, 0.3, 5.0, 0.5, 1.0, 0.0, 60.0, 20.0)


def flown(samples: int = 60, start=START, seed: int = 0, **changes) -> Track:
    times = 2.0 + 0.01 * np.arange(samples)
    state = torch.tensor([start], dtype=torch.float64)
    with torch.no_grad():
        truth = rollout(nominal_model(), state, torch.from_numpy(times - 2.0), TABLE)[0].numpy()
    noise = 0.002 * np.random.default_rng(seed).standard_normal((samples, 3))
    return replace(Track(times, truth[:, :3] + noise, name="shot"), **changes)


def hit_track() -> Track:
    """A ball that a racket sends back after 40 samples."""
    there = flown(40)
    back = flown(30, (*there.positions[-1], -6.0, 0.3, 2.0, 0.0, -40.0, 0.0), seed=1)
    times = 2.0 + 0.01 * np.arange(69)
    return Track(times, np.concatenate((there.positions, back.positions[1:])), name="hit")


def shot_of(track: Track, settings: Settings = SETTINGS, **observe) -> TrainingShot | str:
    observe = {"samples": None, "seconds": None} | observe
    ((given, shot),) = shots_of([track], nominal_model(), TABLE, settings, **observe)
    assert given is track
    return shot


def test_the_first_samples_are_observed() -> None:
    track = flown()
    shot = shot_of(track, samples=25)
    assert (shot.name, shot.observed, len(shot.track), len(shot.seen)) == ("shot", 25, 60, 25)
    np.testing.assert_array_equal(shot.seen.positions, track.positions[:25])
    assert shot.usable.all()
    assert shot.settings is SETTINGS
    assert shot.surfaces is TABLE


@pytest.mark.parametrize(("seconds", "expected"), [(0.25, 17), (0.26, 17), (0.249, 16)])
def test_or_the_first_seconds(seconds, expected) -> None:
    """A sample at the very end of them is observed."""
    shot = shot_of(replace(flown(), times=np.arange(60) / 64.0), seconds=seconds)
    assert shot.observed == expected


def test_events_are_found_in_what_is_observed_alone() -> None:
    """The bounce after 0.4 s is none of the estimate's business."""
    track = flown()
    bounce = Smoother(nominal_model(), TABLE, SETTINGS).segment(track).contacts
    assert len(bounce) == 1
    before = shot_of(track, samples=bounce[0].interval - 3)
    assert before.segmentation.contacts == ()
    after = shot_of(track, samples=bounce[0].interval + 10)
    assert [c.interval for c in after.segmentation.contacts] == [bounce[0].interval]


def test_a_hit_ends_the_shot() -> None:
    """With the last sample before it."""
    track = hit_track()
    (hit,) = Smoother(nominal_model(), TABLE, SETTINGS).segment(track).hits
    assert abs(hit - 39) <= 1
    shot = shot_of(track, samples=20)
    assert len(shot.track) == len(shot.usable) == hit + 1
    np.testing.assert_array_equal(shot.track.times, track.seconds[: hit + 1])
    whole = shot_of(track, replace(SETTINGS, find_events=False), samples=20)
    assert len(whole.track) == 69


def test_outliers_do_not_count_and_hardly_weigh() -> None:
    track = flown()
    positions = track.positions.copy()
    positions[[8, 45]] += 0.4
    shot = shot_of(replace(track, positions=positions), samples=25)
    assert np.flatnonzero(~shot.usable).tolist() == [8, 45]
    sigma = effective_sigmas(shot.seen, shot.segmentation, shot.settings)
    assert sigma.shape == (25, 3)
    np.testing.assert_allclose(np.delete(sigma, 8, axis=0), 0.002)
    np.testing.assert_allclose(sigma[8], 0.002 * QUALITY_SIGMA[Quality.OUTLIER])


def test_sigmas_of_the_track_itself() -> None:
    own = np.linspace(0.001, 0.003, 180).reshape(60, 3)
    shot = shot_of(flown(sigmas=own), samples=25)
    np.testing.assert_array_equal(effective_sigmas(shot.seen, shot.segmentation, shot.settings), own[:25])
    assert part(flown(), 7).sigmas is None
    assert len(part(flown(sigmas=own), 7).sigmas) == 7


def test_why_a_track_gives_no_shot() -> None:
    few, short = "fewer than 5 usable samples are observed", "fewer than 3 usable samples follow the observed part"
    assert shot_of(flown(), samples=4) == few
    assert shot_of(flown(), seconds=0.025) == few
    assert shot_of(flown(), samples=58).startswith(short)
    assert shot_of(flown(), samples=100).startswith(short)
    assert shot_of(hit_track(), samples=39).startswith(short)
    assert isinstance(shot_of(flown(), samples=57), TrainingShot)


def test_every_track_is_answered_for_in_order() -> None:
    tracks = [flown(), flown(10, name="short"), flown(name="third")]
    answers = list(shots_of(iter(tracks), nominal_model(), TABLE, SETTINGS, samples=20, seconds=None))
    assert [track.name for track, _ in answers] == ["shot", "short", "third"]
    assert [isinstance(shot, TrainingShot) for _, shot in answers] == [True, False, True]


def test_a_quarter_turn_takes_x_to_y_and_the_shift_comes_after() -> None:
    moved = apply(torch.tensor([1.0, 0.0, 0.5]).double(), torch.tensor(math.pi / 2), torch.tensor([0.2, 0.3]).double())
    torch.testing.assert_close(moved, torch.tensor([0.2, 1.3, 0.5]).double())


def test_height_and_distances_stay() -> None:
    positions = torch.randn(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved = apply(positions, *augmentation(3, 1, 4))
    torch.testing.assert_close(moved[:, 2], positions[:, 2], rtol=0, atol=0)
    torch.testing.assert_close(torch.cdist(moved, moved), torch.cdist(positions, positions))


def test_vectors_turn_as_differences_of_positions_do() -> None:
    a, b = torch.randn(2, 7, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    angle, shift = augmentation(0, 2, 9)
    torch.testing.assert_close(rotate(a - b, angle), apply(a, angle, shift) - apply(b, angle, shift))


def test_undo_goes_back_for_a_batch_of_tracks() -> None:
    positions = torch.randn(2, 7, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    drawn = [augmentation(0, 0, track) for track in range(2)]
    angle = torch.stack([angle for angle, _ in drawn])[:, None]
    shift = torch.stack([shift for _, shift in drawn])[:, None]
    moved = apply(positions, angle, shift)
    torch.testing.assert_close(moved[1], apply(positions[1], *drawn[1]))
    torch.testing.assert_close(undo(moved, angle, shift), positions)


def test_draws_depend_on_seed_epoch_and_track_and_on_nothing_else() -> None:
    numbers = [(seed, epoch, track) for seed in range(3) for epoch in range(3) for track in range(3)]
    angles = {float(augmentation(*each)[0]) for each in numbers}
    assert len(angles) == len(numbers)
    first, again = augmentation(1, 2, 0), augmentation(1, 2, 0)
    assert torch.equal(first[0], again[0])
    assert torch.equal(first[1], again[1])


def test_draws_are_uniform() -> None:
    drawn = [augmentation(0, epoch, track) for epoch in range(20) for track in range(50)]
    angles = torch.stack([angle for angle, _ in drawn])
    shifts = torch.stack([shift for _, shift in drawn])
    # standard error of a mean of 1000: range / sqrt(12 * 1000); four of them
    assert abs(float(angles.mean())) < 4 * 2 * math.pi / math.sqrt(12_000)
    assert shifts.mean(dim=0).abs().max() < 4 * 2 * SHIFT / math.sqrt(12_000)
    assert float(angles.std()) == pytest.approx(math.pi / math.sqrt(3), rel=0.05)
    assert shifts.abs().max() <= SHIFT
