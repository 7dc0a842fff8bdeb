"""`ballfg compile`: what an estimate, a prediction and a stream need is there afterwards."""

from __future__ import annotations

from pathlib import Path

import pytest

from ballfg.dynamics.compiled.kept import cache_folder
from ballfg.dynamics.known_balls import KNOWN_BALLS
from ballfg.simulation import SimulationConfig, write_simulation
from tests.commands import printed, refused
from tests.interpreter import Interpreter

MODEL = "flight: {gravity: {}, drag: {k: 0.1}, wind: {x: 1.0}}\nbounce: {restitution: {e: 0.9}}\n"


@pytest.mark.thorough
def test_nothing_is_generated_after_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a model that nobody has used yet. What depends on no model is kept beside the package, for all tests."""
    write_simulation(tmp_path / "shots", SimulationConfig(tracks=2, rate=60.0, seed=2))
    (tmp_path / "model.yaml").write_text(MODEL)
    where = {"BALLFG_CACHE": str(tmp_path / "cache")}

    def ran(ballfg: Interpreter, *words: str) -> set[str]:
        done = ballfg(*words)
        assert done.status == 0, done.err
        assert "Warning" not in done.err
        return {path.name for path in (tmp_path / "cache").rglob("*") if path.suffix in (".py", ".nbc", ".json")}

    monkeypatch.chdir(tmp_path)
    with Interpreter(variables=where) as ballfg:
        made = ran(ballfg, "compile", "--model", "model.yaml")
    assert made
    with Interpreter(variables=where) as ballfg:
        assert ran(ballfg, "estimate", "shots", "--model", "model.yaml", "--out", "states.csv") == made
        assert ran(ballfg, "predict", "shots", "--model", "model.yaml", "--observe", "0.2", "--out", "a.csv") == made
        assert ran(ballfg, "live", "--replay", "shots", "--model", "model.yaml", "--speed", "100") == made


def test_the_balls_that_ship(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of them: each takes as long as any other."""
    two = ("table_tennis", "tennis")
    monkeypatch.setattr("ballfg.dynamics.known_balls.KNOWN_BALLS", {name: KNOWN_BALLS[name] for name in two})
    assert printed("compile").out == f"{', '.join(two)}: compiled, and kept in {cache_folder()}\n"


def test_a_model_with_measurement_effects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its ball is compiled and exported; the measurement is undone in Python."""
    monkeypatch.setattr("ballfg.dynamics.known_balls.KNOWN_BALLS", {"table_tennis": KNOWN_BALLS["table_tennis"]})
    ball = "flight: {gravity: {}, drag: {k: 0.1}}\nbounce: {restitution: {e: 0.9}}\n"
    plain, tilted = tmp_path / "plain.yaml", tmp_path / "tilted.yaml"
    plain.write_text(ball)
    tilted.write_text(ball + "measurement: {frame_tilt: {x: 0.01}}\n")
    assert f"table_tennis, {tilted}: compiled" in printed("compile", "--model", tilted).out
    headers = []
    for model, left_out in ((plain, False), (tilted, True)):
        said = printed("export", model, "--out", tmp_path / "ball.h")
        assert ("measurement effects are left out" in said.err) == left_out
        headers.append((tmp_path / "ball.h").read_text())
    assert headers[0] == headers[1]


def test_a_model_that_is_not_there() -> None:
    assert "none.yaml" in refused("compile", "--model", "none.yaml")
