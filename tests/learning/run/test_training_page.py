"""The page of a training, whether it helped, its exit status, and what a stopped training leaves."""

from __future__ import annotations

import base64
import re
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import tests.learning.run.falling_ball as balls
from ballfg.learning.cli import run as command
from ballfg.learning.config.training import OptimizerConfig, SplitConfig, TrainConfig
from ballfg.learning.run import record, training
from ballfg.learning.run.run_folder import Epoch, read_metrics
from ballfg.learning.run.training_page import TERMS, beside_untrained, improved, page, verdict
from ballfg.learning.trainee import Learned, PredictedShot
from tests.html_page import HtmlPage


def epochs(*errors: float | None) -> list[Epoch]:
    return [Epoch(i, None if i == 0 else 9.0 - i, 0.05, e, 1e-3, 1.0, 0, 0, 0, 1.0) for i, e in enumerate(errors)]


def config(rate: float, count: int, **fields: Any) -> TrainConfig:
    optimizer = OptimizerConfig(learning_rate=rate, batch=4, epochs=count, schedule="constant", clip=None)
    return TrainConfig(**{"kind": "falling-balls", "seed": 3, "data": "plain", "optimizer": optimizer} | fields)


def test_whether_it_helped_in_one_sentence() -> None:
    assert improved(epochs(0.08, 0.05, 0.06), 1) is True
    assert verdict(epochs(0.08, 0.05, 0.06), 1) == (
        "The training helped: on validation tracks, predictions are off by 50.0 mm in place of 80.0 mm before the "
        "first step."
    )
    assert improved(epochs(0.073, 0.117, 0.0857), 0) is False
    assert "did not help" in verdict(epochs(0.073, 0.117, 0.0857), 0)
    assert "73.0 mm. After it the best was 85.7 mm" in verdict(epochs(0.073, 0.117, 0.0857), 0)
    assert "None of the later models could be judged" in verdict(epochs(0.073, None), 0)
    assert improved(epochs(None, None), 0) is None
    assert improved(epochs(0.08), 0) is None
    assert "not known" in verdict(epochs(None, None), 0)


def test_a_page_shows_the_numbers_and_a_shot() -> None:
    rows = epochs(0.08, 0.05, 0.06)
    times = 0.05 * np.arange(-4, 9)
    measured = np.outer(times, (5.0, 0.1, 1.0))
    shot = PredictedShot("ball <7>", times, measured, measured + np.array([0.0, 0.012, 0.0]))
    learned = [Learned("spin", 1.0, 0.37, "rad/s/√s", "random change of the spin in flight")]
    curves = record.curves(rows, "mlp")
    origin = {"made on": "2026-01-31", "command": "ballfg-train a.yaml -3e-4", "with": "ballfg 1"}
    text = page("mlp: 9 tracks", rows, 1, curves, learned, shot, "ballfg predict D --model m.yaml", origin)
    words = " ".join(" ".join(HtmlPage(text).words).split())
    for part in (
        "The training helped: on validation",
        "ballfg predict D --model m.yaml",
        "1: best, written 50.0 mm 50.0 mm 8",
        "0: before the first step 50.0 mm 80.0 mm",
        "Validation track ball <7>, whose error is the median",
        "the prediction is off by 12.0 mm (RMSE)",
        "Crosses mark the 5 samples that the estimate observed, circles the 8 that it had to predict",
        "made on 2026-01-31 command ballfg-train a.yaml -3e-4 with ballfg 1",
        "spin 1 0.37 rad/s/√s random change of the spin in flight",
    ):
        assert part in words, part
    pictures = [base64.b64decode(found) for found in re.findall(r"data:image/png;base64,([^\"]+)", text)]
    assert len(pictures) == 2
    for (
        png
    ) in pictures:  # wide and high stand in the first chunk; as wide as the page it is hardly higher than a screen
        width, height = struct.unpack(">II", png[16:24])
        assert height < 1.25 * width
    rest = replace(shot, times=times[5:], measured=measured[5:], predicted=measured[5:])
    whole = page("mlp", rows, 0, curves, learned, rest, "", origin)
    assert "Circles mark the 8 samples that it had to predict; those that it observed are not drawn." in whole
    bare = page("mlp", rows, 0, curves, [], None, "", {"with": "ballfg 1"})
    assert "Lower optimizer.learning_rate" in bare
    for word in TERMS:  # a word that is explained is used elsewhere on the page
        assert words[: words.index("What the words mean")].lower().count(word.lower()), word
    assert "nan" not in " ".join(HtmlPage(bare).words)


