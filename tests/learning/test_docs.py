"""The guide's examples are run as they stand."""

from __future__ import annotations

import re

import pytest
import torch
import yaml
from safetensors.torch import load_file

from ballfg.learning import read_config
from ballfg.learning.run.run_folder import read_metrics
from ballfg.learning.trainee import TRAINEES
from ballfg.simulation import SimulationConfig, write_simulation
from tests.learning.estimates import directional
from tests.places import DOCS

GUIDE = DOCS / "learn.md"
STEP = 1e-3
"""m, and of a logarithm: the solver finds its point to 1e-13."""
SAME = 1e-6


@pytest.fixture(scope="module")
def examples() -> list[str]:
    return re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.thorough
def test_training_from_python(examples: list[str], tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(examples[0], str(GUIDE), "exec"), names)
    *epochs, status = capsys.readouterr().out.splitlines()
    losses = [float(loss) for line in epochs for loss in re.findall(r"-?\d+\.\d+", line)]
    assert len(losses) == 6
    assert losses[4] < losses[0]  # of training
    assert status == "converged"
    trained = names["model"].trained
    assert trained.launcher.labels == ("topspin", "sidespin")
    assert trained.position_scale != 1.0


def test_a_kind_of_one_s_own(examples: list[str], tmp_path, monkeypatch, capsys) -> None:
    """One class and one registration: it trains through the config file, for one epoch."""
    monkeypatch.chdir(tmp_path)
    write_simulation("shots", SimulationConfig(tracks=5, rate=60.0, seed=1))
    with TRAINEES.restored():
        names: dict[str, object] = {"__name__": "guide"}
        exec(compile(examples[1], str(GUIDE), "exec"), names)
        exec(compile(examples[2], str(GUIDE), "exec"), names)
        with pytest.raises(ValueError, match=r"'kind' must be 'a-tune', .* or 'parabola'; got 'parabel'"):
            read_config("parabola.yaml", ["kind=parabel"])
    assert "parabola: 4 tracks train, 1 validate" in capsys.readouterr().out
    before, after = read_metrics(tmp_path / "shots-parabola" / "metrics.csv")
    assert (before.epoch, after.epoch) == (0, 1)
    assert after.validation_rmse < before.validation_rmse
    down = float(load_file(tmp_path / "shots-parabola" / "parabola.safetensors")["acceleration"][2])
    assert down < 0.0
    assert yaml.safe_load((tmp_path / "shots-parabola" / "config.yaml").read_text())["kind"] == "parabola"


def test_gradient_of_a_foreign_solver(examples: list[str], capsys) -> None:
    names: dict = {}
    exec(compile(examples[3], str(GUIDE), "exec"), names)
    assert capsys.readouterr().out.startswith("[")
    assert float(names["residual"](names["solve"]()).detach().abs().max()) > 0.1  # it does bend

    def height() -> float:
        with torch.enable_grad():
            return float(names["solve"]()[2])

    for leaf in (names["beacons"], names["log_sigma"]):
        for k, gradient in enumerate(leaf.grad.flatten().tolist()):
            axis = torch.eye(leaf.numel(), dtype=torch.float64)[k].view(leaf.shape)
            expected = directional(height, [leaf], [axis], STEP)
            assert gradient == pytest.approx(expected, abs=SAME * float(leaf.grad.abs().max()))


def test_overrides_in_the_guide_are_read(tmp_path) -> None:
    (command,) = re.findall(r"^ballfg-train train\.yaml .*$", GUIDE.read_text(encoding="utf-8"), re.MULTILINE)
    (tmp_path / "train.yaml").write_text("")
    overrides = [word.strip('"') for word in command.split() if "=" in word]
    config = read_config(tmp_path / "train.yaml", overrides)
    assert config.architecture.residual
    assert config.launcher.labels == ("group",)
    assert config.observe.seconds == 0.25
