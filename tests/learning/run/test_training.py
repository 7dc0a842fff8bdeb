from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import tests.learning.run.falling_ball  # noqa: F401 - registers its kind
from ballfg.learning.config.training import OptimizerConfig, TrainConfig
from ballfg.learning.run import record, run_folder as files, training
from ballfg.learning.run.run_folder import Epoch, epoch_line, read_checkpoint, read_metrics, write_metrics
from ballfg.simulation import SimulationConfig, write_simulation


def pass_on(items: Iterable[list[int]], _total: int, _what: str) -> Iterator[list[int]]:
    return iter(items)


def config(*, epochs: int = 4, seed: int = 3, data: str = "plain", **fields: Any) -> TrainConfig:
    optimizer = OptimizerConfig(learning_rate=0.05, batch=4, epochs=epochs, schedule="constant")
    return TrainConfig(**{"kind": "falling-balls", "seed": seed, "data": data, "optimizer": optimizer} | fields)


def run(settings: TrainConfig, folder: Path, *, resume: bool = False) -> None:
    training.run_training(settings, folder, resume=resume, watch=pass_on)


@pytest.mark.parametrize("changed", ["tracks.csv", "labels.csv", "dataset.yaml"])
def test_a_run_is_not_continued_with_other_data(changed: str, tmp_path: Path) -> None:
    """Its errors before and after would be those of different tracks. What else lies in the folder does not matter."""
    data = str(tmp_path / "shots")
    write_simulation(data, SimulationConfig(tracks=1, rate=60.0, seed=1))
    run(config(epochs=1, data=data), tmp_path / "run")
    (tmp_path / "shots" / "predictions.csv").write_text("a result")
    run(config(epochs=2, data=data), tmp_path / "run", resume=True)
    with (tmp_path / "shots" / changed).open("a") as file:
        file.write("\n")
    with pytest.raises(ValueError, match=r"of the same data; dataset\.yaml or a table of .*shots.* has changed since"):
        run(config(epochs=3, data=data), tmp_path / "run", resume=True)
    kept = read_checkpoint(tmp_path / "run")
    assert kept is not None
    assert kept.progress.epoch == 2


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("training") / "run"
    run(config(), folder)
    return folder


def test_a_run_writes_all_its_files(finished: Path) -> None:
    written = {path.name for path in finished.iterdir()}
    assert written == (set(files.TRAINING) - {"model.yaml"}) | {"ball.safetensors"}
    assert yaml.safe_load((finished / "config.yaml").read_text())["optimizer"]["epochs"] == 4
    assert {"python", "torch", "safetensors"} <= json.loads((finished / "versions.json").read_text()).keys()
    assert (finished / "curves.png").read_bytes().startswith(b"\x89PNG")
    rows = read_metrics(finished / "metrics.csv")
    assert [row.epoch for row in rows] == [0, 1, 2, 3, 4]
    kept = read_checkpoint(finished)
    assert kept is not None
    assert torch.equal(load_file(finished / "ball.safetensors")["drag"], kept.best["drag"])
    assert kept.progress.best_rmse == min(row.validation_rmse for row in rows if row.validation_rmse)


def test_tensorboard_shows_the_same_numbers(finished: Path) -> None:
    events = EventAccumulator(str(finished / "tensorboard"))
    events.Reload()
    rows = read_metrics(finished / "metrics.csv")
    shown = {event.step: event.value for event in events.Scalars("rmse_mm/validation")}
    assert shown == {row.epoch: pytest.approx(1e3 * row.validation_rmse, rel=1e-6) for row in rows}
    assert [event.step for event in events.Scalars("loss/train")] == [1, 2, 3, 4]


