"""A small run of a comparison that takes minutes in earnest."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.benchmarks.estimators.measured import WHOLE, Measured, _add_smoothing, conformal_coverage, prediction_rmse
from ballfg.benchmarks.estimators.protocols import fair_protocol
from ballfg.benchmarks.estimators.suite import Size, describe_settings, run_synthetic
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


SMALL = Size(compared=3, consistency=4, measured=None, counts=(5, 20))


@pytest.fixture(scope="module")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Results, list[Path]]:
    results = Results("test", 2)
    return results, run_synthetic(results, tmp_path_factory.mktemp("out"), SMALL, 1)


def test_synthetic_run_has_all_cases_methods_and_pictures(small_run: tuple[Results, list[Path]]) -> None:
    results, pictures = small_run
    found: dict[str, set[str]] = {}
    for row in results.rows:
        found.setdefault(row.case, set()).add(row.method)
    assert found == {
        "paper": {"sliding-window", "ekf", "ekf-no-window", "smoother"},
        "fair": {"sliding-window", "ekf", "ekf+rts", "online", "smoother"},
        "consistency": {"smoother"},
    }
    assert [p.name for p in pictures] == ["estimators_paper.png", "estimators_fair.png"]


def test_smoothing_beats_filtering_beats_differences(small_run: tuple[Results, list[Path]]) -> None:
    results, _ = small_run
    rmse = {m: results.value("fair", m, "velocity_rmse") for m in ("smoother", "ekf", "sliding-window")}
    assert rmse["smoother"] < 0.75 * rmse["ekf"]  # type: ignore[operator]
    assert rmse["smoother"] < 0.25 * rmse["sliding-window"]  # type: ignore[operator]


def test_filter_and_graph_agree_at_the_newest_sample(small_run: tuple[Results, list[Path]]) -> None:
    results, _ = small_run
    for case, method in (("paper", "ekf-no-window"), ("fair", "ekf")):
        ratio = results.value(case, "smoother", f"velocity_rmse_newest_vs_{method}")
        assert ratio == pytest.approx(1.0, abs=0.02)


@pytest.mark.thorough  # a quicker one: test_protocols.py
def test_same_seed_gives_the_same_rows(small_run: tuple[Results, list[Path]], tmp_path: Path) -> None:
    again = Results("test", 2)
    run_synthetic(again, tmp_path, SMALL, 1)
    assert again.rows == small_run[0].rows


def test_settings_are_stated() -> None:
    text = describe_settings(fair_protocol(2, 0).settings)
    assert text.startswith("position noise 3 / 3 / 3 mm; process noise acceleration ")
    assert "spin label 4 rad/s" in text
    assert text.endswith("squared loss")
    learned = replace(fair_protocol(2, 0).settings, coefficients={"flight.drag.k": 0.02, "bounce.restitution.e": 0.03})
    assert describe_settings(learned) == f"{text}; coefficients per track: flight.drag.k, bounce.restitution.e"
