"""A small model with data of its own, for the tests of the loop: drag and gravity of falling balls, by rollouts.

It is registered as the kind `falling-balls`. `python falling_ball.py CONFIG.yaml --data WORDS ...` is `ballfg-train`
with this kind; the words of `data` say what its tracks are like.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from ballfg.learning.config.training import TrainConfig
from ballfg.learning.trainee import BatchLoss, Prepared, Trainee, TraineeKind, register_trainee

TRUE_DRAG, TRUE_GRAVITY = 0.4, 9.81
TIMES = torch.linspace(0.0, 0.6, 13, dtype=torch.float64)
NOISE = 0.001


class Ball(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.drag = nn.Parameter(torch.tensor(0.0, dtype=torch.float64))
        self.gravity = nn.Parameter(torch.tensor([8.0], dtype=torch.float64))

    def forward(self, velocity: Tensor) -> Tensor:
        """Positions (n, k, 2) from rest at the origin of velocities (n, 2), by steps of Heun."""
        position, places = torch.zeros_like(velocity), [torch.zeros_like(velocity)]
        for dt in TIMES.diff():
            ahead = velocity + dt * self.acceleration(velocity)
            following = velocity + 0.5 * dt * (self.acceleration(velocity) + self.acceleration(ahead))
            position, velocity = position + 0.5 * dt * (velocity + following), following
            places.append(position)
        return torch.stack(places, dim=1)

    def acceleration(self, velocity: Tensor) -> Tensor:
        down = torch.stack((torch.zeros_like(self.gravity), -self.gravity), dim=-1)
        return -self.drag * velocity.norm(dim=-1, keepdim=True) * velocity + down


@register_trainee
class FallingBalls(Trainee, TraineeKind):
    """Tracks whose first velocity is not known: each visit improves it, from where the last one left it."""

    name = "falling-balls"

    def __init__(self, words: Sequence[str], seed: int, tracks: int = 13) -> None:
        self.words, self.seed = words, seed
        self.velocities: dict[int, Tensor] = {}
        self.module = Ball()
        random = torch.Generator().manual_seed(seed)
        truth = Ball()
        with torch.no_grad():
            truth.drag.fill_(TRUE_DRAG)
            truth.gravity.fill_(TRUE_GRAVITY)
            start = torch.tensor([4.0, 3.0]) + torch.randn(tracks, 2, generator=random, dtype=torch.float64)
            places = truth(start)
        self.measured = places + NOISE * torch.randn(places.shape, generator=random, dtype=torch.float64)

    @classmethod
    def build(cls, config: TrainConfig) -> Prepared:
        assert config.data is not None
        if "missing" in config.data:
            raise FileNotFoundError("dataset missing does not exist.")
        print("note: read", file=sys.stderr)
        validation = range(10, 10 if config.split.by == "none" else 13)
        return Prepared(cls(config.data, config.seed), range(10), validation)

    def export(self, folder: Path) -> Path:
        save_file(self.module.state_dict(), folder / "ball.safetensors")
        return folder / "ball.safetensors"

    def loss(self, tracks: Sequence[int], epoch: int) -> BatchLoss:
        if "slow" in self.words:
            time.sleep(0.1)
        if "infinite" in self.words and epoch >= 1:
            return BatchLoss(self.module.drag * np.inf, len(tracks), 1.0, 1)
        failed = [track for track in tracks if f"failing-{track}" in self.words]
        good = [track for track in tracks if track not in failed]
        told = tuple((f"ball-{track}", "it was not seen") for track in failed)
        if not good:
            return BatchLoss(torch.zeros((), dtype=torch.float64), 0, 0.0, 0, told)
        weights = torch.tensor([np.random.default_rng((self.seed, epoch, track)).uniform(0.5, 1.5) for track in good])
        errors = self.errors(good)
        total = (weights * errors.square().sum(dim=(1, 2))).sum() / NOISE**2 / len(TIMES)
        return BatchLoss(total, len(good), float(errors.detach().square().sum()), len(good) * len(TIMES), told)

    def judge(self, tracks: Sequence[int]) -> BatchLoss:
        with torch.no_grad():
            squares = float(self.errors(tracks).square().sum())
        return BatchLoss(torch.tensor(squares), len(tracks), squares, len(tracks) * len(TIMES))

    def errors(self, tracks: Sequence[int]) -> Tensor:
        measured = self.measured[list(tracks)]
        guesses = (measured[:, 2] - measured[:, 0]) / TIMES[2]
        start = torch.stack([self.velocities.get(t, guess) for t, guess in zip(tracks, guesses, strict=True)])
        with torch.no_grad():
            rest = measured - self.module(start)
            better = start + (TIMES[:, None] * rest).sum(dim=1) / TIMES.square().sum()
        self.velocities |= dict(zip(tracks, better, strict=True))
        return self.module(better) - measured

    def groups(self) -> list[dict[str, object]]:
        return [
            {"name": "drag", "params": [self.module.drag], "scale": 1.0},
            {"name": "gravity", "params": [self.module.gravity], "scale": 2.0},
        ]

    def after_step(self) -> None:
        with torch.no_grad():
            self.module.drag.clamp_(min=0.0)

    def memory(self) -> dict[str, Tensor]:
        return {f"{track}.velocity": velocity for track, velocity in self.velocities.items()}

    def remember(self, memory: dict[str, Tensor]) -> None:
        self.velocities = {int(name.split(".")[0]): tensor for name, tensor in memory.items()}


if __name__ == "__main__":
    from ballfg.learning.cli import run

    run()
