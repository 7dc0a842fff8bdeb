"""A small valid dataset that a test can spoil in one place."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ballfg.tracks import TABLE_TENNIS, Track
from ballfg.tracks.info import DatasetInfo

YAML = "name: small\nframe: {up: z, table_height: 0.76}\nball: {radius: 0.02, mass: 0.0027}\nrate: 100\n"
TRACKS = """trajectory,t,x,y,z
000,0.00,0.0,0.1,1.00
000,0.01,0.05,0.1,1.01
000,0.02,0.10,0.1,1.02
b,0.00,0.0,0.2,1.00
b,0.01,0.05,0.2,1.01
"""


@pytest.fixture
def make_folder(tmp_path: Path) -> Callable[..., Path]:
    """Writes a dataset folder; each file can be replaced by other text or bytes, or left out with None."""

    def make(
        tracks: str | bytes | None = TRACKS, yaml: str | bytes | None = YAML, labels: str | bytes | None = None
    ) -> Path:
        folder = tmp_path / "small"
        folder.mkdir()
        for name, content in {"tracks.csv": tracks, "dataset.yaml": yaml, "labels.csv": labels}.items():
            if content is not None:
                (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return folder

    return make


@pytest.fixture
def info() -> DatasetInfo:
    return DatasetInfo("synthetic", 0.76, TABLE_TENNIS, rate=150.0, position_noise=0.002, source="a: 'quoted' one")


@pytest.fixture
def make_tracks() -> Callable[..., list[Track]]:
    """Parabolas with noise, so that every float uses all its digits."""

    def make(count: int, samples: int = 20, *, sigmas: bool = False) -> list[Track]:
        rng = np.random.default_rng(7)
        tracks = []
        for i in range(count):
            t = np.sort(rng.uniform(0, samples / 150, samples))
            p = np.stack([4 * t, 0.1 * t, 1 - 4.9 * t**2], axis=1) + rng.normal(0, 2e-3, (samples, 3))
            s = rng.uniform(1e-3, 2e-3, (samples, 3)) if sigmas else None
            labels = {"spin_x": rng.normal(), "spin_y": rng.normal(), "spin_z": 2.0, "group": f"{i % 2}"}
            tracks.append(Track(t, p, s, labels, name=f"{i:03d}"))
        return tracks

    return make
