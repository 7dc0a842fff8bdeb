"""The errors of radii in pictures, against planted ones, and what is made of a flight's radii."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.estimation.rally.doubtful import SHARPEST, UNKNOWN, RadiusNoise, too_large
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from tests.estimation.observations.sighted_rig import RIG, scene, track_of, world

LARGE, SCATTER, COMMON = 0.09, 0.03, 0.025


def off(rng: np.random.Generator, flights: int, wrong: float = 0.0) -> list[np.ndarray]:
    """Logarithms of measured over true radii; of wrong flights a quarter too large."""
    found = [LARGE + COMMON * rng.normal() + SCATTER * rng.normal(size=rng.integers(5, 30)) for _ in range(flights)]
    return [one + 0.25 * (rng.uniform() < wrong) for one in found]


def test_planted_errors_are_found_with_a_tenth_of_the_flights_wrong() -> None:
    noise = RadiusNoise.of(off(np.random.default_rng(0), 60, wrong=0.1))
    assert noise.large == pytest.approx(LARGE, abs=0.012)
    assert noise.scatter == pytest.approx(SCATTER, rel=0.15)
    assert noise.common == pytest.approx(COMMON, rel=0.4)


def test_few_flights_are_believed_little() -> None:
    assert RadiusNoise.of([]) == RadiusNoise(0.0, SHARPEST, UNKNOWN)
    (one,) = off(np.random.default_rng(1), 1)
    noise = RadiusNoise.of([one])
    assert noise.common == pytest.approx(UNKNOWN / np.sqrt(2.0))
    assert 0.0 < noise.large < float(np.median(one))


def test_true_radii_are_as_sure_as_they_are_right() -> None:
    """The mean of a flight's radii is off by what it states, however many there are; an unknown one stays so."""
    rng, noise, misses = np.random.default_rng(2), RadiusNoise(LARGE, SCATTER, COMMON), []
    for one in off(rng, 4000):
        stated = np.stack((5.0 * np.exp(one), np.full(len(one), 0.05)), axis=1)
        radius, sigma = noise.corrected(stated).T
        weight = sigma**-2.0
        misses.append(((weight * radius).sum() / weight.sum() - 5.0) * np.sqrt(weight.sum()))
    assert np.mean(misses) == pytest.approx(0.0, abs=0.1)
    assert np.std(misses) == pytest.approx(1.0, abs=0.1)
    some = noise.corrected(np.array([[5.0, 0.1], [0.0, 0.7]]))
    assert some[1].tolist() == [0.0, 0.7]
    assert some[0, 0] == pytest.approx(5.0 * np.exp(-LARGE))


def test_radii_agree_with_a_depth_that_is_right_and_not_with_another() -> None:
    rng, noise = np.random.default_rng(5), RadiusNoise(LARGE, SCATTER, COMMON)
    flights = off(rng, 1000)
    assert np.mean([noise.agrees(one) for one in flights]) > 0.998
    assert not any(noise.agrees(one + 0.25) or noise.agrees(one - 0.25) for one in flights)


def test_by_how_much_radii_are_too_large_is_told_by_the_depth() -> None:
    ball, camera = world(), replace(RIG[0], distortion=np.zeros(5))
    flown = scene(3, ball, phases=(0.0,), rig=(camera,))
    track = track_of(flown, cameras=(camera,))
    found = Smoother(ball.model, ball.surfaces, Settings()).estimate(track)
    depth = flown.truth[:, :3] @ camera.rotation[2] + camera.tvec[2]
    radii = np.stack((1.1 * 1000.0 * ball.model.radius / depth, np.full(len(depth), 0.1)), axis=1)
    radii[::3, 0] = 0.0
    large = too_large(track, found, radii, ball.model.radius)
    assert len(large) == np.count_nonzero(radii[:, 0])
    assert large == pytest.approx(np.log(1.1), abs=0.03)