def test_a_training_that_does_not_improve_says_so_and_ends_with_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (
        "data: plain\nkind: falling-balls\nseed: 3\noptimizer: {learning_rate: 2.0, batch: 4, epochs: 2, clip: null}\n"
    )
    (tmp_path / "bad.yaml").write_text(words)
    (tmp_path / "good.yaml").write_text(words.replace("2.0", "0.05"))
    for name, status in (("bad", 1), ("good", 0)):
        with pytest.raises(SystemExit) as ended:
            command([str(tmp_path / f"{name}.yaml"), "--out", str(tmp_path / name), "jobs=1"])
        said = capsys.readouterr().out
        rows = read_metrics(tmp_path / name / "metrics.csv")
        first, *later = [row.validation_rmse for row in rows]
        assert (min(later) < first) == (status == 0)
        assert ended.value.code == status
        assert ("The training did not help" in said) == bool(status)
        assert ("the trained model" in said) == (not status)
        page = (tmp_path / name / "training.html").read_text(encoding="utf-8")
        for words in ("did not help", "The model file holds the model before the first step."):
            assert (words in page, words in said) == (bool(status),) * 2
    start = load_file(tmp_path / "bad" / "ball.safetensors")
    assert torch.equal(start["gravity"], balls.Ball().gravity.detach())


def test_without_validation_the_status_is_0(tmp_path: Path) -> None:
    settings = config(0.05, 1, split=SplitConfig(by="none"))
    assert training.run_training(settings, tmp_path / "run") == 0


def test_ctrl_c_leaves_the_best_model_so_far_and_resume_ends_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    training.run_training(config(0.05, 3), whole)
    real = record.write_checkpoint

    def write(folder: Path, checkpoint: Any) -> None:
        real(folder, checkpoint)
        if checkpoint.progress.epoch == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(record, "write_checkpoint", write)
        with pytest.raises(KeyboardInterrupt):
            training.run_training(config(0.05, 3), stopped)
    said = capsys.readouterr().err
    rows = read_metrics(stopped / "metrics.csv")
    best = min(rows, key=lambda row: row.validation_rmse or np.inf).epoch
    assert f"{stopped / 'ball.safetensors'}: the best model so far, of epoch {best}" in said
    kept = load_file(stopped / "checkpoint" / "best.safetensors")
    assert torch.equal(load_file(stopped / "ball.safetensors")["drag"], kept["drag"])
    assert "training" in (stopped / "training.html").read_text(encoding="utf-8")
    training.run_training(config(0.05, 3), stopped, resume=True)
    for file in ("ball.safetensors", "checkpoint/weights.safetensors", "checkpoint/optimizer.safetensors"):
        assert (stopped / file).read_bytes() == (whole / file).read_bytes()
    pairs = zip(read_metrics(stopped / "metrics.csv"), read_metrics(whole / "metrics.csv"), strict=True)
    assert all(replace(a, seconds=0.0) == replace(b, seconds=0.0) for a, b in pairs)


def test_the_analytic_model_stands_beside_the_trained_one() -> None:
    """A network that is better than before its first step may still be worse than no network."""
    trained = epochs(0.0696, 0.0267)
    assert beside_untrained(trained, 1, 0.019) == (
        "The analytic model alone predicts them to 19.0 mm, which is better still: train longer, or keep that one."
    )
    assert beside_untrained(trained, 1, 0.05) == "The analytic model alone predicts them to 50.0 mm."
    assert beside_untrained(trained, 1, None) == ""
