"""A stream that begins with a ball on the table, which rolls or slides: errors in stated covariances, closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray

import ballfg as bf

G, RADIUS, NOISE, FRICTION, RESISTANCE = 9.80665, 0.02, 0.0015, 0.25, 0.01
TABLE = bf.Surfaces(0.0, -0.76)


def shoved(speed: float, times: NDArray, share: float, turned: float) -> NDArray:
    """(n, 9) states of a thin shell with a share of the spin of rolling, that Coulomb's friction makes roll.

    Args: speed: m/s.  times: (n,) s.  turned: rad, direction of the motion about z.
    """
    slip, grip = speed * (1.0 - share), FRICTION * G
    until = slip / (2.5 * grip)  # its slip loses 1 + 3 / 2 of the friction
    slides, rolls = np.minimum(times, until), np.maximum(times - until, 0.0)
    at_end = speed - (grip + RESISTANCE * G) * until
    v = np.where(rolls > 0.0, at_end - RESISTANCE * G * rolls, speed - (grip + RESISTANCE * G) * slides)
    x = speed * slides - (grip + RESISTANCE * G) * slides**2 / 2.0 + at_end * rolls - RESISTANCE * G * rolls**2 / 2.0
    turns = (v - np.maximum(slip - 2.5 * grip * times, 0.0)) / RADIUS
    along, across = np.array([np.cos(turned), np.sin(turned), 0.0]), np.array([-np.sin(turned), np.cos(turned), 0.0])
    spins = turns[:, None] * across
    return np.concatenate((x[:, None] * along + [0.0, 0.0, RADIUS], v[:, None] * along, spins), axis=1)


def streamed(truth: NDArray, times: NDArray, seed: int, lag: int = 128) -> tuple[NDArray, list[bf.BallState]]:
    """(n,) squared errors of position and velocity in their covariances, 6 on average, and the states."""
    settings = bf.Settings.for_measured(bf.nominal_model(), position_noise=(NOISE,) * 3, solver="ballfg")
    live, noise = bf.Online(bf.nominal_model(), TABLE, settings, lag), np.random.default_rng(seed)
    states = [live.push(t, p + noise.normal(0.0, NOISE, 3)) for t, p in zip(times, truth[:, :3], strict=True)]
    errors = np.array([one.state for one in states])[:, :6] - truth[:, :6]
    stated = np.array([one.covariance for one in states])[:, :6, :6]
    return (errors[:, None] @ np.linalg.solve(stated, errors[..., None]))[:, 0, 0], states


@pytest.mark.parametrize("rate", [60.0, 100.0, 250.0])
@pytest.mark.parametrize("share", [1.0, 0.0])
def test_a_ball_first_seen_on_the_table_is_known_as_well_as_stated(rate, share):
    found = []
    for seed in range(6):
        speed = [0.3, 0.6, 1.0, 1.5, 2.0, 3.0][seed]
        times = np.arange(int(0.45 * rate)) / rate
        found.append(streamed(shoved(speed, times, share, 0.9 * seed), times, seed)[0][2:])
    found = np.concatenate(found)
    assert np.median(found) < 8.0  # 10 to 30 for 0.4 s where a rolling ball counts as sliding
    assert np.mean(found > 30.0) < 0.03
    assert found.max() < 100.0


def test_both_hypotheses_live_on_where_the_window_cannot_change_its_own():
    """A window that is cut at once holds a ball as rolling or sliding before the samples tell."""
    times = np.arange(45) / 100.0
    for share, speed in ((1.0, 3.0), (0.0, 1.0)):
        truth = shoved(speed, times, share, 0.4)
        found = [streamed(truth, times, seed, lag=4)[0][2:] for seed in range(4)]
        assert np.mean(np.concatenate(found) > 30.0) < 0.03


def test_a_copy_follows_a_ball_first_seen_on_the_table_by_itself():
    times = np.arange(30) / 100.0
    positions = shoved(3.0, times, 1.0, 0.0)[:, :3]
    noise = bf.Settings.for_measured(bf.nominal_model(), position_noise=(NOISE,) * 3, solver="ballfg")
    live = bf.Online(bf.nominal_model(), TABLE, noise)
    for t, p in zip(times[:6], positions, strict=False):
        live.push(t, p)
    other = live.copy()
    ends = [[one.push(t, p) for t, p in zip(times[6:], positions[6:], strict=True)][-1] for one in (live, other)]
    assert np.array_equal(ends[0].state, ends[1].state)
    assert np.array_equal(ends[0].covariance, ends[1].covariance)
