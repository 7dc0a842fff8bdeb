"""The online estimator finds contacts, hits, outliers and gaps as samples come."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.dynamics import nominal_model, rollout
from ballfg.estimation.online.events import EventTracker, contact_step
from ballfg.estimation.online.online import Online
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.segmentation.result import Contact, Segmentation
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track
from tests.estimation.online.streams import (
    BOUNCING,
    FLYING,
    NOWHERE,
    SAME,
    SIGMA,
    TABLE,
    distance,
    feed,
    make_track,
    settings,
)


def test_contact_is_taken_as_it_comes():
    track, truth = make_track(BOUNCING, n=45)
    online = Online(nominal_model(), TABLE, settings())
    states = feed(online, track)
    (k,) = [i for i, s in enumerate(online._samples) if s.motion.heights]
    assert truth[k - 1, 5] < 0.0 < truth[k, 5]
    assert all(s.revised <= i - k + 1 for i, s in enumerate(states[k:], k))
    assert all(s.revised == 0 for s in states[k + 4 :])
    assert np.abs((states[-1].state - truth[-1]) / np.sqrt(np.diag(states[-1].covariance))).max() < 4.0


def test_contact_moves_to_where_the_estimate_puts_it():
    track, truth = make_track(BOUNCING, n=45)
    online = Online(nominal_model(), TABLE, settings())
    k = int(np.flatnonzero(truth[:, 5] > 0.5)[-1])
    feed(online, track.until(float(track.times[20])))
    right = Smoother(online.model, TABLE, online.settings).estimate(track).contacts[0].interval
    original = online.events.with_moved_contacts

    def shifted(segmentation, first):
        """The segmenter, one interval late."""
        moved = original(segmentation, first)
        late = [replace(c, interval=c.interval + 1) if not online.events._moves else c for c in moved.contacts]
        return replace(moved, contacts=tuple(c for c in late if c.interval < online.events.segmenter.count - 1))

    online.events.with_moved_contacts = shifted
    for t, z in zip(track.times[21:].tolist(), track.positions[21:], strict=True):
        online.push(t, z)
    assert k > 21
    assert [i for i, s in enumerate(online._samples) if s.motion.heights] == [right + 1]


def test_contact_step():
    falling = np.array([0, 0, 0.05, 0, 0, -3.0, 0, 0, 0])
    assert contact_step(falling, 0.02, 0.02) == 0
    assert contact_step(falling, 0.02, 0.005) == 1
    assert contact_step(falling - 0.05 * np.eye(9)[2], 0.02, 0.02) == -1
    assert contact_step(falling, 10.0, 0.02) == 0


def test_a_contact_moves_six_times_at_most():
    """A contact that flaps between intervals stays in the end; others, on the floor say, may still move."""
    events = EventTracker(TABLE, physics_of(nominal_model()), True)
    assert all(events.move(10 + k % 2, 0.0, 1 - 2 * (k % 2)) for k in range(6))
    assert not events.move(10, 0.0, 1)
    assert events.move(10, -0.76, 1)
    none, good = np.zeros(0, dtype=np.int64), np.zeros(20, dtype=np.int8)
    found = Segmentation((Contact(10, 0.1, 0.0), Contact(10, 0.1, -0.76)), none, none, (), good)
    assert [contact.interval for contact in events.with_moved_contacts(found, 0).contacts] == [10, 11]


def hit_track():
    before, _ = make_track(FLYING, n=30, surfaces=NOWHERE)
    middle = before.positions[-1]
    after, truth = make_track((*middle, -6.0, 1.0, 2.0, 0.0, -50.0, 0.0), n=31, surfaces=NOWHERE, seed=5)
    times = np.arange(60) * 0.01
    return Track(times, np.concatenate((before.positions, after.positions[1:])), name="hit"), truth[-1]


def test_hit_is_found_some_samples_late():
    track, end = hit_track()
    online = Online(nominal_model(), NOWHERE, settings())
    states = feed(online, track)
    hits = [i for i, s in enumerate(online._samples) if s.motion.hit]
    assert len(hits) == 1
    assert 29 <= hits[0] <= 31
    assert max(s.revised for s in states[30:40]) > 0
    assert np.abs((states[-1].state - end) / np.sqrt(np.diag(states[-1].covariance)))[:6].max() < 4.5
    expected = Smoother(online.model, NOWHERE, online.settings).estimate(track)
    assert distance(online.estimate(track).states, expected) < SAME


def test_without_events_a_hit_stays_unseen():
    track, _ = hit_track()
    online = Online(nominal_model(), NOWHERE, settings(find_events=False))
    feed(online, track)
    assert not any(s.motion.hit for s in online._samples)
    assert all(s.factor == 1.0 for s in online._samples)


@pytest.mark.parametrize("bad", [0, 1, 20])
def test_outlier(bad):
    clean, truth = make_track(FLYING, n=40, surfaces=NOWHERE)
    positions = clean.positions.copy()
    positions[bad] += (0.2, -0.15, 0.25)
    track = Track(clean.times, positions, name="outlier")
    online = Online(nominal_model(), NOWHERE, settings())
    states = feed(online, track)
    assert bad == 1 or online._samples[bad].factor > 10.0  # one in the second sample is left to the robust loss
    assert np.abs((states[-1].state - truth[-1]) / np.sqrt(np.diag(states[-1].covariance))).max() < 4.0
    expected = Smoother(online.model, NOWHERE, online.settings).estimate(track)
    assert distance(online.estimate(track).states, expected) < SAME


def test_label_and_dropped_frames():
    labels = {"spin_x": 0.0, "spin_y": 80.0, "spin_z": 20.0}
    full, truth = make_track(FLYING, n=60, surfaces=NOWHERE, labels=labels)
    keep = np.r_[0:15, 35:60]
    track = Track(full.times[keep], full.positions[keep], labels=labels, name="gap")
    online = Online(nominal_model(), NOWHERE, settings())
    result = online.estimate(track)
    expected = Smoother(online.model, NOWHERE, online.settings).estimate(track)
    assert distance(result.states, expected) < SAME
    assert np.abs((result.states - truth[keep]) / result.sigmas).max() < 5.0


def test_long_gap_starts_anew():
    first, _ = make_track(FLYING, n=20, surfaces=NOWHERE)
    second, truth = make_track(FLYING, n=30, surfaces=NOWHERE, seed=2)
    times = np.concatenate((first.times, second.times + 1.5))
    track = Track(times, np.concatenate((first.positions, second.positions)), name="two")
    for chosen in (settings(), Settings.for_measured(nominal_model(), position_noise=(SIGMA,) * 3)):
        online = Online(nominal_model(), NOWHERE, chosen)
        last = feed(online, track)[-1]
        assert not online._samples[20].motion.linked
        assert np.abs((last.state - truth[-1]) / np.sqrt(np.diag(last.covariance))).max() < 4.0
        expected = Smoother(online.model, NOWHERE, chosen).estimate(track)
        assert distance(online.estimate(track).states, expected) < SAME


@pytest.mark.parametrize("solver", ["gtsam", "ballfg"])
@pytest.mark.parametrize("rate", [60.0, 150.0])
def test_states_just_after_a_hit_do_not_claim_the_flight_before(solver, rate):
    """A racket turns the ball round between two samples; nothing tells of it until the second or third one."""
    model, rng, far, told = nominal_model(), np.random.default_rng(4), [], []
    dt = 1.0 / rate
    for _ in range(12):
        start = np.array([0.0, 0.2, 0.6, 4.0, rng.normal(), 1.0, 0.0, 30.0, 0.0])
        n, late = int(0.25 * rate), rng.uniform(0.2, 0.8) * dt
        before = _flown(model, start, np.append(np.arange(n) * dt, (n - 1) * dt + late))
        struck = before[-1].copy()
        struck[3:6] = -1.2 * struck[3], rng.normal(), 2.5
        after = _flown(model, struck, np.arange(1, 12) * dt - late)
        states = np.vstack((before[:-1], after))
        online = Online(model, NOWHERE, settings(solver=solver))
        for k, x in enumerate(states):
            state = online.push(k * dt, x[:3] + SIGMA * rng.standard_normal(3))
            error = np.abs(state.state - x)[3:6] / np.sqrt(np.diag(state.joint))[3:6]
            if n <= k < n + 3:
                far.append(error.max() > 4.0)
            elif k >= n + 6 or 8 < k < n:
                told.append(np.sqrt(np.diag(state.joint))[3:6].max())
    assert np.mean(far) < 0.1
    assert np.median(told) < 0.2


@pytest.mark.parametrize("rate", [30.0, 60.0])
def test_drag_and_spin_are_no_doubt_of_a_hit(rate):
    """Between two samples drag and spin bend the path of a smash by up to 28 mm: its flight foresees that."""
    model, rng, wide = nominal_model(), np.random.default_rng(5), []
    for _ in range(4):
        start = np.array([0.0, 0.0, 1.0, 25.0, rng.normal(), 2.0, 0.0, -150.0, 0.0])
        online = Online(model, NOWHERE, settings(solver="ballfg"))
        for k, x in enumerate(_flown(model, start, np.arange(20) / rate)):
            state = online.push(k / rate, x[:3] + SIGMA * rng.standard_normal(3))
            if k > 3:
                wide.append(np.sqrt(np.diag(state.joint))[3:6].max())
    assert max(wide) < 1.0


def test_an_outlier_beyond_the_reach_of_a_hit_is_none():
    """At 500 Hz no hit moves a ball by half a metre within a sample."""
    track, _ = make_track(FLYING, n=60, surfaces=NOWHERE, dt=0.002)
    online, plain = Online(nominal_model(), NOWHERE, settings()), Online(nominal_model(), NOWHERE, settings())
    for k, (t, z) in enumerate(zip(track.times.tolist(), track.positions, strict=True)):
        state, expected = online.push(t, z + 0.5 * (k == 40)), plain.push(t, z)
        if k == 40:
            ratio = np.sqrt(np.diag(state.joint) / np.diag(expected.joint))
            assert ratio[3:6].max() < 1.5


def _flown(model, start, times):
    """(n, 9) states of a ball at some times, without surfaces."""
    state = torch.from_numpy(start)[None]
    return rollout(model, state, torch.from_numpy(times), NOWHERE)[0].detach().numpy()
