"""Balls that dribble out: the filter's height and vertical velocity are as far off as its covariance says."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.arrays import Array
from ballfg.dynamics import Surfaces, nominal_model
from ballfg.dynamics.motion.limits import REST_SPEED
from ballfg.estimation.filters.ekf import ExtendedKalmanFilter
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.factors.noise import ProcessNoise
from ballfg.state import STANDARD_GRAVITY, VZ, Z
from ballfg.tracks import Track

SCATTER = 0.1  # m/s, of the speed after a bounce
UNLIKELY = 13.8  # Squared standard deviations of two numbers that one in 1000 exceeds


def heights(times: Array, height: float, restitution: float, rng: np.random.Generator) -> Array:
    """(n, 2) height above rest, m, and vertical speed, m/s, of a ball that falls from a height: parabolas."""
    found, begin, rise = (
        np.zeros((len(times), 2)),
        -np.sqrt(2 * height / STANDARD_GRAVITY),
        np.sqrt(2 * STANDARD_GRAVITY * height),
    )
    while begin < times[-1] and rise > REST_SPEED:
        since = times - begin
        hop = (since >= 0) & (since < 2 * rise / STANDARD_GRAVITY)
        found[hop, 0] = rise * since[hop] - STANDARD_GRAVITY / 2 * since[hop] ** 2
        found[hop, 1] = rise - STANDARD_GRAVITY * since[hop]
        begin, rise = begin + 2 * rise / STANDARD_GRAVITY, restitution * rise + rng.normal(0.0, SCATTER)
    return found


@pytest.mark.parametrize("smooth", [False, True], ids=["ekf", "ekf+rts"])
@pytest.mark.parametrize(("ball", "rate", "noise"), [("football", 60, 0.01), ("baseball", 120, 0.01)])
def test_a_ball_that_may_still_hop_is_not_sure_to_rest(ball: str, rate: int, noise: float, smooth: bool) -> None:
    model, rng, far = nominal_model(ball), np.random.default_rng(41), list[Array]()
    settings = Settings(position_noise=(noise,) * 3, process=ProcessNoise(contact_velocity=SCATTER))
    estimator = ExtendedKalmanFilter(model, Surfaces(0.0), settings, smooth=smooth)
    restitution = dict(model.named_parameters())["bounce.restitution.e"].item()
    times = np.arange(rate) / rate
    for _ in range(10):
        true = heights(times, float(rng.uniform(0.005, 0.1)), restitution, rng)
        places = np.column_stack((np.zeros((len(times), 2)), true[:, 0] + model.radius))
        estimate = estimator.estimate(Track(times, places + rng.normal(0.0, noise, places.shape)))
        assert estimate.status is Status.OK
        assert any("may hop lower than the noise" in note for note in estimate.notes)
        off = estimate.states[:, [Z, VZ]] - true - (model.radius, 0.0)
        spread = estimate.covariances[:, [Z, VZ]][:, :, [Z, VZ]]
        far.append(np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0])[4:])
    every = np.concatenate(far)
    assert (every > UNLIKELY).mean() < 0.02
    assert every.max() < 100.0
