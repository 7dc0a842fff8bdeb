from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch

from ballfg.files import whole_folder
from ballfg.learning.run.run_folder import Checkpoint, RunProgress, read_checkpoint, read_metrics, write_checkpoint


def made(epoch: int) -> Checkpoint:
    random = torch.Generator().manual_seed(epoch)
    tensors = [torch.randn(3, 2, generator=random, dtype=torch.float64) for _ in range(4)]
    return Checkpoint(
        progress=RunProgress(epoch=epoch, best_epoch=1, best_rmse=0.1 + 0.2, skipped_in_row=0, train=5, validation=2),
        weights={"layer.weight": tensors[0].T},  # not contiguous
        best={"layer.weight": tensors[1]},
        optimizer={"layer.weight/step": torch.tensor(3.0)},
        memory={"7.velocity": tensors[2], "empty": torch.zeros(0, dtype=torch.float64)},
    )


def same(a: Checkpoint | None, b: Checkpoint) -> bool:
    if a is None or a.progress != b.progress:
        return False
    parts: list[tuple[Any, Any]] = [(getattr(a, n), getattr(b, n)) for n in ("weights", "best", "optimizer", "memory")]
    return all(x.keys() == y.keys() and all(torch.equal(x[k], y[k]) for k in x) for x, y in parts)


def test_a_checkpoint_reads_back_bit_for_bit_and_the_next_takes_its_place(tmp_path: Path) -> None:
    assert read_checkpoint(tmp_path) is None
    write_checkpoint(tmp_path, made(1))
    assert same(read_checkpoint(tmp_path), made(1))
    write_checkpoint(tmp_path, made(2))
    assert same(read_checkpoint(tmp_path), made(2))
    assert os.listdir(tmp_path) == ["checkpoint"]


@pytest.mark.parametrize("done", [False, True])
def test_a_crash_leaves_the_old_or_the_new_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: bool
) -> None:
    write_checkpoint(tmp_path, made(1))
    real = whole_folder.exchange

    def exchange(one: Path, other: Path) -> None:
        if done:
            real(one, other)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(whole_folder, "exchange", exchange)
        with pytest.raises(KeyboardInterrupt):
            write_checkpoint(tmp_path, made(2))
    assert same(read_checkpoint(tmp_path), made(2 if done else 1))
    write_checkpoint(tmp_path, made(3))
    assert same(read_checkpoint(tmp_path), made(3))
    assert os.listdir(tmp_path) == ["checkpoint"]


def test_a_crash_while_tensors_are_written_leaves_the_old_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_checkpoint(tmp_path, made(1))
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError("no space")))
        with pytest.raises(OSError, match="no space"):
            write_checkpoint(tmp_path, made(2))
    assert same(read_checkpoint(tmp_path), made(1))


@pytest.mark.parametrize(
    ("name", "content"),
    [("state.yaml", b"epoch: 1\n"), ("state.yaml", b"["), ("weights.safetensors", b"\x80\x04pickled"), ("best", None)],
)
def test_a_damaged_checkpoint_is_refused(tmp_path: Path, name: str, content: bytes | None) -> None:
    write_checkpoint(tmp_path, made(1))
    if content is None:
        (tmp_path / "checkpoint" / f"{name}.safetensors").unlink()
    else:
        (tmp_path / "checkpoint" / name).write_bytes(content)
    with pytest.raises(ValueError, match=r"not a whole checkpoint \(.+\)\. Start a new run\."):
        read_checkpoint(tmp_path)


def test_a_flipped_bit_is_found(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, made(1))
    weights = tmp_path / "checkpoint" / "weights.safetensors"
    content = bytearray(weights.read_bytes())
    content[-8] ^= 1  # the lowest bit of a number
    weights.write_bytes(content)
    with pytest.raises(ValueError, match=r"tensors are not those that state\.yaml states: a file is damaged\)"):
        read_checkpoint(tmp_path)


def test_a_table_of_epochs_with_a_cell_without_end_is_refused(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("epoch,loss\n1," + "2" * 200_000 + "\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"not a table of epochs \(field larger than field limit"):
        read_metrics(tmp_path / "metrics.csv")
