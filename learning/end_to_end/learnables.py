"""Holds the learnable parameters of an estimator: the ball's model, the launcher's embedding, the noise."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import Noise
from ballfg.factors.noise import PROCESS_NOISE, ProcessNoise

LEARNED_NOISE = ("acceleration", "spin", "contact_velocity", "contact_tangential", "contact_spin")
"""Numbers of the process noise that are learned. A hit can have any strength, so that its noise is not."""
WIDEST = 12.0  # Standard deviations stay between exp(-WIDEST) and exp(WIDEST) times their starting values


class NoiseScales(nn.Module):
    """Standard deviations as logarithms relative to their starting values.

    Args:
        process: starting values. Numbers that are zero stay zero.
        position: starting value, as a multiple of the noise that datasets and tracks state.
        learned: False keeps all of them fixed.
    Attributes:
        process, position, spin: (q,), (), () logarithms of the numbers `names`, of the scales of positions and labels.
    """

    def __init__(self, process: ProcessNoise, *, position: float = 1.0, learned: bool) -> None:
        super().__init__()
        self.start = process
        self.learned = learned
        self.names = tuple(name for name in LEARNED_NOISE if getattr(process, name) > 0.0)
        self.process = nn.Parameter(torch.zeros(len(self.names), dtype=torch.float64), requires_grad=learned)
        start = torch.tensor(position, dtype=torch.float64).log()
        self.position = nn.Parameter(start, requires_grad=learned)
        self.spin = nn.Parameter(torch.zeros((), dtype=torch.float64), requires_grad=learned)

    def noise(self) -> Noise:
        """The noise relative to factors that were built with the present `settings`."""
        if not self.learned:
            return Noise()
        start = torch.tensor([getattr(self.start, name) for name in PROCESS_NOISE], dtype=torch.float64)
        where = torch.tensor([PROCESS_NOISE.index(name) for name in self.names])
        process = start.index_put((where,), start[where] * self.process.exp())
        position = (self.position - self.position.detach()).exp()
        return Noise(process, position, (self.spin - self.spin.detach()).exp())

    def values(self) -> dict[str, float]:
        """The learned numbers of the process noise, by name."""
        scales = self.process.detach().exp().tolist()
        return {name: getattr(self.start, name) * scale for name, scale in zip(self.names, scales, strict=True)}

    def position_scale(self) -> float:
        """Standard deviation of a measured position as a multiple of the dataset's."""
        return float(self.position.detach().exp())

    def spin_scale(self) -> float:
        """Standard deviation of spin labels and launcher settings as a multiple of its starting value."""
        return float(self.spin.detach().exp())

    def settings(self, settings: Settings) -> Settings:
        """A dataset's settings with the present noise."""
        spin = self.spin_scale()
        launcher = settings.launcher
        return replace(
            settings,
            position_scale=self.position_scale(),
            spin_label_noise=settings.spin_label_noise * spin,
            launcher=None if launcher is None else replace(launcher, sigma=launcher.sigma * spin),
            process=replace(self.start, **self.values()),
        )

    @torch.no_grad()
    def bound(self) -> None:
        """Clip the logarithms, so that all numbers stay positive and finite."""
        for parameter in self.parameters():
            parameter.clamp_(-WIDEST, WIDEST)


class Learnables(nn.Module):
    """A ball's model, an embedding of launcher settings (or None), and the noise."""

    def __init__(self, model: BallModel, embedding: SpinEmbedding | None, noise: NoiseScales) -> None:
        super().__init__()
        self.model = model
        self.embedding = embedding
        self.noise = noise

    def leaves(self) -> list[Tensor]:
        """All trainable parameters."""
        return [p for p in self.parameters() if p.requires_grad]

    def groups(self, scales: Mapping[str, float]) -> list[dict[str, Any]]:
        """Parameter groups by prefix of the name, with scales on the learning rate; the first that fits decides."""
        members = defaultdict[str, list[Tensor]](list)
        for name, parameter in self.named_parameters():
            if parameter.requires_grad:
                members[next(prefix for prefix in scales if name.startswith(prefix))].append(parameter)
        return [{"name": p, "params": members[p], "scale": scale} for p, scale in scales.items() if p in members]

    @torch.no_grad()
    def bound(self) -> None:
        """Clip declared coefficients and the noise to their bounds."""
        parameters = dict(self.model.named_parameters())
        for name, coefficient in self.model.declared_coefficients().items():
            parameters[name].clamp_(coefficient.low, coefficient.high)
        self.noise.bound()
