"""Shots: where a track is cut, what the estimate may see of it, and why some tracks give none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces, nominal_model, rollout
from ballfg.estimation import Settings, Smoother
from ballfg.estimation.segmentation.result import Quality
from ballfg.estimation.smoother.problem import QUALITY_SIGMA, effective_sigmas
from ballfg.learning.shots import TrainingShot, part, shots_of
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
