import numpy as np
import pytest

from ballfg.benchmarks.estimators.measured import WHOLE, Measured, _add_smoothing, conformal_coverage, prediction_rmse
from ballfg.benchmarks.results import Results
from ballfg.estimation import Estimate, Status
from ballfg.estimation.track_prediction import TrackPrediction


def test_prediction_rmse_by_hand() -> None:
    times = np.arange(3.0)
    estimate = Estimate("0", times, np.zeros((3, 9)), np.tile(np.eye(9), (3, 1, 1)), Status.OK, np.full((3, 3), np.nan))
    measured = np.array([[0.003, 0.004, 0.0], [0.0, 0.0, 0.0]])
    prediction = TrackPrediction("0", np.array([3.0, 4.0]), np.zeros((2, 3)), np.ones((2, 3)), measured, estimate)
    assert prediction_rmse(prediction) == pytest.approx(0.005 / np.sqrt(2))


def test_innovations_next_to_a_hit_do_not_count_and_marked_ones_count_as_failures() -> None:
    whitened = np.zeros((6, 3))
    whitened[0] = [0.0, 5.1, 0.0]  # too far
    whitened[2] = [9.0, 0.0, 0.0]  # next to the hit
    quality = np.array([0, 1, 0, 0, 3, 0], dtype=np.int8)
    estimate = Estimate(
        "0",
        np.arange(6.0),
        np.zeros((6, 9)),
        np.tile(np.eye(9), (6, 1, 1)),
        Status.OK,
        {"position": whitened},
        hits=np.array([2]),
        quality=quality,
    )
    results = Results("test", 0)
    _add_smoothing(results, Measured("toy", {}, [estimate], 0))
    # samples 0, 1, 4, 5 count
    assert results.value("toy", WHOLE, "within_5_sigma") == pytest.approx(3 / 4)
    assert results.value("toy", WHOLE, "within_5_sigma_marked_fail") == pytest.approx(2 / 4)
    assert results.value("toy", WHOLE, "share_marked") == pytest.approx(1 / 4)
    assert results.value("toy", WHOLE, "share_wide") == pytest.approx(1 / 4)
    assert results.value("toy", WHOLE, "hits") == 1


def test_conformal_intervals_of_random_halves_hold() -> None:
    """60 tracks whose sigmas are three times too small; 30 tracks calibrate, so that 90 to 96.5 % are right."""
    rng = np.random.default_rng(0)
    predictions = []
    for i in range(60):
        estimate = Estimate(str(i), np.zeros(1), np.zeros((1, 9)), np.eye(9)[None], Status.OK)
        times, errors = np.arange(1, 11) / 100, 3.0 * rng.normal(size=(10, 3))
        predictions.append(TrackPrediction(str(i), times, np.zeros((10, 3)), np.ones((10, 3)), errors, estimate))
    figure = conformal_coverage(predictions, 0.25, 0)
    assert figure is not None
    assert 0.89 <= figure.value <= 0.965
    assert figure.low < figure.value < figure.high
    assert conformal_coverage(predictions[:17], 0.25, 0) is None
