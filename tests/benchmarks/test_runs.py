"""Small runs of what takes minutes in earnest. Times are never tested, only that they were taken."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from ballfg.benchmarks.estimators.measured import WHOLE, Measured, _add_smoothing, prediction_rmse
from ballfg.benchmarks.estimators.suite import Size, describe, run_synthetic
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.speed import run as speed
from ballfg.benchmarks.speed.network import GRAVITY, fitted_network, parameter_count
from ballfg.benchmarks.speed.suite import problem_model, run_speed
from ballfg.benchmarks.estimators.protocols import fair_protocol
from ballfg.estimation import Estimate, Status
from ballfg.prediction import TrackPrediction

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


def test_same_seed_gives_the_same_rows(small_run: tuple[Results, list[Path]], tmp_path: Path) -> None:
    again = Results("test", 2)
    run_synthetic(again, tmp_path, SMALL, 1)
    assert again.rows == small_run[0].rows


def test_settings_are_stated() -> None:
    text = describe(fair_protocol(2, 0))
    assert text.startswith("fair: 2 tracks; position noise 3 / 3 / 3 mm; process noise acceleration ")
    assert "spin label 4 rad/s" in text
    assert "squared loss" in text


def test_prediction_rmse_by_hand() -> None:
    times = np.arange(3.0)
    estimate = Estimate("0", times, np.zeros((3, 9)), np.tile(np.eye(9), (3, 1, 1)), Status.OK, np.full((3, 3), np.nan))
    measured = np.array([[0.003, 0.004, 0.0], [0.0, 0.0, 0.0]])
    prediction = TrackPrediction("0", np.array([3.0, 4.0]), np.zeros((2, 3)), np.ones((2, 3)), measured, estimate)
    assert prediction_rmse(prediction) == pytest.approx(0.005 / np.sqrt(2))


def test_network_is_the_same_each_time_and_close_to_the_model() -> None:
    model = problem_model()
    short, again = fitted_network(model, iterations=10), fitted_network(model, iterations=10)
    assert all(torch.equal(a, b) for a, b in zip(short.parameters(), again.parameters(), strict=True))
    one = fitted_network(model)
    assert parameter_count(one) == 7523
    rng = torch.Generator().manual_seed(9)
    scale = torch.tensor([1.0] * 3 + [4.0] * 3 + [60.0] * 3, dtype=torch.float64)
    state = scale * torch.randn((500, 9), generator=rng, dtype=torch.float64)
    with torch.no_grad():
        force = model.rates(state)[0] - GRAVITY
        error = one.rates(state)[0] - model.rates(state)[0]
    assert error.square().mean().sqrt() < 0.1 * force.square().mean().sqrt()


def test_speed_run_has_every_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "fitted_network", partial(fitted_network, iterations=100))
    results = Results("test", 0)
    run_speed(results, None, quick=True)
    expected = {
        "matrix_product_time",
        "lm_time",
        "lm_time_gtsam",
        "covariances_time",
        "estimate_time",
        "jacobians_time_79",
        "jacobian_time_1",
        "online_update_median",
        "online_update_p99",
        "prediction_time",
    }
    for method in ("analytic", "network"):
        found = {row.metric for row in results.rows if row.method == method and row.unit == "ms"}
        assert found == expected
    assert {row.metric for row in results.rows if row.method == "control"} == {"matrix_product_time"}
    assert all(row.value is not None and row.value > 0 for row in results.rows)


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
        whitened,
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
