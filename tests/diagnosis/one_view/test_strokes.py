"""Strokes filmed again: pixels against another projection, and scores that are free of the pull of their own states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.benchmarks.cameras.strokes import MODEL, SETTINGS, SURFACES
from ballfg.diagnosis.one_view.noise import SHARES, share_of, with_likeliest_noise, with_share
from ballfg.diagnosis.one_view.picture import CLOCK, LENS
from ballfg.diagnosis.one_view.strokes import Laws, all_estimated, filmed_again, scores_again
from ballfg.dynamics.motion.rollout import rollout
from ballfg.estimation.observations.sightings import sightings_of
from tests.diagnosis.one_view.filmed import CAMERA, strokes

SIZES = dict(SETTINGS.coefficients)


def laws_of(share: float = 0.0625) -> Laws:
    values = {name: float(MODEL.get_parameter(name).detach()) for name in SIZES}
    return Laws(MODEL, SURFACES, with_share(SETTINGS, share), SIZES, values)


def test_a_stroke_filmed_again_flies_by_the_laws() -> None:
    """Its pixels are those of its first state, carried by the laws at true times; its stamps are the clock's."""
    laws = laws_of()
    (stroke,) = all_estimated(laws, strokes(1, 3, noise=0.1), 1)
    other = laws.moved({CLOCK: 0.04, LENS: 0.2, "flight.drag.k": 0.2})
    again = sightings_of(filmed_again(stroke, other, (1, 2)))  # type: ignore[arg-type]
    since = stroke.track.times - stroke.track.times[0]
    with torch.no_grad():
        first = torch.from_numpy(np.array(stroke.estimate.states[:1]))
        states = rollout(other.model, first, torch.from_numpy(since), SURFACES)[0].numpy()
    pixels = other.picture.camera(CAMERA).project(states[:, :3])
    assert np.abs(again.sightings.pixels - pixels).max() < 0.5
    np.testing.assert_allclose(again.sightings.times - again.sightings.times[0], 1.04 * since, atol=1e-12)


def test_the_noise_belongs_to_the_stroke() -> None:
    laws = laws_of()
    (stroke,) = all_estimated(laws, strokes(1, 3), 1)
    one, same, other = (sightings_of(filmed_again(stroke, laws, s)).sightings.pixels for s in ((1, 0), (1, 0), (2, 0)))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.5


def test_scores_of_right_laws_are_those_of_strokes_filmed_again() -> None:
    """The pull of drag, which their own states give it, is far from zero; without it nothing is left."""
    laws = laws_of(1.0)
    found = all_estimated(laws, strokes(60, 21), 1)
    real = np.array([stroke.scores for stroke in found])
    again = np.concatenate(scores_again(laws, [(laws, 5), (laws, 6)], found, 1))
    error = real.std(axis=0) / np.sqrt(len(real)) * np.sqrt(1.5)
    assert (np.abs(real.mean(axis=0) - again.mean(axis=0)) < 3.5 * error).all()
    bias = again.mean(axis=0) / (again.std(axis=0) / np.sqrt(len(again)))
    assert np.abs(bias).max() > 4.0


def test_strokes_that_nothing_scatters_show_little_noise() -> None:
    laws = with_likeliest_noise(laws_of(1.0), strokes(8, 31), 1)
    assert share_of(laws.settings) <= 0.25
    assert share_of(replace(laws, settings=with_share(SETTINGS, SHARES[1])).settings) == pytest.approx(0.5)
