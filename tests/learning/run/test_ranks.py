from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from threading import Thread

import pytest
import torch
from safetensors.torch import load_file

from ballfg.learning.cli import run
from ballfg.learning.config.config_file import read_config
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.run import ranks as launching
from ballfg.learning.run.ranks import Ranks, SharedMemory, for_others, join_ranks, launch
from ballfg.learning.run.run_folder import read_checkpoint, read_metrics
from ballfg.learning.run.training import run_training
from ballfg.progress import progress
from tests.faults.kills import in_fork
from tests.learning.run import falling_ball
from tests.learning.run.talking_ranks import die, talk
from tests.parallel.test_processes import gone
from tests.places import ROOT

BALL = Path(__file__).parent / "falling_ball.py"
TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2")
CONFIG = "kind: falling-balls\nseed: 3\noptimizer: {learning_rate: 0.02, batch: 3, epochs: 3}\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs")
    (path / "train.yaml").write_text(CONFIG)
    return path


@pytest.fixture
def script(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """This process becomes one that was started as `falling_ball.py` in the folder of the runs."""
    monkeypatch.chdir(folder)
    monkeypatch.setitem(sys.modules, "__main__", falling_ball)  # processes import the module of their starter first


def trained(capfd: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    """`ballfg-train` in this process: its status, and what it and the processes that it starts print."""
    with pytest.raises(SystemExit) as exit_:
        run(["train.yaml", *words])
    assert isinstance(exit_.value.code, int)
    return exit_.value.code, *capfd.readouterr()


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


@pytest.mark.thorough
@pytest.mark.usefixtures("script")
def test_torchrun_and_another_number_of_processes_on_resume_give_what_one_gives(
    folder: Path, one: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    command = [*TORCHRUN, str(BALL), "train.yaml", "--data", "plain", "--out", "torchrun"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("epoch 3/3") == 1
    check_same(one, folder / "torchrun")
    shutil.copytree(one, folder / "more")
    for name, jobs in (("torchrun", "jobs=1"), ("more", "jobs=2")):
        status, printed, said = trained(capfd, "--data", "plain", "--resume", name, jobs, "optimizer.epochs=5")
        assert (status, said) == (0, "note: read\n")
        assert printed.count("epoch 5/5") == 1
    check_same(folder / "torchrun", folder / "more")
    assert len(read_metrics(folder / "more" / "metrics.csv")) == 6


@pytest.mark.thorough
@pytest.mark.usefixtures("script")
def test_a_stop_is_said_once(capfd: pytest.CaptureFixture[str]) -> None:
    failing = ("--data", "failing-1", "--data", "failing-4", "--data", "failing-7")
    status, _, said = trained(capfd, *failing, "--out", "stopped", "jobs=2")
    assert status == 2
    assert said.count("ballfg: error: more than 20 % of the 10 training tracks failed in one epoch") == 1
    assert said.count("\n") == 2  # with the note


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.thorough)])
@pytest.mark.usefixtures("script")
def test_ctrl_c_keeps_the_last_epoch(tmp_path: Path, jobs: int) -> None:
    """Ctrl-C after the second epoch, in a copy of this process."""
    out, heard = tmp_path / "interrupted", tmp_path / "heard"

    def interrupt() -> None:
        while "epoch 2/300" not in heard.read_text():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    def train() -> None:
        # whoever starts the tests in the background has them ignore Ctrl-C, and their children too
        signal.signal(signal.SIGINT, signal.default_int_handler)
        Thread(target=interrupt, daemon=True).start()
        run(["train.yaml", "--data", "slow", "optimizer.epochs=300", f"jobs={jobs}", "--out", str(out)])

    status, said = in_fork(train, heard), heard.read_text()
    assert status == 130
    assert said.count("note: read\n") == 1
    assert said.splitlines()[-3:] == [
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


def test_trainings_at_the_same_time_meet_at_ports_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each holds its port while its processes start; none of them is one that only the system may take."""
    ports: list[int] = []

    def started(_: object, arguments: tuple[int, int], **__: object) -> None:
        ports.append(arguments[1])
        if len(ports) < 2:
            launch(2, die)
        raise ChildProcessError("both have met")

    monkeypatch.setattr(launching, "start_processes", started)
    with pytest.raises(ChildProcessError, match="both have met"):
        launch(2, die)
    assert len(set(ports)) == 2
    assert min(ports) > 1023


def test_a_killed_process_is_told() -> None:
    with pytest.raises(ChildProcessError, match=r"training process \d was ended from outside \(SIGKILL\)\. Memory may"):
        launch(1, die)


def test_processes_end_with_the_one_that_started_them(tmp_path: Path) -> None:
    (tmp_path / "waits.py").write_text(
        "import os, time\ndef wait():\n    print(os.getpid(), flush=True)\n    time.sleep(60)\n"
    )
    code = "from ballfg.learning.run.ranks import launch\nfrom waits import wait\nlaunch(2, wait)"
    path = os.pathsep.join((str(tmp_path), str(ROOT)))
    process = subprocess.Popen(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path}, stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout is not None
        others = [int(process.stdout.readline()) for _ in range(2)]
        process.kill()
    assert gone(others)


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
    assert isinstance(for_others(1, KeyboardInterrupt()), KeyboardInterrupt)
    told = for_others(1, FileNotFoundError("no data. Give some."))
    assert isinstance(told, ValueError)
    assert str(told) == "no data. Give some."
    fault = for_others(1, ZeroDivisionError("x"))
    assert isinstance(fault, RuntimeError)
    assert "process 1 failed:\n" in str(fault)
    assert "ZeroDivisionError: x" in str(fault)
