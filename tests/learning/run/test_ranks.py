from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import tests.learning.run.falling_ball  # noqa: F401 - registers its kind
from ballfg.learning.config.config_file import read_config
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.run.checkpoint import read_checkpoint
from ballfg.learning.run.launch import launch
from ballfg.learning.run.metrics import read_metrics
from ballfg.learning.run.ranks import Ranks, SharedMemory, Trouble, join_ranks
from ballfg.learning.run.training import run_training
from ballfg.progress import progress
from tests.learning.run.talking_ranks import die, talk

BALL = Path(__file__).parent / "falling_ball.py"
TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2")
CONFIG = "kind: falling-balls\nseed: 3\noptimizer: {learning_rate: 0.02, batch: 3, epochs: 3}\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs")
    (path / "train.yaml").write_text(CONFIG)
    return path


def trained(folder: Path, *words: str, start: tuple[str, ...] = (sys.executable,)) -> subprocess.CompletedProcess[str]:
    given = [*start, str(BALL), "train.yaml", *words]
    return subprocess.run(given, cwd=folder, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="module")
def one(folder: Path) -> Path:
    config = read_config(folder / "train.yaml", ["data=plain"])
    assert isinstance(config, TrainConfig)
    run_training(config, folder / "one", resume=False, watch=progress)
    return folder / "one"


def check_same(a: Path, b: Path) -> None:
    """The same weights, up to the rounding of sums in another order."""
    x, y = read_checkpoint(a), read_checkpoint(b)
    assert x is not None
    assert y is not None
    for name in ("weights", "best", "optimizer", "memory"):
        left, right = getattr(x, name), getattr(y, name)
        assert left.keys() == right.keys()
        for key in left:
            torch.testing.assert_close(left[key], right[key], rtol=1e-9, atol=1e-12)
    for p, q in zip(read_metrics(a / "metrics.csv"), read_metrics(b / "metrics.csv"), strict=True):
        assert (p.loss or 0.0) == pytest.approx(q.loss or 0.0, rel=1e-9)
        assert p.validation_rmse == pytest.approx(q.validation_rmse, rel=1e-9)
    assert load_file(a / "ball.safetensors")["drag"] == pytest.approx(load_file(b / "ball.safetensors")["drag"])


def test_two_processes_give_what_one_gives(folder: Path, one: Path) -> None:
    done = trained(folder, "--data", "plain", "--out", "two", "jobs=2")
    assert (done.returncode, done.stderr) == (0, "note: read\n")
    assert done.stdout.count("epoch 3/3") == 1
    check_same(one, folder / "two")


@pytest.mark.slow
def test_torchrun_and_another_number_of_processes_on_resume_give_it_too(folder: Path, one: Path) -> None:
    done = trained(folder, "--data", "plain", "--out", "torchrun", start=TORCHRUN)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("epoch 3/3") == 1
    check_same(one, folder / "torchrun")
    shutil.copytree(one, folder / "more")
    for name, jobs in (("torchrun", "jobs=1"), ("more", "jobs=2")):
        done = trained(folder, "--data", "plain", "--resume", name, jobs, "optimizer.epochs=5")
        assert (done.returncode, done.stderr) == (0, "note: read\n")
    check_same(folder / "torchrun", folder / "more")
    assert len(read_metrics(folder / "more" / "metrics.csv")) == 6


@pytest.mark.slow
def test_a_stop_is_said_once(folder: Path) -> None:
    failing = ("--data", "failing-1", "--data", "failing-4", "--data", "failing-7")
    done = trained(folder, *failing, "--out", "stopped", "jobs=2")
    assert done.returncode == 2
    assert done.stderr.count("ballfg: error: more than 20 % of the 10 training tracks failed in one epoch") == 1
    assert done.stderr.count("\n") == 2  # with the note


def interrupted(folder: Path, *words: str) -> tuple[int, str]:
    """Ctrl-C after the second epoch. Returns: exit status and what it said."""
    given = [sys.executable, str(BALL), "train.yaml", "--data", "slow", "optimizer.epochs=300", *words]
    pipe = subprocess.PIPE
    # whoever starts the tests in the background has them ignore Ctrl-C, and their children too
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(given, cwd=folder, stdout=pipe, stderr=pipe, text=True, preexec_fn=heard) as process:
        assert process.stdout is not None
        _wait_for(iter(process.stdout), "epoch 2/300")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    return process.returncode, said


