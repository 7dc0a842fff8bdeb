"""Each model can learn: four tracks are known to millimetres."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.learning.sequence.data import collate, example
from ballfg.learning.sequence.predictor import SequenceArchitecture, SequenceKind
from ballfg.tracks import Track

G, RESTITUTION, START = 9.81, 0.9, 0.5


def bouncing(number: int) -> Track:
    """A ball on parabolas that bounces once at z = 0, without noise."""
    times = 0.04 * np.arange(15)
    vx, vy, vz = 1.0 + number, 0.5 * (number - 1.5), 0.3 * number
    fall = (vz + np.sqrt(vz**2 + 2 * G * START)) / G
    up, after = RESTITUTION * (G * fall - vz), times - fall
    z = np.where(after < 0, START + vz * times - G / 2 * times**2, up * after - G / 2 * after**2)
    return Track(times, np.stack([vx * times, vy * times, z], axis=1), name=str(number))


@pytest.mark.parametrize(
    ("kind", "width", "steps", "rate"),
    [("lstm", 64, 500, 1e-2), pytest.param("diffusion", 16, 300, 4e-3, marks=pytest.mark.thorough)],
)
def test_four_tracks_are_learned_to_millimetres(kind: SequenceKind, width: int, steps: int, rate: float) -> None:
    examples = [example(bouncing(number), 5, torch.zeros(0, dtype=torch.float64)) for number in range(4)]
    batch = collate(examples)
    model = SequenceArchitecture(kind, width).untrained(examples, seed=0)
    optimizer = torch.optim.Adam(model.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        losses, _ = model.losses(batch, [(0, step, number) for number in range(4)])
        optimizer.zero_grad()
        losses.mean().backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        error = (model.predict(batch) - batch.rest)[batch.asked]
    assert float(error.square().sum(-1).mean().sqrt()) < 0.012
