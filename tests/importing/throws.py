"""A ball that bounces once, and tables of text to import."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np


def thrown(noise: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A ball without drag that bounces at a centre height of 0.8 m after 0.35 s, with 0.9 of its speed."""
    t = np.arange(0.0, 0.7, 0.01)
    speed = 0.9 * (9.81 * 0.35 - 4.0 + 8.0)
    z = np.where(
        t < 0.35,
        0.8 + 4.0 * (0.35 - t) - 9.81 / 2 * t**2 + 9.81 / 2 * 0.35**2,
        0.8 + speed * (t - 0.35) - 9.81 / 2 * (t - 0.35) ** 2,
    )
    p = np.stack([5.0 * t, 0.3 * t, z], axis=1)
    return t, p + noise * np.random.default_rng(seed).standard_normal(p.shape)


def write_rows(path: Path, header: str, rows: Sequence[Sequence[object]], separator: str = ",") -> Path:
    """Write a table, without a header where that is empty; returns its path."""
    lines = [separator.join(str(cell) for cell in row) for row in rows]
    path.write_text("\n".join(([header] if header else []) + lines) + "\n", encoding="utf-8")
    return path