def test_a_resumed_run_is_the_uninterrupted_one(finished: Path, tmp_path: Path, capsys: Any) -> None:
    folder = tmp_path / "run"
    run(config(epochs=2), folder)
    said = capsys.readouterr()
    assert "epoch 2/2: loss" in said.out
    assert said.out.splitlines()[-3] == f"{folder / 'ball.safetensors'}: the trained model"
    # rows that no checkpoint knows of are taken again
    rows = read_metrics(folder / "metrics.csv")
    write_metrics(folder / "metrics.csv", [*rows, replace(rows[-1], epoch=3)])
    written = folder / "config.yaml"
    assert "jobs: " in written.read_text()
    written.write_text(written.read_text().replace("jobs: ", "workers: "))  # as an older version wrote it
    with pytest.warns(DeprecationWarning, match="'workers' is the earlier name of 'jobs'"):
        run(config(epochs=4, jobs=2, checkpoint_every=2), folder, resume=True)
    assert "epoch 1/" not in capsys.readouterr().out
    for name in ("weights", "optimizer", "memory", "best"):
        file = f"checkpoint/{name}.safetensors"
        assert (folder / file).read_bytes() == (finished / file).read_bytes(), name
    assert (folder / "checkpoint/state.yaml").read_bytes() == (finished / "checkpoint/state.yaml").read_bytes()
    assert (folder / "ball.safetensors").read_bytes() == (finished / "ball.safetensors").read_bytes()
    pairs = zip(read_metrics(folder / "metrics.csv"), read_metrics(finished / "metrics.csv"), strict=True)
    assert all(replace(a, seconds=0.0) == replace(b, seconds=0.0) for a, b in pairs)


def test_ctrl_c_between_checkpoints_says_what_is_kept(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = record.write_metrics

    def write(path: Path, epochs: list[Epoch]) -> None:
        if epochs[-1].epoch == 3:
            raise KeyboardInterrupt
        real(path, epochs)

    monkeypatch.setattr(record, "write_metrics", write)
    with pytest.raises(KeyboardInterrupt):
        run(config(checkpoint_every=2), tmp_path / "run")
    assert f"epochs up to 2 are kept; continue with --resume {tmp_path / 'run'}" in capsys.readouterr().err
    assert (tmp_path / "run" / "curves.png").is_file()


def test_what_does_not_fit_is_refused_and_nothing_is_changed(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    for settings, resume, message in (
        (config(), False, "out must not hold an earlier run"),
        (config(seed=4), True, "'seed' was 3 and is 4"),
        (config(data="other"), True, r"'data' was \['plain'\] and is \['other'\]"),
        (config(kind="mlp"), True, "'kind' was 'falling-balls' and is 'mlp'"),
    ):
        with pytest.raises(ValueError, match=message):
            run(settings, folder, resume=resume)
    with pytest.raises(FileNotFoundError, match="--resume needs the folder of an earlier run"):
        run(config(), tmp_path / "none", resume=True)
    with pytest.raises(FileNotFoundError, match="dataset missing does not exist"):
        run(config(data="missing"), tmp_path / "none")
    assert not (tmp_path / "none").exists()
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_one_line_tells_of_an_epoch(tmp_path: Path) -> None:
    epoch = Epoch(3, 12.3456, 0.0311, 0.02529, 1e-3, 2.0, 1, 2, 0, 40.0)
    assert epoch_line(epoch, 9, 240.0) == (
        "epoch 3/9: loss 12.35, train RMSE 31.10 mm, validation RMSE 25.29 mm, 1 steps skipped, 2 tracks failed, "
        "40.0 s, about 4 min left"
    )
    nothing = Epoch(1, None, None, None, 1e-3, None, 5, 0, 3, 1.0)
    assert epoch_line(nothing, 1, 0.0) == (
        "epoch 1/1: no track learned from, train RMSE -, validation RMSE -, 5 steps skipped, "
        "3 validation tracks failed, 1.0 s"
    )
    write_metrics(tmp_path / "metrics.csv", [epoch, nothing])
    assert read_metrics(tmp_path / "metrics.csv") == [epoch, nothing]
    (tmp_path / "metrics.csv").write_text("epoch,loss\n1,2.0\n")
    with pytest.raises(ValueError, match="not a table of epochs"):
        read_metrics(tmp_path / "metrics.csv")
