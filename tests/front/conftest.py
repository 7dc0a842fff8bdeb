"""A folder of shots, its dataset, the opening of its first track and the estimate of that."""

from __future__ import annotations

from pathlib import Path

import pytest

import ballfg as bf
from tests.front.my_shots import written


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("front") / "my_shots")


@pytest.fixture(scope="session")
def shots(folder: Path) -> bf.Dataset:
    return bf.read(folder)


@pytest.fixture(scope="session")
def track(shots: bf.Dataset) -> bf.Track:
    return shots["000"].until(0.35)


@pytest.fixture(scope="session")
def estimate(track: bf.Track) -> bf.Estimate:
    return bf.estimate(track)
