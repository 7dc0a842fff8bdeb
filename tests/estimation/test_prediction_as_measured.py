"""Predictions of what will be measured, where that is not where the ball will be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import AnalyticModel, BallModel
from ballfg.dynamics.effect import Effect
from ballfg.estimation import Settings, predict_tracks
from ballfg.estimation.registry import make_estimator
from ballfg.estimation.track_prediction import TrackPrediction
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise, SimulationConfig, parse_effects, simulate

CONFIG = SimulationConfig(tracks=3, rate=60.0, seed=5, noise=MeasurementNoise(position=0.002, spin=4.0))
BALL, SURFACES = CONFIG.ball.model, CONFIG.ball.surfaces
EXACT = Settings(position_noise=(0.002,) * 3, process=ProcessNoise(acceleration=0.02, spin=0.5), spin_label_noise=4.0)
UNSURE = replace(EXACT, coefficients={"flight.drag.k": 0.01, "bounce.restitution.e": 0.005})
OBSERVE = 0.292
"""s, between two frames, whatever the clock of the cases below makes of them."""


def declared(effects: tuple[Effect, ...]) -> AnalyticModel:
    own = [*BALL.flight.values(), *BALL.bounce.values(), *effects]
    return AnalyticModel(own, radius=BALL.radius, inertia_factor=BALL.inertia_factor)


def predictions(
    model: BallModel, effects: tuple[Effect, ...], method: str, settings: Settings
) -> list[TrackPrediction]:
    tracks = [s.track for s in simulate(replace(CONFIG, undeclared=effects))]
    found = list(predict_tracks(make_estimator(method, model, SURFACES, settings), tracks, len(tracks), OBSERVE))
    for prediction, track in zip(found, tracks, strict=True):
        np.testing.assert_array_equal(np.concatenate((prediction.estimate.times, prediction.times)), track.times)
    return found


def errors(found: list[TrackPrediction]) -> np.ndarray:
    """(n,) m, root mean square of each track."""
    return np.array([np.sqrt(np.square(p.positions - p.measured).sum(-1).mean()) for p in found])


@pytest.mark.parametrize(
    ("texts", "method", "settings"),
    [
        (["velocity_lag.lag=0.005", "frame_tilt.x=0.05"], "smoother", EXACT),
        (["time_offset.z=0.004", "time_scale.s=0.02"], "smoother", UNSURE),
        (["velocity_lag.lag=0.005", "time_scale.s=0.02"], "ekf", UNSURE),
    ],
    ids=["lag and tilt", "offset and clock", "lag and clock by EKF"],
)
def test_predictions_are_as_good_as_without_the_effects(texts, method, settings) -> None:
    effects = parse_effects(texts)
    found, plain = predictions(declared(effects), effects, method, settings), predictions(BALL, (), method, settings)
    np.testing.assert_allclose(errors(found), errors(plain), rtol=0.1)
    for prediction, expected in zip(found, plain, strict=True):
        np.testing.assert_allclose(prediction.sigmas, expected.sigmas, rtol=0.2)
    assert np.median(errors(predictions(BALL, effects, method, settings))) > 1.5 * np.median(errors(found))
