"""Online: iSAM2 in a window against the minimum of the same graph, events as they come, bounded memory, repairs."""

import gc
from dataclasses import replace

import gtsam
import numpy as np
import pytest
import torch
from torch import nn

from ballfg.dynamics import BallModel, Surfaces, nominal_model, rollout
from ballfg.estimation.online.events import EventTracker, contact_step
from ballfg.estimation.online.online import Online
from ballfg.estimation.online.windows import stream_window
from ballfg.estimation.online.windows.interval import IntervalMaker
from ballfg.estimation.result import Status
from ballfg.estimation.segmentation import Contact, Segmentation, physics_of
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.motion import FLIGHT, Motion
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.bridge import STATE_KEY, Bridge
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.tracks import Track

SIGMA = 0.002
TABLE = Surfaces(0.0, -0.76)
NOWHERE = Surfaces(-20.0)
FLYING = (0.0, 0.0, 0.4, 5.0, 0.5, 2.0, 0.0, 80.0, 20.0)
BOUNCING = (0.0, 0.0, 0.3, 5.0, 0.5, 0.5, 0.0, 10.0, 20.0)

SAME = 1e-4
"""Posterior standard deviations: how far `estimate` may lie from the smoother; 1e-6 is what it does."""
LIVE = 0.05
"""The same for the running answer in flight with a squared loss; 0.01 is what it does."""
LIVE_BOUNCE = 0.3
"""And after a bounce, whose friction has a kink between sliding and rolling; up to 0.17 was seen."""
LIVE_ROBUST = 0.5
"""And with a robust loss, whose weights are those of the last linearisation; 0.2 is what it does."""


class NetworkModel(BallModel):
    """The nominal ball plus a 9-80-80-3 tanh network with small weights."""

    def __init__(self):
        super().__init__(0.02)
        torch.manual_seed(3)
        self.ball = nominal_model()
        self.net = nn.Sequential(nn.Linear(9, 80), nn.Tanh(), nn.Linear(80, 80), nn.Tanh(), nn.Linear(80, 3)).double()

    def rates(self, state):
        velocity, spin = state[..., 3:6], state[..., 6:9]
        features = torch.cat((velocity / 5, spin / 100, torch.linalg.cross(spin, velocity) / 500), dim=-1)
        return self.ball.rates(state)[0] + 0.5 * self.net(features), None

    def after_bounce(self, state):
        return self.ball.after_bounce(state)


def make_track(start, n=50, *, model=None, surfaces=TABLE, seed=0, dt=0.01, labels=None):
    times = np.arange(n) * dt
    state = torch.tensor([start], dtype=torch.float64)
    truth = rollout(model or nominal_model(), state, torch.from_numpy(times), surfaces)[0].detach().numpy()
    noise = SIGMA * np.random.default_rng(seed).standard_normal((n, 3))
    return Track(times, truth[:, :3] + noise, labels=labels or {}, name="shot"), truth


def settings(**changes):
    return Settings(position_noise=(SIGMA,) * 3, **changes)


def feed(online, track):
    return [online.push(t, z) for t, z in zip(track.times.tolist(), track.positions, strict=True)]


def distance(states, estimate):
    """Largest difference in posterior standard deviations."""
    return np.abs((states - estimate.states) / estimate.sigmas).max()


def misses(online):
    return sum(i.bridge.misses for i in online.window.intervals if i is not None)


@pytest.mark.parametrize("start", [FLYING, BOUNCING])
@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("coefficients", [False, True])
def test_same_answer_as_the_smoother(start, robust, coefficients):
    model = nominal_model()
    track, _ = make_track(start)
    loss = Loss("cauchy", 3.0) if robust else Loss()
    chosen = (
        Settings.for_measured(model, position_noise=(SIGMA,) * 3, loss=loss) if coefficients else settings(loss=loss)
    )
    expected = Smoother(model, TABLE, chosen).estimate(track)
    online = Online(model, TABLE, chosen)
    last = feed(online, track)[-1]
    assert len(expected.contacts) == (start is BOUNCING)
    bounce = start is BOUNCING
    assert distance(online.window.states, expected) < (LIVE_ROBUST if robust else LIVE_BOUNCE if bounce else LIVE)
    rel = 0.4 if bounce else 0.15 if robust else 0.01  # the kink again: the spin's sigma differs on its two sides
    assert np.sqrt(np.diag(last.covariance)) == pytest.approx(expected.sigmas[-1], rel=rel)
    result = online.estimate(track)
    assert distance(result.states, expected) < SAME
    assert result.sigmas == pytest.approx(expected.sigmas, rel=1e-4)
    assert result.coefficients == pytest.approx(expected.coefficients, abs=1e-7)
    assert [c.interval for c in result.contacts] == [c.interval for c in expected.contacts]
    assert result.status is Status.OK


