"""The forward pass, sample by sample: the same answer as the batch, reported once, in bounded memory."""

import gc
import weakref

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation.segmentation.physics import SegmentationPhysics, physics_of
from ballfg.estimation.segmentation.result import Event, EventKind
from ballfg.estimation.segmentation.segmenter import Segmenter
from ballfg.estimation.segmentation.settings import SegmentationSettings
from tests.estimation.segmentation.whole_tracks import segment

PHYSICS = physics_of(nominal_model())
SIGMA = np.full(3, 0.0015)


def pushed(segmenter, times, positions):
    return [segmenter.push(float(t), x, SIGMA) for t, x in zip(times, positions, strict=True)]


def test_pushed_samples_give_what_the_batch_gives(rallies):
    for seed, truth in enumerate(rallies[:4]):
        positions = truth.measured(np.random.default_rng(seed))
        decisions = pushed(Segmenter(Surfaces(0.75), PHYSICS), truth.times, positions)
        events = [event for decision in decisions for event in decision.final] + list(decisions[-1].pending)
        batch = segment(truth.times, positions, SIGMA, surfaces=Surfaces(0.75), physics=PHYSICS)
        contacts = [(e.index, e.time, e.height) for e in events if e.kind is EventKind.CONTACT]
        assert contacts == [(c.interval, c.time, c.height) for c in batch.contacts]
        assert [e.index for e in events if e.kind is EventKind.HIT] == batch.hits.tolist()


def test_final_events_come_once_in_order_and_after_the_lag(rallies):
    truth = rallies[0]
    settings = SegmentationSettings(lag=40)
    segmenter = Segmenter(Surfaces(0.75), PHYSICS, settings)
    final = []
    for k, decision in enumerate(pushed(segmenter, truth.times, truth.measured(np.random.default_rng(0)))):
        assert all(event.index < k + 1 - settings.lag for event in decision.final)
        assert all(event.index >= k + 1 - settings.lag for event in decision.pending)
        final += decision.final
    assert segmenter.count == len(truth.times)
    assert len(final) >= 3
    assert len(set(map(id, final))) == len(final)
    assert [e.index for e in final] == sorted(e.index for e in final)


def test_a_shorter_lag_finds_the_same_events(rallies, match):
    truth = rallies[1]
    positions = truth.measured(np.random.default_rng(1))
    decisions = pushed(Segmenter(Surfaces(0.75), PHYSICS, SegmentationSettings(lag=12)), truth.times, positions)
    events = [event for decision in decisions for event in decision.final] + list(decisions[-1].pending)
    assert match([e.index for e in events if e.kind is EventKind.HIT], truth.hits, 2) == (0, 0)
    assert match([e.index for e in events if e.kind is EventKind.CONTACT], truth.contacts) == (0, 0)


def test_a_hit_is_known_within_six_samples(rallies):
    for seed, truth in enumerate(rallies):
        decisions = pushed(Segmenter(Surfaces(0.75), PHYSICS), truth.times, truth.measured(np.random.default_rng(seed)))
        for hit in truth.hits:
            known = [e.index for e in decisions[hit + 6].pending if e.kind is EventKind.HIT]
            assert any(abs(index - hit) <= 2 for index in known)


def test_an_endless_stream_keeps_no_old_events(make_rally):
    truth = make_rally(3, duration=1.5)
    positions = truth.measured(np.random.default_rng(0))
    positions[::29] += [0.1, 0.0, 0.2]
    segmenter = Segmenter(Surfaces(0.75), PHYSICS)
    seen: weakref.WeakSet[Event] = weakref.WeakSet()
    reported = 0
    for k in range(12):
        for decision in pushed(segmenter, truth.times + k * 1.5, positions):
            seen.update(decision.final + decision.pending)
            reported += len(decision.final)
    del decision
    gc.collect()
    assert reported > 100
    assert len(seen) < 20


def test_a_first_sample_is_the_ball_or_an_outlier_by_their_densities() -> None:
    """Far from all surfaces, where nothing rests. All hypotheses expect the sample within the spread of outliers."""
    settings, sigma = SegmentationSettings(), 0.01
    segmenter = Segmenter(Surfaces(0.0), SegmentationPhysics(), settings)
    segmenter.push(0.0, (0.0, 0.0, 5.0), (sigma,) * 3)
    scores = np.sort(segmenter._bank["score"])
    good = np.log(1.0 - settings.wide_share - settings.outlier_share)
    assert scores[-1] == pytest.approx(good - 1.5 * np.log(settings.outlier_spread**2 + sigma**2), abs=1e-9)
    stray = np.log(settings.outlier_share) - 1.5 * np.log(settings.outlier_spread**2)
    assert np.abs(scores - stray).min() < 1e-9
