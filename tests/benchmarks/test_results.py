"""Rows and their files. The page of results is what its command writes from the result files."""

import io
import itertools
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ballfg.benchmarks.conclusions import print_table
from ballfg.benchmarks.metrics import Figure
from ballfg.benchmarks.results import Results
from tests.places import DOCS

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


WRITER = Path("results/page.py")


@pytest.fixture
def docs(tmp_path: Path) -> Path:
    """A folder with the result files alone."""
    shutil.copytree(DOCS / "results", tmp_path / "docs" / "results")
    return tmp_path / "docs"


def test_the_page_is_what_the_command_writes(docs: Path) -> None:
    subprocess.run([sys.executable, docs / WRITER], check=True)
    page = (docs / "benchmarks.md").read_text(encoding="utf-8")
    assert (DOCS / "benchmarks.md").read_text(encoding="utf-8") == page, "run `make results-page`"
    lines = page.splitlines()
    assert len(lines) <= 300
    for head in (first for first, second in itertools.pairwise(lines) if second.startswith("|---")):
        assert re.search(r"\brequired\b", head) or "| tracks |" in head, head


def test_rows_of_a_new_run_are_taken_over(docs: Path, tmp_path: Path) -> None:
    kept = json.loads((docs / "results" / "estimators.json").read_text(encoding="utf-8"))["rows"]
    chosen = next(row for row in kept if (row["case"], row["method"], row["metric"]) == ("fair", "ekf", "nees"))
    new = {**chosen, "value": 7.125, "low": 7.0, "high": 7.25}
    other = {**new, "metric": "of nothing"}
    (tmp_path / "results.json").write_text(json.dumps({"rows": [new, other]}), encoding="utf-8")
    run = [sys.executable, docs / WRITER, "--take", tmp_path / "results.json"]
    assert subprocess.run(run, check=True, capture_output=True, text=True).stdout == "1 rows taken\n"
    now = json.loads((docs / "results" / "estimators.json").read_text(encoding="utf-8"))["rows"]
    assert [row for row in now if row not in kept] == [new]
    assert "| 7.12 (7 - 7.25) |" in (docs / "benchmarks.md").read_text(encoding="utf-8")
