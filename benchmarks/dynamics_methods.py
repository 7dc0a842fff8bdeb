"""The rows of the dynamics comparison."""

from __future__ import annotations

from functools import partial
from typing import Final

from ballfg.benchmarks.dynamics_contenders import Method, nominal_contender, truth_contender
from ballfg.benchmarks.dynamics_trained import recipe, trained_contender


def _untrained(quick: bool) -> str:
    return "untrained"


def _trained(name: str) -> Method:
    return Method(trained_contender, partial(recipe, name))


TRAINED: Final = ("lstm+aug", "diffusion+aug", "a-tune+aug", "mlp+aug", "mlp+gs", "skip+gs", "mnn+gs")
"""As in the paper's table."""

METHODS: Final = {
    "truth": Method(truth_contender, _untrained, trained=False, needs_truth=True),
    "nominal": Method(nominal_contender, _untrained, trained=False),
} | {name: _trained(name) for name in TRAINED}
"""Every method by name, in the order of the table: two controls, then those that learn."""
