"""Makes AdamW over a trainee's parameters: groups, learning rate by step, state by parameter name."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from ballfg.learning.config.training import OptimizerConfig
from ballfg.learning.trainee import Trainee


def make_optimizer(trainee: Trainee, settings: OptimizerConfig) -> torch.optim.AdamW:
    """AdamW over the trainee's groups. Raises: ValueError: if one holds a parameter that the module does not name."""
    groups = trainee.groups()
    named = {id(parameter) for parameter in trainee.module.parameters()}
    for group in groups:
        if any(id(parameter) not in named for parameter in group["params"]):
            raise ValueError(f"group '{group['name']}' must hold parameters of the module; got another. Register it.")
    return torch.optim.AdamW(groups, lr=settings.learning_rate, weight_decay=settings.weight_decay)


def rate_factor(settings: OptimizerConfig, step: int, per_epoch: int) -> float:
    """Share of the full learning rate at a step, counted from 0 over all epochs."""
    warm, total = settings.warm_start_epochs * per_epoch, settings.epochs * per_epoch
    if step < warm:
        return (step + 1) / warm
    if settings.schedule == "constant":
        return 1.0
    return 0.5 * (1.0 + math.cos(math.pi * (step - warm) / (total - warm)))


def moments(optimizer: torch.optim.Optimizer, module: nn.Module) -> dict[str, Tensor]:
    """A copy of the optimizer's state, as `<parameter>/<moment>`."""
    return {
        f"{name}/{key}": tensor.clone()
        for name, parameter in module.named_parameters()
        if parameter in optimizer.state
        for key, tensor in optimizer.state[parameter].items()
    }


def restore_moments(optimizer: torch.optim.Optimizer, module: nn.Module, state: Mapping[str, Tensor]) -> None:
    """Restore the state that `moments` gave. Raises: KeyError: for a parameter that the module does not have."""
    parameters = dict(module.named_parameters())
    for name, tensor in state.items():
        parameter, _, moment = name.rpartition("/")
        optimizer.state[parameters[parameter]][moment] = tensor.clone()
