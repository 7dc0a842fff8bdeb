"""`ballfg example`: two datasets that the other commands read, the second with what the first has not."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from ballfg.tracks import read_dataset
from tests.commands import printed, refused, status


def test_two_datasets_and_what_to_do_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    said = printed("example", "--tracks", 6).out
    names = {"shots": set(), "windy": {"wind"}}
    for name, undeclared in names.items():
        folder = Path("example") / name
        assert len(read_dataset(folder)) == 6
        assert set(yaml.safe_load((folder / "truth.yaml").read_text())["undeclared"]) == undeclared
        assert "wind" not in (folder / "model.yaml").read_text()
    (command,) = (line.split()[1:] for line in said.splitlines() if line.strip().startswith("ballfg estimate"))
    assert status(*command) == 0
    assert Path("states.csv").is_file()
    assert status("import", "example/capture.csv", "--out", "mine") == 0
    mine = read_dataset("mine")
    assert len(mine) == 6
    assert mine.info.table_height == pytest.approx(0.76, abs=0.01)
    assert "BSD-3-Clause" in said


def test_earlier_examples_stay_unless_forced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert status("example", "--tracks", 6) == 0
    before = (Path("example") / "shots" / "tracks.csv").read_bytes()
    assert "--force" in refused("example", "--tracks", 6, "--seed", 1)
    assert (Path("example") / "shots" / "tracks.csv").read_bytes() == before
    assert status("example", "--tracks", 6, "--seed", 1, "--force") == 0
    assert (Path("example") / "shots" / "tracks.csv").read_bytes() != before
