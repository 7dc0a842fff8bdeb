"""The page of results is what its command writes from the result files."""

import itertools
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import DOCS

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
