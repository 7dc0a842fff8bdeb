"""Every option of every command that takes a number of any size refuses what is none, in one line, before it works."""

from pathlib import Path

import numpy as np
import pytest

from ballfg.cli.main import app
from ballfg.cli.start import _command
from ballfg.tracks import TABLE_TENNIS, Track, write_dataset
from ballfg.tracks.info import DatasetInfo
from tests.commands import refused

WORDS = {
    "import": "{data}/tracks.csv --out {out}",
    "predict": "{data} --observe 0.1 --out {out}.csv",
    "live": "--replay {data}",
    "diagnose": "{data} --out {out}",
    "design": "{data} --stand x=0,y=-4,z=2 --cameras {data}/cameras.yaml",
    "simulate": "--out {out} --tracks 1",
    "render": "--out {out} --shots 1",
    "track": "{data}/tracks.csv --cameras {data}/cameras.yaml --out {out}",
    "calibrate-cameras": "--images a={data} --out {out}.yaml --board charuco --squares 7x5 --square 0.03 --marker 0.02",
}
"""What each command needs beside the number."""
MAY_BE_INFINITE = ("--patience",)


def _options() -> list[tuple[str, str]]:
    return [
        (name, max(option.opts, key=len))
        for name, command in _command(app).commands.items()
        for option in command.params
        if "float" in str(option.type_descriptor.annotation)
    ]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("numbers") / "data"
    t = np.arange(20) / 100.0
    track = Track(t, np.column_stack([3.0 * t, 0.0 * t, 1.2 - 4.9 * t**2]))
    write_dataset(folder, DatasetInfo("d", 0.76, TABLE_TENNIS, position_noise=0.003), [track])
    return folder


@pytest.mark.parametrize(("command", "option"), _options())
def test_what_is_no_number_is_refused(command: str, option: str, data: Path, tmp_path: Path) -> None:
    words = [word.format(data=data, out=tmp_path / "out") for word in WORDS[command].split()]
    for value in ("nan",) if option in MAY_BE_INFINITE else ("nan", "1e400", "-1e400"):
        said = refused(command, *words, f"{option}={value}")
        assert said.count("ballfg: error: ") == 1
        assert "got nan" in said or "got inf" in said or "got -inf" in said, said
        assert not list(tmp_path.iterdir())


def test_there_are_options_to_try() -> None:
    assert {command for command, _ in _options()} == set(WORDS)
