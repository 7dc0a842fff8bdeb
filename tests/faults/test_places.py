"""Two writers at one place, places where nothing can be written, and users without a home."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import pytest

import tests.learning.run.falling_ball  # noqa: F401 - registers its kind
from ballfg.dynamics.compiled.kept import cache_folder
from ballfg.files.whole_file import whole_file
from ballfg.files.whole_folder import reserved
from ballfg.learning.config.training import OptimizerConfig, TrainConfig
from ballfg.learning.run import run_folder
from ballfg.learning.run.training import run_training
from tests.commands import refused, status
from tests.faults.injection import FORBIDDEN
from tests.faults.kills import Tally, run
from tests.faults.scenarios import SCENARIOS, TRACKS, pass_on, warm_up
from tests.places import ROOT

T = TypeVar("T")


def elsewhere(work: Callable[[], T]) -> T:
    """Does some work in another thread, for which locks are those of another process."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(work).result()


def test_a_second_command_is_refused_in_one_line(tmp_path: Path) -> None:
    out = tmp_path / "shots"
    with reserved(out):
        said = elsewhere(lambda: refused("simulate", "--out", out, *TRACKS))
    assert f"{out} is being written by process {os.getpid()}. Wait for it" in said
    assert status("simulate", "--out", out, *TRACKS) == 0
    with reserved(out):
        assert elsewhere(lambda: status("simulate", "--out", out, *TRACKS, "--force")) == 2
    table = tmp_path / "states.csv"
    with whole_file(table) as temporary:
        temporary.write_text("first")
        said = elsewhere(lambda: refused("estimate", out, "--out", table, "--jobs", 1))
        assert "is being written by process" in said
    assert table.read_text() == "first"


def test_two_trainings_into_one_folder(tmp_path: Path) -> None:
    def config(seed: int) -> TrainConfig:
        optimizer = OptimizerConfig(learning_rate=0.05, batch=4, epochs=1, schedule="constant")
        return TrainConfig(kind="falling-balls", seed=seed, data="plain", optimizer=optimizer)

    folder = tmp_path / "runs" / "one"
    with run_folder.running(folder, config(1), resume=False), pytest.raises(ValueError, match="is being written by"):
        elsewhere(lambda: run_training(config(2), folder, watch=pass_on))
    assert not (tmp_path / "runs").exists()
    run_training(config(1), folder, watch=pass_on)
    with pytest.raises(ValueError, match="must not hold an earlier run"):
        run_training(config(2), folder, watch=pass_on)
    assert "seed: 1" in (folder / "config.yaml").read_text()


@pytest.mark.parametrize("name", ["simulate-csv-over-parquet", "checkpoint"])
def test_without_permission_the_old_result_stays(name: str) -> None:
    warm_up()
    tally = Tally()
    run({scenario.name: scenario for scenario in SCENARIOS}[name], tally, 2, FORBIDDEN, lasting=True)
    assert tally.wrong == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_is_read_only_is_refused_in_one_line(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert "Permission denied" in refused("simulate", "--out", tmp_path / "shots", *TRACKS)


@pytest.mark.thorough
def test_a_home_in_which_nothing_can_be_written(tmp_path: Path) -> None:
    """Compiled functions then go to a temporary folder, where the next start finds them; /proc refuses root too."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    words = ["simulate", "--out", str(tmp_path / "shots"), *map(str, TRACKS)]
    code = f"from ballfg.cli.main import run; run({words!r})"
    environment = {key: value for key, value in os.environ.items() if key not in ("BALLFG_CACHE", "XDG_CACHE_HOME")}
    said = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=environment | {"HOME": "/proc/nowhere", "PYTHONPATH": str(ROOT), "TMPDIR": str(temporary)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert said.returncode == 0, said.stderr
    assert (tmp_path / "shots" / "truth.yaml").is_file()
    assert [path.name for path in temporary.iterdir()] == [f"ballfg-{os.getuid()}"]
    assert list(temporary.rglob("*.nbc"))


def test_a_user_without_a_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def nobody() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("BALLFG_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", nobody)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    cache_folder.cache_clear()
    try:
        assert cache_folder() == tmp_path / f"ballfg-{os.getuid()}" / "cache"
    finally:
        cache_folder.cache_clear()