def test_network_dynamics():
    model = NetworkModel()
    track, truth = make_track(FLYING, model=model, surfaces=NOWHERE, n=40)
    online = Online(model, NOWHERE, settings(loss=Loss()))
    states = feed(online, track)
    assert distance(online.window.states, Smoother(model, NOWHERE, online.settings).estimate(track)) < LIVE
    assert misses(online) == 0
    assert max(s.calls for s in states) == 1
    error = (states[-1].state - truth[-1]) / np.sqrt(np.diag(states[-1].covariance))
    assert np.abs(error).max() < 4.0


@pytest.mark.parametrize("dt", [1e-4, 0.01, 0.3])
def test_the_quick_interval_has_the_noise_of_free_flight(dt):
    """By its closed form, q^2 [[dt^3/3, dt^2/2], [dt^2/2, dt]], which it does not compute from."""
    noise = ProcessNoise(acceleration=0.7, spin=3.0)
    made = IntervalMaker(nominal_model(), noise).make(4, FLIGHT, dt)
    expected = np.zeros((9, 9))
    expected[:3, :3], expected[3:6, 3:6] = 0.49 * dt**3 / 3 * np.eye(3), 0.49 * dt * np.eye(3)
    expected[:3, 3:6] = expected[3:6, :3] = 0.49 * dt**2 / 2 * np.eye(3)
    expected[6:, 6:] = 9.0 * dt * np.eye(3)
    np.testing.assert_allclose(made.covariance, expected, rtol=1e-12)
    root = made.batch.whitening[0]
    np.testing.assert_allclose(root @ expected @ root.T, np.eye(9), atol=1e-9)


def test_answers_are_batched_and_updates_local():
    track, _ = make_track(FLYING, n=60, surfaces=NOWHERE)
    online = Online(nominal_model(), NOWHERE, settings())
    states = feed(online, track)
    assert misses(online) == 0
    assert all(s.calls == 1 for s in states[1:])
    assert np.mean([s.evaluated for s in states[1:]]) < 6
    assert np.median([s.evaluated for s in states[20:]]) == 1


def test_relinearisation_is_real(monkeypatch):
    """Without it the answer differs by more; with it the linearisation points have moved."""
    track, _ = make_track(FLYING, n=40, surfaces=NOWHERE)
    online = Online(nominal_model(), NOWHERE, settings(loss=Loss()))
    expected = Smoother(online.model, NOWHERE, online.settings).estimate(track)
    states = feed(online, track)
    assert max(s.evaluated for s in states) > 3
    good = distance(online.window.states, expected)
    for name in ("VELOCITY_THRESHOLD", "SPIN_THRESHOLD", "POSITION_THRESHOLD"):
        monkeypatch.setattr(stream_window, name, 1e9)
    frozen = Online(nominal_model(), NOWHERE, settings(loss=Loss()))
    assert max(s.evaluated for s in feed(frozen, track)) == 1
    assert distance(frozen.window.states, expected) > 10 * good


def test_innovations_are_standard_normal():
    values = []
    for seed in range(3):
        track, _ = make_track(FLYING, n=40, surfaces=NOWHERE, seed=seed)
        online = Online(nominal_model(), NOWHERE, settings(process=Settings().process, loss=Loss()))
        values += [s.innovation for s in feed(online, track)[6:]]
    values = np.array(values)
    assert np.isfinite(values).all()
    assert values.var() == pytest.approx(1.0, abs=0.2)  # 306 numbers: 0.08 is one standard deviation


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
    original = online.events.moved

    def shifted(segmentation, first):
        """The segmenter, one interval late."""
        moved = original(segmentation, first)
        late = [replace(c, interval=c.interval + 1) if not online.events._moves else c for c in moved.contacts]
        return replace(moved, contacts=tuple(c for c in late if c.interval < online.events.segmenter.count - 1))

    online.events.moved = shifted
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
    assert [contact.interval for contact in events.moved(found, 0).contacts] == [10, 11]


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


