"""Copies of a model with other effects or coefficients."""

import copy
from collections.abc import Mapping

import torch

from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effect import Effect


def has_effect(model: AnalyticModel, name: str) -> bool:
    """True if the model declares an effect."""
    return any(effect.name == name for effect in model.effects)


def with_effects(model: AnalyticModel, *effects: Effect) -> AnalyticModel:
    """A copy of a model with further effects; its parameters are fixed (`requires_grad` is off)."""
    return _of_effects(model, [*copy.deepcopy(model.effects), *effects])


def with_coefficients(model: AnalyticModel, values: Mapping[str, float]) -> AnalyticModel:
    """A copy as of `with_effects` with other values of its coefficients; names that are none of them do not count."""
    changed = with_effects(model)
    with torch.no_grad():
        for name, parameter in changed.named_parameters():
            if name in values:
                parameter.fill_(values[name])
    return changed


def without_effect(model: AnalyticModel, name: str) -> AnalyticModel:
    """A copy of a model without one of its effects, and without those that need it."""
    return _of_effects(model, [copy.deepcopy(e) for e in model.effects if e.name != name and name not in e.needs])


def _of_effects(model: AnalyticModel, effects: list[Effect]) -> AnalyticModel:
    return AnalyticModel(effects, radius=model.radius, inertia_factor=model.inertia_factor).requires_grad_(False)
