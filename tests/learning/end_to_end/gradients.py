"""A small network to train, and the gradient of its loss."""

from __future__ import annotations

import torch

from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import LearnedModel, build
from ballfg.learning.end_to_end.end_to_end import EndToEnd
from tests.learning.estimates import usual_ball
from tests.small_networks import SMALL


def network() -> LearnedModel:
    """A small network that corrects the usual ball."""
    architecture = Architecture.of("mnn+gs", **SMALL, residual=True)
    model = build(architecture, radius=0.02, base=usual_ball(), seed=3)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for weight in (*model.flight.parameters(), *model.contact.parameters()):
            weight += 0.01 * torch.randn(weight.shape, generator=generator, dtype=torch.float64)
    return model


def gradient(learner: EndToEnd, tracks=(0, 1, 2), epoch: int = 0) -> dict[str, torch.Tensor]:
    learner.module.zero_grad()
    learner.loss(tracks, epoch).total.backward()
    return {name: p.grad.clone() for name, p in learner.module.named_parameters() if p.grad is not None}
