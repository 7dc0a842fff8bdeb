"""Online: iSAM2 in a window against the minimum of the same graph, events as they come, bounded memory, repairs."""

import gc

import numpy as np
import pytest
import torch

from ballfg.dynamics import nominal_model, rollout
from ballfg.estimation.online.online import Online
from ballfg.estimation.online.windows import stream_window
from ballfg.estimation.online.windows.interval import IntervalMaker
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.motion import FLIGHT, Motion
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.tracks import Track
from tests.estimation.online.streams import (
    BOUNCING,
    FLYING,
    LIVE,
    LIVE_BOUNCE,
    NOWHERE,
    SAME,
    SIGMA,
    TABLE,
    NetworkModel,
    distance,
    fed_and_counted,
    feed,
    make_track,
    settings,
)

LIVE_ROBUST = 0.5
"""And with a robust loss, whose weights are those of the last linearisation; 0.2 is what it does."""


def misses(online):
    return sum(i.bridge.misses for i in online.window.intervals if i is not None)


@pytest.mark.parametrize("solver", ["gtsam", "ballfg"])
def test_no_garbage_is_collected_within_a_push(solver, monkeypatch):
    """Though a collection is due at every object; it comes after the push, and after a refused one too."""
    online, (track, _) = Online(nominal_model(), TABLE, settings(solver=solver)), make_track(BOUNCING)
    pushing, collected, before, observe = False, [], gc.get_threshold(), online._observe

    def notice(*_):
        collected.append(pushing)

    def observed(sample):
        nonlocal pushing
        pushing = True
        state = observe(sample)
        pushing = False
        return state

    monkeypatch.setattr(online, "_observe", observed)
    gc.callbacks.append(notice)
    gc.set_threshold(1, 1, 1)
    try:
        for time, position in zip(track.times, track.positions, strict=True):
            online.push(time, position)
        with pytest.raises(ValueError, match="increase"):
            online.push(track.times[0], track.positions[0])
        assert gc.isenabled()
        gc.disable()
        online.push(track.times[-1] + 0.01, track.positions[-1])
        assert not gc.isenabled()
    finally:
        gc.enable()
        gc.set_threshold(*before)
        gc.callbacks.remove(notice)
    assert False in collected
    assert True not in collected


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


@pytest.mark.usefixtures("networks_in_torch")
def test_network_dynamics(monkeypatch):
    model = NetworkModel()
    track, truth = make_track(FLYING, model=model, surfaces=NOWHERE, n=40)
    online = Online(model, NOWHERE, settings(loss=Loss()))
    states, _, calls = fed_and_counted(online, track, monkeypatch)
    assert distance(online.window.states, Smoother(model, NOWHERE, online.settings).estimate(track)) < LIVE
    assert misses(online) == 0
    assert calls.max() == 1
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


def test_answers_are_batched_and_updates_local(monkeypatch):
    track, _ = make_track(FLYING, n=60, surfaces=NOWHERE)
    online = Online(nominal_model(), NOWHERE, settings())
    _, evaluated, calls = fed_and_counted(online, track, monkeypatch)
    assert misses(online) == 0
    assert (calls[1:] == 1).all()
    assert evaluated[1:].mean() < 6
    assert np.median(evaluated[20:]) == 1


def test_relinearisation_is_real(monkeypatch):
    """Without it the answer differs by more; with it the linearisation points have moved."""
    track, _ = make_track(FLYING, n=40, surfaces=NOWHERE)
    online = Online(nominal_model(), NOWHERE, settings(loss=Loss()))
    expected = Smoother(online.model, NOWHERE, online.settings).estimate(track)
    _, evaluated, _ = fed_and_counted(online, track, monkeypatch)
    assert evaluated.max() > 3
    good = distance(online.window.states, expected)
    for name in ("VELOCITY_THRESHOLD", "SPIN_THRESHOLD", "POSITION_THRESHOLD"):
        monkeypatch.setattr(stream_window, name, 1e9)
    frozen = Online(nominal_model(), NOWHERE, settings(loss=Loss()))
    assert fed_and_counted(frozen, track, monkeypatch)[1].max() == 1
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


def test_stamps_that_jitter_widen_positions_along_the_velocity():
    track, _ = make_track(FLYING, n=20, surfaces=NOWHERE)
    chosen = settings(stamp_jitter=2e-3, loss=Loss())
    last = feed(Online(nominal_model(), NOWHERE, chosen), track)[-1]
    expected = Smoother(nominal_model(), NOWHERE, chosen).estimate(track)
    assert np.sqrt(np.diag(last.covariance)) == pytest.approx(expected.sigmas[-1], rel=0.05)
    plain = feed(Online(nominal_model(), NOWHERE, settings(loss=Loss())), track)[-1]
    assert last.covariance[0, 0] > 4.0 * plain.covariance[0, 0]  # it flies along x


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
    with pytest.raises(ValueError, match="lag must be at least 2; got 1"):
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


def test_a_budget_limits_how_many_states_a_push_moves(monkeypatch):
    """Both solvers move the same states; a generous budget changes nothing; positions stay as good as they were."""
    track, truth = make_track(BOUNCING, n=120, dt=0.005)
    model, states, evaluated, reach = nominal_model(), {}, {}, 6
    for name, solver, budget in (("free", "ballfg", None), ("ballfg", "ballfg", 1e-3), ("gtsam", "gtsam", 1e-3)):
        online = Online(model, TABLE, settings(solver=solver), budget_ms=budget)
        online.reach = None if budget is None else reach
        states[name], counts, _ = fed_and_counted(online, track, monkeypatch)
        evaluated[name] = counts[[not state.revised for state in states[name]]]
    assert evaluated["free"].max() > 3 * reach
    assert evaluated["ballfg"].max() <= reach + 2
    assert evaluated["gtsam"].tolist() == evaluated["ballfg"].tolist()
    for one, other in zip(states["ballfg"], states["gtsam"], strict=True):
        assert np.abs((one.mean - other.mean) / np.sqrt(np.diag(one.joint))).max() < 1e-6
    off = {
        name: np.linalg.norm([s.state[:3] - x[:3] for s, x in zip(found, truth, strict=True)])
        for name, found in states.items()
    }
    assert off["ballfg"] < 1.05 * off["free"]


def test_a_budget_is_measured_on_the_machine():
    """A budget that no push meets is said, and the points of all but the newest state stay; a long one moves all."""
    track, _ = make_track(FLYING, n=30, surfaces=NOWHERE)
    chosen = settings(solver="ballfg")
    short = Online(nominal_model(), NOWHERE, chosen, budget_ms=1e-4)
    with pytest.warns(UserWarning, match="budget_ms is 0.0001, but on this machine a push"):
        short.warm_up()
    assert short.reach == 1
    long = Online(nominal_model(), NOWHERE, chosen, budget_ms=1e4)
    found, expected = feed(long, track), feed(Online(nominal_model(), NOWHERE, chosen), track)
    assert long.reach is not None
    assert long.reach > 1000
    np.testing.assert_array_equal([s.mean for s in found], [s.mean for s in expected])


@pytest.mark.parametrize("budget", [0.0, -1.0, np.nan])
def test_a_budget_is_a_positive_time(budget):
    with pytest.raises(ValueError, match="budget_ms must be positive"):
        Online(nominal_model(), TABLE, settings(), budget_ms=budget)
