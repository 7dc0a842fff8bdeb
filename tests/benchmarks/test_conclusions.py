"""What the numbers of a benchmark should be, and the sentences under its tables."""

import io

import numpy as np
import pytest

from ballfg.benchmarks.conclusions import conclusions, legend, print_table, should_be, target
from ballfg.benchmarks.metrics import Figure
from ballfg.benchmarks.results import Results


def rows(case: str, *numbers: tuple[str, str, str, float | Figure], n: int = 50) -> list:
    made = Results("ballfg-bench", 0)
    for method, metric, unit, value in numbers:
        made.add(case, method, metric, unit, value, n)
    return made.rows


@pytest.mark.parametrize(
    ("case", "metric", "unit", "goal"),
    [
        ("fair", "nees", "1", "9"),
        ("fair", "nees_velocity", "1", "3"),
        ("consistency", "nees_three_quarters", "1", "9"),
        ("fair", "coverage_50_velocity", "1", "0.5"),
        ("aimy", "conformal_coverage_90", "1", "0.9"),
        ("aimy", "coverage_90_x", "%", "90"),
        ("aimy", "nis_median", "1", "2.37"),
        ("aimy", "not_converged", "1", "0"),
        ("silence", "noise larger than stated", "1", "0"),
        ("naming, spin labels", "wind", "1", "1"),
        ("fair", "velocity_rmse", "m/s", ""),
        ("paper", "nees", "1", "6"),
        ("paper", "nees_velocity", "1", "3"),
        ("paper", "coverage_90_state", "1", "0.933"),
        ("paper", "coverage_90_velocity", "1", "0.9"),
        ("time", "one diagnosis, 50 tracks", "s", ""),
    ],
)
def test_right_values(case: str, metric: str, unit: str, goal: str) -> None:
    assert should_be(case, metric, unit) == goal


def test_targets_are_those_of_the_distributions() -> None:
    from scipy import stats

    assert target("nis_median", "1") == pytest.approx(stats.chi2.median(3), abs=5e-3)
    assert target("nees", "1") == stats.chi2.mean(9)
    assert target("velocity_rmse", "m/s") is None


def test_the_best_method_by_how_much_and_whether_by_chance() -> None:
    clear = rows(
        "fair",
        ("ekf", "velocity_rmse", "m/s", Figure(0.05, 0.045, 0.055)),
        ("smoother", "velocity_rmse", "m/s", Figure(0.025, 0.02, 0.03)),
    )
    said = "velocity: smoother has the smallest error, 0.025 m/s; next is ekf with 0.05 (100 % more)"
    assert conclusions("fair", clear) == [f"{said}."]
    doubtful = rows(
        "fair",
        ("ekf", "velocity_rmse", "m/s", Figure(0.05, 0.02, 0.08)),
        ("smoother", "velocity_rmse", "m/s", Figure(0.025, 0.02, 0.03)),
    )
    assert conclusions("fair", doubtful) == [f"{said}; their intervals overlap, so that the order may be chance."]
    alike = rows("fair", *((name, "position_rmse", "m", 0.002) for name in ("a", "b", "c")))
    assert conclusions("fair", alike) == [
        "position: a, b and c have the smallest error, 0.002 m: all methods are equally good."
    ]


def test_what_is_given_to_all_methods_is_no_error_of_theirs() -> None:
    """Nine components of which three are known exactly: the NEES and the coverage of draws, beside the right values."""
    drawn = np.random.default_rng(5).normal(size=(100_000, 9))
    drawn[:, 6:] = 0.0
    assert target("nees", "1", "paper") == pytest.approx((drawn**2).sum(axis=1).mean(), rel=0.01)
    held = float((abs(drawn) < 1.6449).mean())
    assert target("coverage_90_state", "1", "paper") == pytest.approx(held, abs=0.002)
    assert target("coverage_90_state", "%", "paper") == pytest.approx(100 * held, abs=0.2)
    numbers = (("a", "spin_rmse", "rad/s", 0.0), ("b", "spin_rmse", "rad/s", 1e-6), ("a", "nees", "1", 5.9))
    stream = io.StringIO()
    print_table(rows("paper", *numbers), stream)
    lines = stream.getvalue().splitlines()
    assert lines[3].split() == ["spin_rmse", "rad/s", "given", "given"]
    assert "-> stated uncertainty, by nees (should be 6) - right: a (5.9)." in lines
    assert any("the spin is given, not estimated" in line for line in lines)
    assert not any(line.startswith("-> spin") for line in lines)
    assert "given" not in "".join(conclusions("fair", rows("fair", *numbers)))