@pytest.mark.parametrize("start", [FLYING, BOUNCING])
@pytest.mark.parametrize("coefficients", [False, True])
def test_a_cut_window_forgets_nothing_that_matters(start, coefficients):
    model = nominal_model()
    chosen = (
        Settings.for_measured(model, position_noise=(SIGMA,) * 3, loss=Loss())
        if coefficients
        else settings(loss=Loss())
    )
    surfaces, allowed = (NOWHERE, LIVE) if start is FLYING else (TABLE, LIVE_BOUNCE)
    track, _ = make_track(start, n=70, surfaces=surfaces)
    expected = Smoother(model, surfaces, chosen).estimate(track)
    online = Online(model, surfaces, chosen, lag=20)
    feed(online, track)
    assert online.window.first >= 40
    late = online.window.first
    off = (online.window.states - expected.states[late:]) / expected.sigmas[late:]
    assert np.abs(off[-1]).max() < allowed
    result = online.estimate(track)
    assert result.states.shape == (70, 9)
    assert np.abs((result.states[-1] - expected.states[-1]) / expected.sigmas[-1]).max() < allowed
    assert result.sigmas[-1] == pytest.approx(expected.sigmas[-1], rel=0.01 if start is FLYING else 0.2)
    assert len(result.contacts) == len(expected.contacts)
    assert [c.interval for c in result.contacts] == [c.interval for c in expected.contacts]
    assert len(result.quality) == 70


def count_objects():
    """Bridges alive, and all objects."""
    gc.collect()
    objects = gc.get_objects()
    return sum(type(o) is Bridge for o in objects), len(objects)


def test_memory_is_flat_on_an_endless_stream():
    """Shot after shot, half of them after a gap that restarts: nothing grows once the window is full."""
    track, _ = make_track(FLYING, n=30, surfaces=NOWHERE)
    online = Online(
        nominal_model(), NOWHERE, Settings.for_measured(nominal_model(), position_noise=(SIGMA,) * 3), lag=15
    )
    sizes, clock = [], 0.0
    for shot in range(12):
        for t, z in zip(track.times, track.positions, strict=True):
            assert not online.push(clock + float(t), z).rebuilt
            assert len(online.window) <= 30
        clock += 0.4 + (0.05 if shot % 2 else 1.0)
        sizes.append(count_objects())
    bridges, counts = np.array(sizes[3:]).T
    assert bridges.max() < 4 * 30
    assert counts[5:].max() < counts[:5].max() * 1.02
    assert online.window.isam.getFactorsUnsafe().size() < 4 * 30
    assert online.window.isam.size() < 2 * 30


def test_rebuilds_after_gtsam_failed():
    """An update that throws leaves iSAM2 half-updated: the same keys cannot be added again."""
    track, _ = make_track(FLYING, n=40, surfaces=NOWHERE)
    online, undisturbed = (Online(nominal_model(), NOWHERE, settings(loss=Loss())) for _ in range(2))
    feed(undisturbed, track)
    for k, (t, z) in enumerate(zip(track.times.tolist(), track.positions, strict=True)):
        if k == 25:
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            loose = gtsam.noiseModel.Isotropic.Sigma(1, 1.0)
            graph.push_back(gtsam.CustomFactor(loose, [STATE_KEY + 25], _one_row))
            values.insert(STATE_KEY + 25, np.zeros(9))
            with pytest.raises(RuntimeError, match="Indetermin"):
                online.window.isam.update(graph, values)
        state = online.push(t, z)
        assert state.rebuilt == (k == 25)
        assert state.status is (Status.OK if k else Status.NO_VELOCITY)
    assert len(online.window) == 40
    assert online.window.states[-1] == pytest.approx(undisturbed.window.states[-1], abs=1e-3)


def _one_row(_, values, jacobians):
    if jacobians is not None:
        jacobians[0] = np.eye(1, 9)
    return np.zeros(1)


