"""Hits are found, and those that the segmentation missed are marked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import Surfaces
from ballfg.estimation.result import Status
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track
from tests.estimation.smoother.serve import (
    EXACT,
    MODEL,
    SERVE,
    TABLE,
    TIMES,
    bounces,
    estimate_of,
    honest,
    measured,
    truth,
)

KICKS = {"racket": (-8.0, 1.0, 0.5), "touch": (0.7, -0.4, 0.5)}


def hit_serve(kick: tuple[float, float, float]) -> np.ndarray:
    """The serve, hit at sample 20."""
    before = truth(SERVE, TIMES[:21])
    start = before[-1].copy()
    start[3:6] += kick
    return np.concatenate((before, truth(start.tolist(), TIMES[20:])[1:]))


@pytest.mark.parametrize("kick", KICKS)
def test_a_hit_is_found(kick, settings) -> None:
    states = hit_serve(KICKS[kick])
    estimate = estimate_of(states, measured(states), settings)
    assert estimate.status is Status.OK
    assert estimate.hits.tolist() == [20]
    assert len(estimate.contacts) == len(bounces(states))
    states[20, 3:9] = estimate.states[20, 3:9]  # at the very stamp of the hit it may be before or after
    honest(estimate, states)


def test_a_hit_that_the_segmentation_missed_is_marked(settings) -> None:
    """Its dynamics factor is broken by far more than chance; solve() marks it and estimates again.

    A touch of 1 m/s would not break it: process noise of several intervals makes room for that.
    """
    states = hit_serve(KICKS["racket"])
    track = Track(TIMES, measured(states), name="t")
    smoother = Smoother(MODEL, TABLE, settings)
    blind = replace(smoother.segment(track), hits=np.zeros(0, dtype=np.int64))
    solution = smoother.settle(smoother.problem(track, blind))
    hits = solution.events.segmentation.hits
    assert len(hits) == 1
    assert 19 <= hits[0] <= 21
    unhurt = np.r_[0:18, 24:80]
    off = np.abs(solution.minimum.values.states - states)[unhurt] / smoother.estimate(track).sigmas[unhurt]
    assert off[:, :6].max() < 4.5


def test_a_known_hit_that_is_harder_than_stated_does_not_hide_another() -> None:
    """The first breaks its own factor more than the second does, which alone is still to be found."""
    nowhere = Surfaces(-20.0)
    first = truth(SERVE, TIMES[:21], nowhere)
    second = truth([*first[-1, :3], -8.0, 1.0, 3.0, *first[-1, 6:]], TIMES[20:51], nowhere)
    third = truth([*second[-1, :3], -4.0, -1.0, 3.0, *second[-1, 6:]], TIMES[50:], nowhere)
    states = np.concatenate((first, second[1:], third[1:]))
    weak = replace(EXACT, process=replace(EXACT.process, hit_velocity=0.3))
    track = Track(TIMES, measured(states), name="t")
    smoother = Smoother(MODEL, nowhere, weak)
    one = replace(smoother.segment(track), hits=np.array([20]))
    hits = smoother.settle(smoother.problem(track, one)).events.segmentation.hits
    assert hits[0] == 20
    assert len(hits) == 2
    assert 49 <= hits[1] <= 51