def test_whose_covariances_are_right() -> None:
    nees = [("a", 9.5), ("b", 14.0), ("c", 4.0), ("d", Figure(11.0, 8.0, 14.0))]
    said = conclusions("fair", rows("fair", *((name, "nees", "1", value) for name, value in nees)))
    assert said == [
        "stated uncertainty, by nees (should be 9) - right: a (9.5), d (11); "
        "too small, errors are larger: b (14); too large, errors are smaller: c (4)."
    ]
    shares = [("a", 0.88), ("b", 0.7), ("c", 0.99)]
    (said,) = conclusions("aimy", rows("aimy", *((name, "coverage_90", "1", value) for name, value in shares)))
    assert said.endswith(
        "right: a (0.88); too small, errors are larger: b (0.7); too large, errors are smaller: c (0.99)."
    )
    percent = rows("aimy", ("nominal", "coverage_90", "%", 92.0))
    assert conclusions("aimy", percent) == ["stated uncertainty, by coverage_90 (should be 90) - right: nominal (92)."]


def test_tables_of_the_loop_end_in_a_sentence() -> None:
    silence = rows("silence", ("effect named", "all", "1", 0.01), ("any alarm", "all", "1", 0.03), n=200)
    assert conclusions("silence", silence) == [
        "of 200 datasets without an effect 1.0 % got a wrong name, 3.0 % any alarm."
    ]
    naming = rows("naming, spin labels", ("1 typical", "all", "1", 0.9), ("3 typical", "all", "1", 1.0))
    assert conclusions("naming, spin labels", naming) == [
        "planted effects named right: 90 % at 1 typical, 100 % at 3 typical size."
    ]
    repair = rows("repair", ("after / true", "all", "1", 1.04), ("before / true", "all", "1", 2.5))
    assert "corrected model are 1.04 times as far off" in conclusions("repair", repair)[0]
    assert conclusions("silence", rows("silence", ("effect named", "spin labels", "1", 0.0))) == []


def test_a_table_shows_right_values_and_conclusions() -> None:
    stream = io.StringIO()
    numbers = (("ekf", "nees", "1", 12.0), ("smoother", "nees", "1", 9.1), ("smoother", "time", "s", 2.5))
    print_table(rows("fair", *numbers), stream)
    lines = stream.getvalue().splitlines()
    assert lines[2].endswith("should be")
    assert lines[3].split() == ["nees", "1", "12", "9.1", "9"]
    assert lines[4].split() == ["time", "s", "2.5"]
    assert lines[5].startswith("-> stated uncertainty, by nees (should be 9) - right: smoother (9.1); too small")
    plain = io.StringIO()
    print_table(rows("time", ("two processes", "one diagnosis", "s", 3.5)), plain)
    assert "should be" not in plain.getvalue()


def test_a_legend_says_what_the_metrics_of_a_table_are() -> None:
    numbers = (("ekf", "nees", "1", 9.0), ("ekf", "velocity_rmse_vs_smoother", "1", 2.0))
    said = legend("fair", rows("fair", *numbers))
    assert [words.split(":")[0] for words in said[1:]] == ["*_vs_METHOD", "nees", "unit 1"]
    assert "bounces" in said[0]
    assert legend("ballgun", rows("ballgun", ("ekf", "time", "s", 1.0))) == []
