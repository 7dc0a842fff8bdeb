"""The noise of candidates, against the likelihood that it maximises, and against planted noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from ballfg.arrays import Array
from ballfg.benchmarks.cameras.strokes import MODEL
from ballfg.estimation.noise.sightings import KNOWN, Noise, noise_of_sightings, parts
from ballfg.estimation.rally.reconstruct import FRAME_SIGMA, reconstruct
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.loss import Loss
from tests.estimation.observations.sighted_rig import NOISE as RIGS_NOISE, RIG, scene, track_of, world
from tests.estimation.rally.planted import NOISE, SURFACES, planted

COUNT, WIDE = 150, 10.0  # candidates; px, prior standard deviation of a parabola's terms


def stated_of(rng: np.random.Generator) -> Array:
    """(n, 2, 2) px^2: 0.6 px, and up to 1.8 px more along bars of any direction."""
    turn, length = rng.uniform(0.0, np.pi, COUNT), rng.uniform(0.0, 1.8, COUNT)
    unit = np.stack((np.cos(turn), np.sin(turn)), axis=1)
    return np.asarray(0.36 * np.eye(2) + (length**2)[:, None, None] * unit[:, :, None] * unit[:, None])


def test_the_parts_of_covariances_add_up_and_one_is_round() -> None:
    stated = stated_of(np.random.default_rng(0))
    around, along = parts(stated)
    np.testing.assert_allclose(around + along, stated, atol=1e-12)
    np.testing.assert_allclose(around, np.tile(0.36 * np.eye(2), (COUNT, 1, 1)), atol=1e-9)
    assert np.abs(np.linalg.det(along)).max() < 1e-9
    assert Noise(0.5, 3.0).of(stated) == pytest.approx(0.5 * around + 3.0 * along)


@pytest.mark.parametrize(
    "true",
    [
        Noise(0.05, 0.3),
        *(pytest.param(true, marks=pytest.mark.thorough) for true in (Noise(1.0, 1.0), Noise(2.0, 0.2))),
    ],
)
def test_the_factors_are_those_of_the_highest_likelihood(true: Noise) -> None:
    rng = np.random.default_rng(1)
    stated = stated_of(rng)
    time = np.linspace(-1.0, 1.0, COUNT)
    design = np.kron(np.stack([time**k for k in range(12)], axis=1), np.eye(2))  # a curve that takes over some noise
    roots = np.linalg.cholesky(true.of(stated))
    seen = design @ rng.normal(0.0, 3.0, design.shape[1]) + (roots @ rng.normal(size=(COUNT, 2, 1))).ravel()

    def block(one: Noise) -> Array:
        covariance = np.zeros((2 * COUNT, 2 * COUNT))
        for k, part in enumerate(one.of(stated)):
            covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = part
        return covariance

    def unlikely(logarithms: Array) -> float:
        covariance = block(Noise(*np.exp(logarithms).tolist())) + WIDE**2 * design @ design.T
        prior = -0.5 * KNOWN * (logarithms + np.exp(-logarithms)).sum()  # so many squares that are as stated
        return -prior - float(multivariate_normal(np.zeros(len(seen)), covariance).logpdf(seen))

    best = np.exp(minimize(unlikely, np.log([true.around, true.along]), method="Nelder-Mead").x)
    noise = Noise()
    for _ in range(60):
        weight = np.linalg.inv(block(noise))
        posterior = np.linalg.inv(design.T @ weight @ design + np.eye(design.shape[1]) / WIDE**2)
        off = (seen - design @ posterior @ design.T @ weight @ seen).reshape(COUNT, 2)
        wide = design @ posterior @ design.T
        spread = np.stack([wide[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(COUNT)])
        before, noise = noise, noise.likelier(stated, off, spread, Loss())
    assert noise.changed(before) < 1e-3
    assert (noise.around, noise.along) == pytest.approx(best, rel=0.005)


def test_the_noise_of_planted_candidates_is_found() -> None:
    _, motion, found = planted("side", 21)
    one = reconstruct(found, motion.shots[0], MODEL, SURFACES)
    rows = np.concatenate([stroke.rows for stroke in one.chosen.strokes])
    stated = np.median(found.covariances[:, 0, 0]) + FRAME_SIGMA**2
    sigma = np.sqrt(np.median(one.seen.covariances[rows, 0, 0]))
    assert sigma == pytest.approx(NOISE, rel=0.25)
    assert abs(sigma - NOISE) < 0.5 * (np.sqrt(stated) - NOISE)


def test_each_camera_has_its_own_noise() -> None:
    """Stated as 0.3 px, the left camera errs by that, the right one by twice as much, the back one by a half."""
    ball, true, tracks = world(), np.array([1.0, 2.0, 0.5]) * RIGS_NOISE, []
    for seed in range(5):
        made = scene(seed, ball)
        where = np.stack([RIG[c].project(x[:3]) for c, x in zip(made.sightings.camera, made.truth, strict=True)])
        off = (made.sightings.pixels - where) * (true / RIGS_NOISE)[made.sightings.camera][:, None]
        tracks.append(track_of(made._replace(sightings=replace(made.sightings, pixels=where + off))))
    found = noise_of_sightings(Smoother(ball.model, ball.surfaces, Settings.for_measured(ball.model)), tracks)
    assert [one.camera for one in found] == [camera.name for camera in RIG]
    for one, sigma in zip(found, true, strict=True):
        assert one.stated == pytest.approx((RIGS_NOISE, 0.0))
        assert 0.0 < one.errors[0] < 0.03
        assert abs(np.log(one.sigmas[0] / sigma)) < 3.0 * one.errors[0]
