import io
import json
from pathlib import Path

import pytest

from ballfg.benchmarks.conclusions import print_table
from ballfg.benchmarks.metrics import Figure
from ballfg.benchmarks.results import Results

ROW_KEYS = ["case", "method", "metric", "unit", "value", "low", "high", "n"]


@pytest.fixture
def results() -> Results:
    made = Results("ballfg-bench estimators --seed 3", 3)
    made.add("fair", "ekf", "velocity_rmse", "m/s", Figure(0.05, 0.04, 0.06), 50)
    made.add("fair", "smoother", "velocity_rmse", "m/s", 0.025, 50)
    made.add("fair", "smoother", "nees", "1", float("nan"), 50)
    made.add("fair", "smoother", "velocity_mean_newest@20", "m/s", 0.03, 50)
    return made


def test_file_has_the_schema(results: Results, tmp_path: Path) -> None:
    path = results.write(tmp_path / "deep" / "folder")
    content = json.loads(path.read_text())
    assert list(content) == ["command", "versions", "machine", "seed", "rows"]
    assert content["command"] == "ballfg-bench estimators --seed 3"
    assert content["seed"] == 3
    assert {"python", "ballfg", "gtsam", "torch"} <= set(content["versions"])
    assert set(content["machine"]) == {"cpu", "cores", "system"}
    assert all(list(row) == ROW_KEYS for row in content["rows"])
    assert content["rows"][0] == dict(
        zip(ROW_KEYS, ["fair", "ekf", "velocity_rmse", "m/s", 0.05, 0.04, 0.06, 50], strict=True)
    )
    assert [p.name for p in path.parent.iterdir()] == ["results.json"]


def test_numbers_that_are_not_finite_become_null(results: Results) -> None:
    row = results.to_dict()["rows"][2]
    assert row["value"] is None
    assert row["low"] is None


def test_value_looks_a_row_up(results: Results) -> None:
    assert results.value("fair", "smoother", "velocity_rmse") == 0.025
    with pytest.raises(KeyError, match="no row"):
        results.value("fair", "smoother", "speed")


def test_plain_table_has_a_column_per_method_and_no_curves(results: Results) -> None:
    stream = io.StringIO()
    print_table(results.rows, stream)
    lines = stream.getvalue().splitlines()
    assert lines[1:3] == ["fair", "metric         unit  ekf                smoother  should be"]
    assert lines[3].split() == ["velocity_rmse", "m/s", "0.05", "[0.04,", "0.06]", "0.025"]
    assert lines[4].split() == ["nees", "1", "-", "9"]
    assert "@" not in stream.getvalue()


def test_terminal_table_is_drawn(results: Results) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    print_table(results.rows, stream)
    assert "velocity_rmse" in stream.getvalue()
    assert "─" in stream.getvalue()