def test_rebuilds_after_cut_and_failure():
    track, _ = make_track(BOUNCING, n=60)
    model = nominal_model()
    chosen = Settings.for_measured(model, position_noise=(SIGMA,) * 3)
    online = Online(model, TABLE, chosen, lag=15)
    feed(online, track)
    before = online.window.states.copy()
    sigma = np.sqrt(np.diag(online.window.newest_covariance))[:9]
    online.window.start_anew(online._samples)
    assert np.abs((online.window.states[-1] - before[-1]) / sigma).max() < 0.1


class Broken(NetworkModel):
    """A model that gives nonsense from some speed on."""

    limit = np.inf

    def rates(self, state):
        acceleration, spin = super().rates(state)
        return acceleration * torch.nan if bool((state[..., 3].abs() > self.limit).any()) else acceleration, spin


@pytest.mark.filterwarnings("ignore:Broken runs in torch")
def test_a_window_that_cannot_be_solved_says_so():
    track, _ = make_track(FLYING, n=20, surfaces=NOWHERE)
    model = Broken()
    online = Online(model, NOWHERE, settings())
    states = feed(online, track.until(0.1))
    model.limit = 1.0
    state = online.push(0.11, track.positions[11])
    assert states[-1].status is Status.OK
    assert state.rebuilt
    assert state.status is Status.FAILED
    assert state.state[:3] == pytest.approx(track.positions[11])
    assert len(online.window) == 1
    model.limit = np.inf
    assert online.push(0.12, track.positions[12]).status is Status.OK


def test_few_samples():
    track, _ = make_track(FLYING, n=5, surfaces=NOWHERE)
    model = nominal_model()
    for n in (1, 2, 3, 5):
        part = Track(track.times[:n], track.positions[:n], name="few")
        result = Online(model, NOWHERE, settings()).estimate(part)
        expected = Smoother(model, NOWHERE, settings()).estimate(part)
        assert result.status is expected.status
        assert result.states.shape == (n, 9)
        assert distance(result.states, expected) < SAME


@pytest.mark.parametrize(
    ("time", "position", "sigma", "message"),
    [
        (0.0, (0, 0, 0), None, "time must"),
        (np.nan, (0, 0, 0), None, "time must"),
        (1.0, (0, np.nan, 0), None, "position must"),
        (1.0, (0, 0), None, "position must"),
        (1.0, (0, 0, 0), (0.1, np.inf, 0.1), "sigma must"),
        (1.0, (0, 0, 0), (0.1, 0.0, 0.1), "sigma must"),
    ],
)
def test_bad_input_is_refused_and_changes_nothing(time, position, sigma, message):
    online = Online(nominal_model(), NOWHERE, settings())
    online.push(0.0, (0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match=message):
        online.push(time, position, sigma)
    assert online.push(0.01, (0.05, 0.0, 1.0)).status is Status.OK
    assert len(online.window) == 2


def test_lag_must_leave_something():
    with pytest.raises(ValueError, match="lag must be at least 2 states; got 1"):
        Online(nominal_model(), NOWHERE, settings(), lag=1)


def test_same_motion_at_another_moment_is_the_same():
    assert Motion((0.0,), (0.001,)).same(Motion((0.0,), (0.002,)))
    assert not Motion((0.0,), (0.001,)).same(FLIGHT)


def test_a_warm_up_leaves_the_stream_alone() -> None:
    """Before its first sample, and in the middle of it: the states are those of an estimator that was never warmed."""
    times = 0.01 * np.arange(30)
    with torch.no_grad():
        start = torch.tensor([BOUNCING], dtype=torch.float64)
        track = rollout(nominal_model(), start, torch.from_numpy(times), TABLE)
    positions = track[0, :, :3].numpy() + SIGMA * np.random.default_rng(0).standard_normal((30, 3))
    cold, warm = (Online(nominal_model(), TABLE, Settings(position_noise=(SIGMA,) * 3)) for _ in range(2))
    warm.warm_up()
    assert warm.window is None
    for k, (time, position) in enumerate(zip(times.tolist(), positions, strict=True)):
        if k == 20:
            warm.warm_up()
        expected, given = cold.push(time, position), warm.push(time, position)
        np.testing.assert_array_equal(given.mean, expected.mean)
        np.testing.assert_array_equal(given.joint, expected.joint)
