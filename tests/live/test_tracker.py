"""The tracker: balls are begun, kept apart and dropped; late stamps find their place; what is wrong does no harm."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ballfg.estimation import Online
from ballfg.live import BallUpdate, Tracker
from ballfg.simulation import SimulationConfig, simulate
from tests.live.shots import RATE, SURFACES, ball_model, ball_settings, rows, shots


def tracker(**changes: float) -> Tracker:
    return Tracker(ball_model(), SURFACES, ball_settings(), **changes)  # type: ignore[arg-type]


def fed(into: Tracker, samples: np.ndarray) -> list[BallUpdate]:
    """All updates of samples (n, 4), one push each."""
    found = []
    for t, *position in samples:
        found += into.push(t, position)
        into.tidy()
    return found


def of_ball(updates: list[BallUpdate], ball: int | None, kind: str = "state") -> list[BallUpdate]:
    return [u for u in updates if u.ball == ball and u.kind == kind]


def online(samples: np.ndarray) -> list:
    estimator = Online(ball_model(), SURFACES, ball_settings())
    return [estimator.push(t, position) for t, *position in samples]


def same_state(one, other) -> None:
    assert one.time == other.time
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one.joint, other.joint, rtol=1e-9, atol=1e-9)


def test_states_are_those_of_the_estimator_and_a_new_ball_follows_the_old() -> None:
    first, second = (rows(track, later) for track, later in zip(shots(2), (0.0, 1.5), strict=True))
    live = tracker()
    assert not any(vars(live.counts).values())
    updates = fed(live, np.concatenate((first, second)))
    for number, samples in ((1, first), (2, second)):
        states, expected = of_ball(updates, number), online(samples)
        assert [u.time for u in states] == samples[2:, 0].tolist()
        for update, state in zip(states, expected[2:], strict=True):
            assert update.state is not None
            same_state(update.state, state)
        assert [e.kind for u in states for e in u.events] == ["bounce"]
        assert states[-1].samples == len(samples)
    assert [u.ball for u in updates if u.kind == "lost"] == [1]
    assert [u.ball for u in live.end()] == [2]
    assert live.balls == {}
    assert live.counts.balls == live.counts.lost == 2


def test_a_ball_that_starts_elsewhere_0_3_s_after_another_was_last_seen_is_a_new_one() -> None:
    first, second = rows(shots(2)[0])[:24], rows(shots(2)[1])
    second[:, 0] += first[-1, 0] + 0.3
    live = tracker()
    updates = fed(live, np.concatenate((first, second)))
    same_state(of_ball(updates, 2)[-1].state, online(second)[-1])
    assert (live.counts.balls, live.counts.lost) == (2, 1)


def test_a_ball_that_was_not_seen_for_0_2_s_is_the_same() -> None:
    """The bounce lies in the gap."""
    samples = rows(shots(1)[0])
    seen = samples[(samples[:, 0] < 0.5) | (samples[:, 0] > 0.7)]
    live = tracker()
    updates = fed(live, seen)
    same_state(of_ball(updates, 1)[-1].state, online(seen)[-1])
    assert live.counts.balls == 1


@pytest.mark.parametrize("together", [True, False], ids=["one push a stamp", "one push a position"])
def test_two_balls_at_once_are_kept_apart(together: bool) -> None:
    """The second flies 0.25 m beside the first, and begins later; its positions come first where stamps are shared."""
    first, second = rows(shots(2)[0]), rows(shots(2)[1], beside=0.25)
    stamps = np.arange(len(first)) / 60.0
    first[:, 0], second[:, 0] = stamps, stamps[: len(second)] + stamps[7]
    live, updates = tracker(), []
    for t in sorted({*first[:, 0], *second[:, 0]}):
        here = np.concatenate((second[second[:, 0] == t], first[first[:, 0] == t]))[:, 1:]
        for positions in [here] if together else here:
            updates += live.push(t, positions)
    assert live.counts.balls == 2
    for number, samples in ((1, first), (2, second)):
        expected = online(samples)
        same_state(of_ball(updates, number)[-1].state, expected[-1])


@pytest.mark.parametrize("off", [0.06, 0.1, -0.1])
def test_a_ball_that_may_have_been_hit_takes_no_sample_of_another(off: float) -> None:
    """One sample of the first ball is off, and at the next stamp only the second one is seen, 0.3 m beside it."""
    first, second = rows(shots(2)[0])[:13], rows(shots(2)[0], beside=0.3)[:13]
    first[11, 3] += off
    live, updates = tracker(), []
    for one, other in zip(first[:12], second[:12], strict=True):
        updates = live.push(one[0], np.stack((one, other))[:, 1:])
    assert [update.ball for update in updates] == [1, 2]
    (state,) = (update.state for update in updates if update.ball == 1)
    assert state is not None
    assert state.sigmas[3:6].max() > 3.0
    assert [update.ball for update in live.push(second[12, 0], second[12, 1:])] == [2]


def test_out_of_order_within_the_lag_equals_sorted() -> None:
    samples = rows(shots(1)[0])
    order = np.argsort(samples[:, 0] + np.random.default_rng(0).uniform(0.0, 0.09, len(samples)))
    assert (np.diff(order) < 0).sum() > 10
    live = tracker()
    updates = fed(live, samples[order])
    same_state(live.balls[1], online(samples)[-1])
    newest = -math.inf
    for update in updates:  # a late sample moves the newest state, which its update shows
        newest = max(newest, update.time)
        assert update.state is None or update.state.time == newest
    assert live.counts.balls == 1
    assert live.counts.late == sum(u.late for u in updates) > 10
    assert live.counts.old == live.counts.repeated == 0


def test_older_and_repeated_stamps_are_counted_and_dropped() -> None:
    samples = rows(shots(1)[0])[:30]
    disturbed = np.concatenate((samples[:20], samples[18:20], samples[3:4], samples[20:]))
    live = tracker()
    updates = fed(live, disturbed)
    assert (live.counts.repeated, live.counts.old, live.counts.late) == (2, 1, 1)
    refused = [u.reason for u in updates if u.kind == "refused"]
    assert refused[:2] == ["ball 1 has a position of this stamp"] * 2
    assert "older than the newest stamp by more than the lag of 0.1 s" in refused[2]
    same_state(live.balls[1], online(samples)[-1])


@pytest.mark.parametrize(
    ("time", "position", "reason"),
    [
        (math.nan, [0.0, 0.0, 0.3], "the stamp is not finite"),
        (0.3, [math.nan, 0.0, 0.3], "a coordinate is not finite"),
        (0.3, [2000.0, 0.0, 300.0], "a coordinate is beyond 1000 m"),
        (0.3, [1e300, 0.0, 0.3], "a coordinate is beyond 1000 m"),
        (math.inf, [0.0, 0.0, 0.3], "the stamp is not finite"),
        (1e308, [0.0, 0.0, 0.3], "the stamp is beyond 1e+11 s"),
    ],
)
def test_unusable_samples_change_nothing(time: float, position: list[float], reason: str) -> None:
    samples = rows(shots(1)[0])[:24]
    live = tracker()
    fed(live, samples[:18])
    (update,) = live.push(time, position)
    assert (update.kind, update.reason) == ("refused", reason)
    fed(live, samples[18:])
    same_state(live.balls[1], online(samples)[-1])
    assert live.counts.malformed == 1


def test_standard_deviations_out_of_this_world_raise_nothing() -> None:
    """They say no more of a ball than metres do."""
    samples = rows(shots(1)[0])[:24]
    live = tracker()
    fed(live, samples[:18])
    for size in (1e300, 1e-300):
        (update,) = live.push(*(samples[18, 0] + 0.001 * (size < 1.0), samples[18, 1:], [size] * 3))
        assert (update.kind, update.ball) == ("state", 1)


def test_a_stamp_astray_costs_no_ball_and_a_clock_that_begins_anew_no_more_than_two_samples() -> None:
    first, second = rows(shots(2)[0], later=100.0)[:30], rows(shots(2)[1])
    astray = first[20:21] + np.array([1e6, 0.0, 0.0, 0.0])
    live = tracker()
    updates = fed(live, np.concatenate((first[:20], astray, first[20:], second)))
    assert live.counts.stray == live.counts.restarts == 1
    same_state(of_ball(updates, 1)[-1].state, online(first)[-1])
    assert live.counts.old == 2
    same_state(live.balls[2], online(second[2:])[-1])


def test_a_sample_that_the_ball_took_too_early_is_taken_back() -> None:
    """One comes 0.15 s before its time: the ball was expected there. Then the stream goes on from before."""
    samples = rows(shots(1)[0])[:30]
    early = np.concatenate((samples[:20], samples[29:], samples[20:]))
    live = tracker(lag=0.05)
    updates = fed(live, early)
    assert (live.counts.stray, live.counts.lost, live.counts.failed) == (1, 0, 0)
    assert [u.ball for u in updates if u.kind == "state"] == [1] * 29  # the first of all begins nothing
    same_state(updates[-1].state, online(samples)[-1])
    assert updates[-1].samples == 30


def test_without_a_lag_a_ball_that_took_a_sample_too_early_is_lost() -> None:
    """Its earlier samples are not kept: nothing is left to go back to."""
    samples = rows(shots(1)[0])[:30]
    live = tracker(lag=0.0)
    updates = fed(live, np.concatenate((samples[:20], samples[29:], samples[20:])))
    assert (live.counts.stray, live.counts.lost) == (1, 1)
    (gone,) = (u for u in updates if u.kind == "lost")
    assert gone.ball == 1
    assert sorted(live.balls) == [2]
    assert np.abs(live.balls[2].position - samples[-1, 1:]).max() < 0.02


def test_a_ball_of_which_nothing_can_be_made_begins_anew_and_is_lost_if_that_fails_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    samples, pushed = rows(shots(1)[0])[:24], Online.push
    fails = {12: 1, 18: 2}  # how often the estimator raises at a sample

    def push(self: Online, time: float, *rest: object) -> object:
        number = int(np.argmin(np.abs(samples[:, 0] - time)))
        if fails.get(number):
            fails[number] -= 1
            raise RuntimeError("no minimum\nwas found")
        return pushed(self, time, *rest)

    monkeypatch.setattr(Online, "push", push)
    live = tracker()
    updates = fed(live, samples)
    anew, gone = (next(u for u in updates if u.time == samples[k, 0]) for k in (12, 18))
    reason = "the estimator began anew: no minimum was found"
    assert (anew.kind, anew.ball, anew.reason) == ("state", 1, reason)
    assert (gone.kind, gone.ball, gone.reason) == ("refused", 1, reason)
    monkeypatch.undo()
    (before,) = (u.state for u in updates if u.time == samples[17, 0])
    same_state(before, online(samples[12:18])[-1])
    assert live.counts.failed == 2
    assert sorted(live.balls) == [2]
    same_state(live.balls[2], online(samples[19:])[-1])


def test_outliers_begin_no_ball_and_clutter_stays_bounded() -> None:
    samples, random = rows(shots(1)[0]), np.random.default_rng(1)
    live = tracker()
    for t, *position in samples:
        clutter = random.uniform([-5.0, -5.0, 0.0], [5.0, 5.0, 3.0], size=(3, 3))
        live.push(t, np.concatenate((clutter, [position])))
    assert np.abs(live.balls[1].position - samples[-1, 1:]).max() < 0.02
    assert len(live._newcomers) <= 32


@pytest.mark.thorough
def test_wrong_positions_beside_a_ball_hardly_ever_make_balls() -> None:
    """4 % are 15 to 45 cm off at 150 Hz: with 0.2 s of patience for each they made 16 balls in 50 s."""
    rng, ghosts = np.random.default_rng(12), 0
    for shot in simulate(SimulationConfig(tracks=40, rate=150.0, seed=4)):
        live, samples = tracker(), rows(shot.track.until(2.0))
        wrong = rng.random(len(samples)) < 0.04
        away = rng.standard_normal((int(wrong.sum()), 3))
        samples[wrong, 1:] += away / np.linalg.norm(away, axis=1)[:, None] * rng.uniform(0.15, 0.45, (len(away), 1))
        fed(live, samples)
        ghosts += live.counts.balls - 1
    assert ghosts <= 4


def test_many_balls_with_stamps_of_their_own_all_begin() -> None:
    """The steps from stamp to stamp are a sixteenth of those of a ball."""
    samples = np.concatenate([rows(shots(1)[0], k / (16 * RATE), beside=0.5 * k) for k in range(16)])
    live = tracker()
    fed(live, samples[np.argsort(samples[:, 0], kind="stable")])
    assert live.counts.balls == len(live.balls) == 16


def test_wrong_shapes_are_refused_at_the_edge() -> None:
    with pytest.raises(ValueError, match=r"positions must be \(3,\) or \(n, 3\) m; got \(2,\)"):
        tracker().push(0.0, [1.0, 2.0])
    with pytest.raises(ValueError, match=r"sigmas must be \(3,\) or as positions"):
        tracker().push(0.0, [1.0, 2.0, 3.0], [0.1])
    with pytest.raises(ValueError, match="lag must be at least 0"):
        tracker(lag=-1.0)
    with pytest.raises(ValueError, match="lag must be at least 0, at most 10; got 11"):  # it holds all samples back
        tracker(lag=11.0)


@pytest.mark.parametrize("seed", range(3))
def test_any_stream_is_answered_position_by_position(seed: int) -> None:
    """Three balls, shuffled beyond the lag, with outliers, wild stamps and numbers, repeats and odd sigmas."""
    random = np.random.default_rng(seed)
    samples = np.concatenate([rows(track, random.uniform(0, 0.3), 0.5 * k)[:16] for k, track in enumerate(shots(3, 5))])
    samples = samples[np.argsort(samples[:, 0] + random.uniform(0, 0.2, len(samples)))]
    live = tracker(lag=float(random.choice([0.0, 0.05, 1.0])), most=2)
    for sample in samples:
        wild = random.random()
        if wild < 0.1:
            sample[random.integers(4)] = random.choice([np.nan, np.inf, -1e300, 1e9, 0.4])
        elif wild < 0.2:
            sample += random.normal(0.0, 0.4, 4)
        sigma = None if random.random() < 0.9 else np.full(3, random.choice([0.0, np.nan, 1e-9, 10.0]))
        for _ in range(1 + (random.random() < 0.1)):
            updates = live.push(sample[0], sample[1:], sigma)
            assert [u.kind for u in updates if u.kind != "lost"] == [updates[-1].kind]
            assert all(np.isfinite(u.state.mean).all() for u in updates if u.state is not None)
    live.end()
    assert live.counts.balls == live.counts.lost


@pytest.mark.parametrize("apart", [0.0, 2e-3])
@pytest.mark.parametrize("together", [False, True])
def test_a_ball_that_is_measured_twice_at_each_stamp_is_one_ball(apart: float, *, together: bool) -> None:
    """Duplicated packets, or two sensors: from the first sample on, in one call or in two."""
    samples, live = rows(shots(1)[0])[:30], tracker()
    for time, *place in samples.tolist():
        pair = np.array([place, np.add(place, [0.0, apart, 0.0])])
        for positions in [pair] if together else pair:
            live.push(time, positions)
    assert (live.counts.balls, live.counts.repeated) == (1, len(samples))
    assert live.balls[1].time == samples[-1, 0]


def test_a_late_copy_goes_to_no_other_ball() -> None:
    """The other one was seen after the copied sample, and could have been anywhere then."""
    samples, live = rows(shots(1)[0])[:9], tracker()
    for k, (time, *place) in enumerate(samples.tolist()):
        other = np.add(place, [0.0, 1.8, 0.0])
        live.push(time, np.array([place, other] if k > 4 else [place]))
    (update,) = live.push(samples[3, 0], samples[3, 1:])
    assert (update.kind, update.reason) == ("refused", "ball 1 has a position of this stamp")
