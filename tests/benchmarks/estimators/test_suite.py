"""A small run of a comparison that takes minutes in earnest."""

from dataclasses import replace
from pathlib import Path

import pytest

from ballfg.benchmarks.estimators.protocols import fair_protocol
from ballfg.benchmarks.estimators.suite import Size, describe_settings, run_synthetic
from ballfg.benchmarks.results import Results

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
