"""The rows of the dynamics comparison."""

from __future__ import annotations

from typing import Final

from ballfg.benchmarks.dynamics.contenders import (
    Job,
    Method,
    adapting_contender,
    nominal_contender,
    truth_contender,
)
from ballfg.benchmarks.dynamics.recipes import RESIDUAL
from ballfg.benchmarks.dynamics.trained import recipe, trained_contender


def _untrained(job: Job) -> str:
    return "untrained"


SEQUENCES: Final = ("lstm+aug", "diffusion+aug")
"""Know the settings of the launchers that they learned from, and nothing of spin."""
TRAINED: Final = (*SEQUENCES, "a-tune+aug", "mlp+aug", "mlp+gs", "skip+gs", "mnn+gs")
"""As in the paper's table."""

METHODS: Final = {
    "truth": Method(truth_contender, _untrained, trained=False, takes_part="simulated"),
    "nominal": Method(nominal_contender, _untrained, trained=False),
    "nominal+track": Method(adapting_contender, _untrained, trained=False, takes_part="measured"),
    **{name: Method(trained_contender, recipe, transfers=name not in SEQUENCES) for name in TRAINED},
    RESIDUAL: Method(trained_contender, recipe, takes_part="measured"),
}
"""Every method by name, in the order of the table: controls, then those that learn. `nominal+track` is the nominal
model with coefficients of each track's own, `analytic+mnn` the nominal model with a network that corrects it."""
