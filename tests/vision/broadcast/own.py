"""Writes what another detector of one's own might find: half of the balls, among twenty false candidates a picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ballfg.arrays import Array

KEPT, FALSE = 0.5, 20  # share of the balls; candidates a picture


def write_candidates(
    path: Path, balls: Mapping[int, Array], stamps: Array, size: tuple[int, int], sigma: float, seed: int
) -> None:
    """Writes a table for `--candidates`. Args: balls: (2,) px by picture.  size: px.  sigma: px, stated."""
    rng, lines = np.random.default_rng([seed, 5]), ["t,u,v,sigma_u,sigma_v"]
    for number, stamp in enumerate(stamps):
        spots = list(rng.uniform((0, 0), size, (FALSE, 2)))
        if number in balls and rng.random() < KEPT:
            spots.append(balls[number])
        lines += [f"{stamp:.6f},{u:.2f},{v:.2f},{sigma},{sigma}" for u, v in spots]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
