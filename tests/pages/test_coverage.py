"""The share of samples inside their intervals, against loops and against the normal distribution."""

from dataclasses import replace

import numpy as np
import pytest

from ballfg.pages.shot import BIN, ShownShot, coverage


def shots(count: int, stated: float, seed: int = 3) -> list[ShownShot]:
    """Shots of 60 samples whose predictions err by 0.02 m and state another number."""
    generator, made = np.random.default_rng(seed), []
    times = np.arange(60) / 100.0
    for i in range(count):
        places = generator.normal(size=(60, 3))
        later = times > 0.2
        guess = places[later] + 0.02 * generator.normal(size=(later.sum(), 3))
        sigmas = np.full(guess.shape, stated)
        made.append(
            ShownShot(str(i), times, places, predicted_times=times[later], predicted=guess, predicted_sigmas=sigmas)
        )
    return made


@pytest.mark.parametrize(("stated", "share"), [(0.02, 0.9), (0.01, 0.5892), (0.04, 0.99899)])
def test_shares_are_those_of_the_normal_distribution(stated: float, share: float) -> None:
    found = coverage(shots(400, stated))
    assert found.samples.sum() == 400 * 39
    assert found.shares.mean() == pytest.approx(share, abs=0.01)  # 46800 coordinates: 0.002 of chance


def test_bins_are_counted_from_the_last_observed_sample() -> None:
    (shot,) = shots(1, 0.02)
    found = coverage([shot])
    inside: dict[int, list[bool]] = {}
    for t, guess in zip(shot.predicted_times, shot.predicted, strict=True):
        truth = shot.positions[np.flatnonzero(shot.times == t)[0]]
        inside.setdefault(round((t - 0.2) * 100) // 5, []).append(abs(truth[1] - guess[1]) <= 1.6448536 * 0.02)
    np.testing.assert_allclose(found.horizons, [(b + 0.5) * BIN for b in inside])
    np.testing.assert_allclose(found.shares[:, 1], [np.mean(row) for row in inside.values()])
    assert (found.shots == 1).all()


def test_horizons_of_a_recording_count_from_what_each_flight_observed() -> None:
    """Two flights of one recording, the second predicted from 1.2 s on after 0.2 s that were observed."""
    (shot,) = shots(1, 0.02)
    twice = np.concatenate((shot.times, 1.0 + shot.times))
    ahead = np.concatenate((shot.predicted_times, 1.0 + shot.predicted_times))
    doubled = {name: np.tile(getattr(shot, name), (2, 1)) for name in ("positions", "predicted", "predicted_sigmas")}
    both = replace(shot, times=twice, predicted_times=ahead, flights=np.repeat([4, 7], len(shot.predicted)), **doubled)
    one, two = coverage([shot]), coverage([both])
    np.testing.assert_allclose(two.horizons, one.horizons)
    np.testing.assert_allclose(two.shares, one.shares)
    np.testing.assert_array_equal(two.samples, 2 * one.samples)


def test_a_prediction_of_unknown_width_is_not_counted() -> None:
    (shot,) = shots(1, np.inf)
    sigmas = shot.predicted_sigmas.copy()
    sigmas[::2, 1] = np.nan
    found = coverage([replace(shot, predicted_sigmas=sigmas)])
    assert found.samples.sum() == len(sigmas) // 2
    assert (found.shares == 1.0).all()


def test_infinite_intervals_hold_everything_and_no_prediction_gives_no_bins() -> None:
    assert (coverage(shots(3, np.inf)).shares == 1.0).all()
    assert coverage([ShownShot("a", np.zeros(1), np.zeros((1, 3)))]).shares.shape == (0, 3)
