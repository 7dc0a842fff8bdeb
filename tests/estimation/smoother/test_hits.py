"""Hits are found, and those that the segmentation missed are marked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.dynamics import AnalyticModel, Surfaces, nominal_model
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
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


def struck_serves(rate: float, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (n,) s, moments (count,) s of hits at any time between them, and states (count, n, 6) in vacuum."""
    rng, times = np.random.default_rng(int(rate)), np.arange(int(0.6 * rate)) / rate
    moments, fall = rng.uniform(0.2, 0.4, count), np.array([0.0, 0.0, -9.81])
    before, after = rng.normal([3.0, 0.0, 2.0], 0.3, (count, 3)), rng.normal([-4.0, 1.0, 1.0], 1.5, (count, 3))
    since = (times - moments[:, None])[..., None]
    velocities = np.where(since >= 0.0, after[:, None], before[:, None])
    return (
        times,
        moments,
        np.concatenate((since * velocities + 0.5 * since**2 * fall, velocities + since * fall), axis=2),
    )


@pytest.mark.parametrize(("rate", "sigma"), [(50.0, 0.004), (150.0, 0.002), (300.0, 0.001)])
def test_states_beside_a_hit_are_on_the_right_side_or_hold_both(rate: float, sigma: float) -> None:
    """By parabolas in closed form: the velocity jumps by 7 m/s at a moment that paths show to 0.2 ms."""
    times, moments, states = struck_serves(rate, 60)
    smoother, rng, wrong, odd = Smoother(_in_vacuum(), Surfaces.none(), _exact(sigma)), np.random.default_rng(1), 0, []
    wide = list[bool]()
    for moment, true in zip(moments.tolist(), states, strict=True):
        estimate = smoother.estimate(Track(times, true[:, :3] + sigma * rng.standard_normal((len(times), 3))))
        (hit,) = estimate.hits.tolist()
        wrong += hit != np.searchsorted(times, moment, side="right") - 1
        error, covariance = (estimate.states[:, :6] - true)[hit : hit + 2], estimate.covariances[hit : hit + 2, :6, :6]
        odd += (error[:, None] @ np.linalg.solve(covariance, error[..., None])).ravel().tolist()
        wide += (estimate.sigmas[hit : hit + 2, 3:6].max(axis=1) > 0.3).tolist()
    assert wrong <= 4  # 0.2 ms before or after a stamp cannot be told
    assert np.max(odd) < 30.0  # of 6 numbers: one in 25,000
    assert np.mean(wide) < 0.15


@pytest.mark.parametrize("samples", [1, 2])
def test_a_track_that_ends_just_after_a_hit_does_not_claim_the_flight_before(samples: int) -> None:
    """One or two samples cannot tell a hit from outliers; a track that ends before the hit is sure of its velocity."""
    times, moments, states = struck_serves(100.0, 30)
    smoother, rng, odd, sure = Smoother(_in_vacuum(), Surfaces.none(), _exact(0.002)), np.random.default_rng(2), [], []
    for moment, true in zip(moments.tolist(), states, strict=True):
        positions = true[:, :3] + 0.002 * rng.standard_normal((len(times), 3))
        hit = int(np.searchsorted(times, moment, side="right"))  # the first sample after it
        last = smoother.estimate(Track(times[: hit + samples], positions[: hit + samples]))[-1]
        off = (last.state - np.append(true[hit + samples - 1], np.zeros(3)))[3:6]
        odd.append(np.abs(off / np.sqrt(np.diag(last.joint))[3:6]).max())
        before = smoother.estimate(Track(times[:hit], positions[:hit]))[-1]
        sure.append(np.sqrt(np.diag(before.joint))[3:6].max())
    # a hit less than 2 of the 10 ms before its first sample moved the ball by less than five standard deviations
    assert np.mean(np.array(odd) > 4.0) < (0.35 if samples == 1 else 0.05)
    assert np.max(sure) < 0.3


def _in_vacuum() -> AnalyticModel:
    model = nominal_model()
    with torch.no_grad():
        for name in ("drag", "magnus"):
            model.get_parameter(f"flight.{name}.k").zero_()
    return model


def _exact(sigma: float) -> Settings:
    return Settings(position_noise=(sigma,) * 3)
