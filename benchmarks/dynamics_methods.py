"""The rows of the dynamics comparison."""

from __future__ import annotations

from typing import Final

from ballfg.benchmarks.dynamics_contenders import Method, nominal_contender, truth_contender
from ballfg.benchmarks.dynamics_trained import trained_contender

METHODS: Final = {
    "truth": Method(truth_contender, trained=False, needs_truth=True),
    "nominal": Method(nominal_contender, trained=False),
    "lstm+aug": Method(trained_contender),
    "diffusion+aug": Method(trained_contender),
    "a-tune+aug": Method(trained_contender),
    "mlp+aug": Method(trained_contender),
    "mlp+gs": Method(trained_contender),
    "skip+gs": Method(trained_contender),
    "mnn+gs": Method(trained_contender),
}
"""Every method by name, in the order of the table: two controls, then those of the paper."""