def _wait_for(lines: Iterator[str], beginning: str) -> None:
    while not next(lines).startswith(beginning):
        pass


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_ctrl_c_keeps_the_last_epoch(folder: Path, jobs: int) -> None:
    out = folder / f"interrupted-{jobs}"
    status, said = interrupted(folder, f"jobs={jobs}", "--out", str(out))
    assert status == 130
    assert said.splitlines()[1:] == [
        f"epochs up to 2 are kept; continue with --resume {out}",
        f"{out / 'ball.safetensors'}: the best model so far, of epoch 2",
        "ballfg: interrupted",
    ]
    kept = read_checkpoint(out)
    assert kept is not None
    assert kept.progress.epoch == 2
    assert [row.epoch for row in read_metrics(out / "metrics.csv")] == [0, 1, 2]
    assert not [path.name for path in out.iterdir() if path.name.startswith(".")]


def test_ranks_talk_and_end_together(tmp_path: Path) -> None:
    assert launch(2, talk, tmp_path) == 7
    first, second = (json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2))
    assert first["sum"] == second["sum"] == (torch.tensor([0.1, 1.0, 1e16]) * 3).tolist()
    assert first["gather"] == second["gather"] == ["rank 0", "rank 1"]
    assert first["from_first"] == second["from_first"] == "read by 0"
    assert (first["own"], second["own"]) == ([4], [5, 3])
    assert first["input"] == ["ValueError", "no data. Give some."]
    assert first["fault"][0] == "RuntimeError"
    assert "process 1 failed:\nTraceback" in first["fault"][1]
    assert "ZeroDivisionError: odd" in first["fault"][1]
    assert first["writing"] == ["OSError", "full"]
    assert first["interrupt"] == first["late interrupt"] == ["KeyboardInterrupt", ""]
    assert first["gather after interrupt"] == second["gather after interrupt"] == [3, 3]
    quiet = ("input", "fault", "writing", "interrupt", "late interrupt")
    assert [second[name] for name in quiet] == [["SystemExit", "1"]] * len(quiet)
    assert "gloo" not in "".join(first["threads"] + second["threads"])  # else ending the process is a race


def test_a_killed_process_is_told() -> None:
    with pytest.raises(ChildProcessError, match=r"training process \d was ended from outside \(SIGKILL\)\. Memory may"):
        launch(1, die)


def test_a_single_rank_needs_no_group() -> None:
    ranks = Ranks()
    values = torch.ones(3, dtype=torch.float64)
    assert ranks.sum(values) is values
    assert ranks.gather("a") == ["a"]
    assert ranks.from_first(lambda: 3) == 3
    with pytest.raises(KeyError):
        ranks.together(lambda: {}["a"])


class Talk(Ranks):
    """A rank that hears what it says and what another one says."""

    others: tuple[object, ...] = ()

    def gather(self, value: object) -> list[object]:  # type: ignore[override]
        return [value, *self.others]


def test_torchrun_may_start_a_single_rank(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C then stops it as it stops any program, while it runs and after it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    for name, value in (("RANK", 0), ("WORLD_SIZE", 1), ("MASTER_ADDR", "127.0.0.1"), ("MASTER_PORT", port)):
        monkeypatch.setenv(name, str(value))
    before = signal.getsignal(signal.SIGINT)
    with join_ranks() as ranks:
        assert (ranks.rank, ranks.size) == (0, 1)
        assert signal.getsignal(signal.SIGINT) is before
    assert signal.getsignal(signal.SIGINT) is before
    assert not torch.distributed.is_initialized()


def test_memory_of_other_ranks_does_not_grow_old() -> None:
    old, new = torch.zeros(2), torch.ones(2)
    memory = SharedMemory({"0": old, "1": old, "2": old})
    ranks = Talk(0, 2)
    ranks.others = (({"1": new}, ["2"]),)  # the other rank has visited track 1 and given track 2 up
    merged = memory.gather(ranks, {"0": new, "1": old, "2": old})
    assert merged.keys() == {"0", "1"}
    assert torch.equal(merged["0"], new)
    assert torch.equal(merged["1"], new)


def test_trouble_travels_in_kind() -> None:
    assert isinstance(Trouble.of(1, KeyboardInterrupt()).exception(), KeyboardInterrupt)
    told = Trouble.of(1, FileNotFoundError("no data. Give some.")).exception()
    assert isinstance(told, ValueError)
    assert str(told) == "no data. Give some."
    fault = Trouble.of(1, ZeroDivisionError("x")).exception()
    assert isinstance(fault, RuntimeError)
    assert "process 1 failed:\n" in str(fault)
    assert "ZeroDivisionError: x" in str(fault)
