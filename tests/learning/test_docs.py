"""The guide's examples are run as they stand."""

from __future__ import annotations

import re

import pytest
import torch

from ballfg.learning.config.config_file import read_config
from tests.learning.estimates import directional
from tests.places import DOCS

GUIDE = DOCS / "learn.md"
STEP = 1e-3
"""m, and of a logarithm: the solver finds its point to 1e-13."""
SAME = 1e-6


@pytest.fixture(scope="module")
def examples() -> list[str]:
    return re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)


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


def test_gradient_of_a_foreign_solver(examples: list[str], capsys) -> None:
    names: dict = {}
    exec(compile(examples[1], str(GUIDE), "exec"), names)
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
