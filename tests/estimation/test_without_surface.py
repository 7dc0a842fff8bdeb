"""Estimates and predictions of balls that meet no surface, against those above a table far below."""

import numpy as np
import pytest
import torch

import ballfg as bf
from ballfg.dynamics import Surfaces, nominal_model, rollout

FAR_BELOW = Surfaces(-300.0)
NONE = Surfaces.none()


def _throw() -> bf.Track:
    t = np.arange(0.0, 0.8, 0.01)
    p = np.stack((3.0 * t, 0.1 * t, 0.5 + 4.0 * t - 4.905 * t**2), axis=1)
    return bf.Track(t, p + np.random.default_rng(3).normal(0.0, 0.002, p.shape))


def test_no_surface_has_no_heights() -> None:
    assert NONE.heights() == ()
    assert str(NONE) == "no surface"
    assert Surfaces.table_tennis(-np.inf) == NONE
    with pytest.raises(ValueError, match="table_height"):
        Surfaces(np.inf)


def test_a_ball_falls_on() -> None:
    start = torch.tensor([[0.0, 0.0, 1.0, 2.0, 0.0, 3.0, 0.0, 50.0, 0.0]], dtype=torch.float64, requires_grad=True)
    times = torch.tensor([0.5, 2.0, 3.0], dtype=torch.float64)
    fallen, same = (rollout(nominal_model(), start, times, one) for one in (NONE, FAR_BELOW))
    torch.testing.assert_close(fallen, same, atol=1e-9, rtol=0.0)
    assert float(fallen.detach()[0, -1, 2]) < -10.0
    slopes, expected = (torch.autograd.grad(one[0, -1, 2], start)[0] for one in (fallen, same))
    torch.testing.assert_close(slopes, expected, atol=1e-9, rtol=0.0)


@pytest.mark.parametrize("method", ["smoother", "online", "ekf", "sliding-window"])
def test_estimators_and_events(method: str) -> None:
    estimate, same = (bf.estimate(_throw(), method=method, surfaces=one) for one in (NONE, FAR_BELOW))
    np.testing.assert_allclose(estimate.states, same.states, atol=1e-6)
    assert not estimate.contacts
    ahead, other = bf.predict(estimate, horizon=1.0), bf.predict(same, horizon=1.0)
    np.testing.assert_allclose(ahead.positions, other.positions, atol=1e-6)
    assert ahead.next_contact is None
    crossing, expected = ahead.crossing(z=-2.0), other.crossing(z=-2.0)
    assert crossing is not None
    assert expected is not None
    assert crossing.time == pytest.approx(expected.time, abs=1e-6)


def test_live_balls_need_none() -> None:
    track = _throw()
    live = bf.Tracker(bf.nominal_model(), NONE)
    updates = [one for t, p in zip(track.times, track.positions, strict=True) for one in live.push(t, p)]
    assert updates[-1].samples == len(track)
    assert updates[-1].state.predict(1.0).next_contact is None
