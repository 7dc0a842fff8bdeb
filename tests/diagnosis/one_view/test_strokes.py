"""Strokes filmed again: pixels against another projection, and scores that are free of the pull of their own states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from ballfg.benchmarks.cameras.strokes import MODEL, SETTINGS, SURFACES
from ballfg.diagnosis.one_view.picture import CLOCK, LENS
from ballfg.diagnosis.one_view.strokes import (
    SHARES,
    Laws,
    Stroke,
    all_estimated,
    filmed_again,
    scores_again,
    share_of,
    with_likeliest_noise,
    with_share,
)
from ballfg.dynamics.motion.rollout import rollout
from ballfg.estimation.observations.sightings import sightings_of
from tests.diagnosis.one_view.filmed import CAMERA, strokes

SIZES = dict(SETTINGS.coefficients)


def laws_of(share: float = 0.0625) -> Laws:
    values = {name: float(MODEL.get_parameter(name).detach()) for name in SIZES}
    return Laws(MODEL, SURFACES, with_share(SETTINGS, share), SIZES, values)


def flown(laws: Laws, state: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n, 9) states at times (n,) s after a first one, without noise."""
    with torch.no_grad():
        given = torch.from_numpy(state[None].copy()), torch.from_numpy(np.append(0.0, times))
        return rollout(laws.model, *given, SURFACES)[0, 1:].numpy()


def slope(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """(m, 9) derivative by central differences."""
    moves = 1e-4 * np.eye(9)
    return np.stack([(function(at + move) - function(at - move)) / 2e-4 for move in moves], axis=-1)


def foretold(laws: Laws, stroke: Stroke, since: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of a stroke and their covariances (n, 2, 2), carried from sample to sample."""
    noise, found = laws.settings.for_track(stroke.track).process, stroke.estimate
    state, spread, pixels, covariances = found.states[0], found.covariances[0], [], []
    bounce = foretold_bounce(stroke)
    for begin, end in pairwise([0.0, *since]):
        step = np.array([end - begin])
        if end > begin:
            carry = slope(lambda x, step=step: flown(laws, x, step)[0], state)
            state, spread = flown(laws, state, step)[0], carry @ spread @ carry.T + noise.flight(step)[0]
            if begin < bounce <= end:
                spread = spread + noise.contact(step, np.array([bounce - begin]))[0]
        camera = laws.picture.camera(CAMERA)
        see = slope(lambda x, camera=camera: camera.project(x[None, :3])[0], state)
        pixels.append(camera.project(state[None, :3])[0])
        covariances.append(see @ spread @ see.T)
    return np.array(pixels), np.array(covariances)


def foretold_bounce(stroke: Stroke) -> float:
    """s since the first sample, of the only bounce."""
    (contact,) = stroke.estimate.contacts
    return float(contact.time - stroke.estimate.times[0])


@pytest.mark.thorough
def test_strokes_filmed_again_scatter_as_the_laws_do() -> None:
    """About the path of the estimated first state, at true times, as far as that state and the motion's noise say."""
    laws = laws_of(0.5)
    (stroke,) = all_estimated(laws, strokes(1, 3, noise=0.1), 1)
    other = laws.moved({CLOCK: 0.04, LENS: 0.2, "flight.drag.k": 0.2})
    again = [sightings_of(filmed_again(stroke, other, (1, k))).sightings for k in range(300)]  # type: ignore[arg-type]
    since = stroke.track.times - stroke.track.times[0]
    for one in again:
        np.testing.assert_allclose(one.times - one.times[0], 1.04 * since, atol=1e-12)
    drawn = np.array([one.pixels for one in again])
    pixels, spread = foretold(other, stroke, since)
    variance = np.trace(spread, axis1=1, axis2=2) + 2.0 * 0.1**2
    bounce = foretold_bounce(stroke)
    away = np.abs(since - bounce) > 0.025  # s: nearer by, a sample lies before or after the bounce
    off = np.linalg.norm(drawn.mean(axis=0) - pixels, axis=1)
    assert (off < 4.0 * np.sqrt(variance / len(again)) + 0.05 * np.sqrt(variance))[away].all()
    assert (np.abs(np.log(drawn.var(axis=0).sum(axis=1) / variance)) < 0.35)[away].all()
    assert variance[-1] > 20.0 * variance[0]


def test_the_noise_belongs_to_the_stroke() -> None:
    laws = laws_of()
    (stroke,) = all_estimated(laws, strokes(1, 3), 1)
    one, same, other = (sightings_of(filmed_again(stroke, laws, s)).sightings.pixels for s in ((1, 0), (1, 0), (2, 0)))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.5


@pytest.mark.parametrize(
    ("count", "share", "scatter"), [(30, 0.0625, False), pytest.param(60, 1.0, True, marks=pytest.mark.thorough)]
)
def test_scores_of_right_laws_are_those_of_strokes_filmed_again(count: int, share: float, scatter: bool) -> None:
    """Without the pull of drag by states nothing is left; where motion scatters as usual it is far from zero."""
    laws = laws_of(share)
    found = all_estimated(laws, strokes(count, 21, scatter=scatter), 1)
    real = np.array([stroke.scores for stroke in found])
    again = np.concatenate(scores_again(laws, [(laws, 5), (laws, 6)], found, 1))
    error = real.std(axis=0) / np.sqrt(len(real)) * np.sqrt(1.5)
    assert (np.abs(real.mean(axis=0) - again.mean(axis=0)) < 3.5 * error).all()
    bias = again.mean(axis=0) / (again.std(axis=0) / np.sqrt(len(again)))
    assert (np.abs(bias).max() > 4.0) == scatter


def test_strokes_that_nothing_scatters_show_little_noise() -> None:
    laws = with_likeliest_noise(laws_of(1.0), strokes(8, 31), 1)
    assert share_of(laws.settings) <= 0.25
    assert share_of(replace(laws, settings=with_share(SETTINGS, SHARES[1])).settings) == pytest.approx(0.5)
