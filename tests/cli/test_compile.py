"""`ballfg compile`: what an estimate, a prediction and a stream need is there afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ballfg.simulation import SimulationConfig, write_simulation
from tests.commands import status

MODEL = "flight: {gravity: {}, drag: {k: 0.1}, wind: {x: 1.0}}\nbounce: {restitution: {e: 0.9}}\n"


def test_nothing_is_generated_after_it(tmp_path: Path) -> None:
    """Of a model that nobody has used yet. What depends on no model is kept beside the package, for all tests."""
    write_simulation(tmp_path / "shots", SimulationConfig(tracks=2, rate=60.0, seed=2))
    (tmp_path / "model.yaml").write_text(MODEL)
    known = {**os.environ, "BALLFG_CACHE": str(tmp_path / "cache")}

    def run(*words: str) -> set[str]:
        command = "import sys; from ballfg.cli.main import run; run(sys.argv[1:])"
        done = subprocess.run(
            [sys.executable, "-c", command, *words], env=known, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        assert "Warning" not in done.stderr
        return {path.name for path in (tmp_path / "cache").rglob("*") if path.suffix in (".py", ".nbc", ".json")}

    made = run("compile", "--model", "model.yaml")
    assert made
    assert run("estimate", "shots", "--model", "model.yaml", "--out", "states.csv") == made
    assert run("predict", "shots", "--model", "model.yaml", "--observe", "0.2", "--out", "ahead.csv") == made
    assert run("live", "--replay", "shots", "--model", "model.yaml", "--speed", "100") == made


def test_a_model_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert status("compile", "--model", "none.yaml") == 2
    said = capsys.readouterr()
    assert said.err.startswith("ballfg: error: ")
    assert said.err.count("\n") == 1
    assert "none.yaml" in said.err
