"""Errors of clock, focal length and lens: derivatives against differences; that they undo what they describe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.benchmarks.cameras.strokes import MODEL, SETTINGS, SURFACES
from ballfg.diagnosis.one_view.picture import Picture, known_bounces, slopes
from ballfg.estimation import Estimate
from ballfg.estimation.observations.sightings import sighted_track, sightings_of
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.state import POSITION, VELOCITY
from ballfg.tracks import Track
from tests.diagnosis.one_view.filmed import CAMERA, NOISE, strokes

STEPS = {"clock": 1e-5, "focal": 1e-5, "lens": 1e-5}


def sighting_cost(track: Track, estimate: Estimate, errors: Picture) -> float:
    """The sightings' part of the objective at the states of an estimate, if a camera had some errors."""
    seen = sightings_of(track)
    late = (seen.sightings.times - seen.sightings.times[0])[:, None]
    states = estimate.states[seen.state]
    places = states[:, POSITION] - errors.clock * late * states[:, VELOCITY]
    off = (errors.camera(CAMERA).project(places) - seen.sightings.pixels) / NOISE
    return float(SETTINGS.sighting_loss.value(np.linalg.norm(off, axis=1)).sum())


def test_derivatives_are_differences_of_the_objective() -> None:
    """At a minimum the states' own derivatives vanish. A lens alone changes nothing else: estimates again agree."""
    smoother = Smoother(MODEL, SURFACES, SETTINGS)
    for track in strokes(3, seed=4):
        estimate = smoother.estimate(track)
        found = slopes(track, estimate, SETTINGS.sighting_loss)
        for number, (name, step) in enumerate(STEPS.items()):
            ends = [sighting_cost(track, estimate, Picture(**{name: sign * step})) for sign in (-1.0, 1.0)]
            assert found[number] == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=1e-4, abs=1e-3)
        lenses = [Picture(lens=sign * 0.01).seen_by(track, MODEL, SURFACES) for sign in (-1.0, 1.0)]
        below, above = (smoother.estimate(lens).error for lens in lenses)
        assert found[2] == pytest.approx((below - above) / 0.02, rel=0.05, abs=0.05)


def test_what_a_camera_does_wrong_is_undone() -> None:
    """Seen by a camera with the same errors, a track has the states of the same ball before a right camera."""
    errors = Picture(clock=0.05, focal=0.03, lens=-0.1)
    (right,), (wrong,) = strokes(1, 7, noise=0.1), strokes(1, 7, picture=errors, noise=0.1)
    smoother = Smoother(MODEL, SURFACES, SETTINGS)
    again = errors.seen_by(wrong, MODEL, SURFACES)
    np.testing.assert_allclose(again.times - again.times[0], right.times - right.times[0], atol=1e-9)
    states, others = smoother.estimate(right).states, smoother.estimate(again).states
    off = np.abs(states[:, :3] - others[:, :3]).max()
    assert off < 0.01
    assert np.abs(states[:, :3] - smoother.estimate(wrong).states[:, :3]).max() > 3.0 * off


def test_a_camera_with_errors_moves_pixels_as_they_say() -> None:
    place = np.array([[0.9, -0.3, 1.1]])
    before, after = CAMERA.project(place)[0], Picture(focal=0.02, lens=0.1).camera(CAMERA).project(place)[0]
    middle, focal = CAMERA.matrix[:2, 2], np.diagonal(CAMERA.matrix)[:2]
    local = CAMERA.rotation @ place[0] + CAMERA.tvec
    away = local[:2] / local[2]
    expected = middle + 1.02 * (before - middle + focal * away * 0.1 * (away**2).sum())
    np.testing.assert_allclose(after, expected, atol=1e-6)


def test_known_bounces_are_kept_on_the_clock() -> None:
    (track,) = strokes(1, 9)
    assert known_bounces(sightings_of(track), 1.0) is None
    seen = sightings_of(track)
    bounce = seen.sightings.times[0] + 0.3
    given = sighted_track(
        "a", replace(seen.sightings), [CAMERA], model=MODEL, surfaces=SURFACES, bounces=np.array([bounce])
    )
    np.testing.assert_allclose(known_bounces(sightings_of(given), 1.1), [seen.sightings.times[0] + 0.33], atol=1e-9)
