"""Lists the methods of the dynamics comparison."""

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from ballfg.benchmarks.dynamics import contenders
from ballfg.benchmarks.dynamics.contenders import Contender, Job
from ballfg.benchmarks.dynamics.recipes import RESIDUAL
from ballfg.benchmarks.dynamics.task import Task
from ballfg.benchmarks.dynamics.trained import trained_contender


@dataclass(frozen=True)
class Method:
    """A row of the comparison.

    Attributes:
        make: a contender for one of the job's tasks; what the method learns is learned at the first of them.
        trained: True if a seed makes a difference; if not it runs once.
        takes_part: on which tracks: `all`, `simulated` or `measured` ones.
        transfers: True if it can be judged on tracks of a launcher outside of its training.
        package: required package of an extra; empty if there is none.
    """

    make: Callable[[Job, Task], Contender]
    trained: bool = True
    takes_part: Literal["all", "simulated", "measured"] = "all"
    transfers: bool = True
    package: str = ""

    @property
    def installed(self) -> bool:
        """True if its required package is installed."""
        return not self.package or importlib.util.find_spec(self.package) is not None

    def fits(self, tasks: Sequence[Task]) -> bool:
        """True if it takes part on these tracks."""
        return self.takes_part in ("all", "measured" if tasks[0].truth is None else "simulated")


SEQUENCES: Final = ("lstm+aug", "diffusion+aug")
"""Methods that know the settings of their training launchers, and nothing of spin."""
TRAINED: Final = (*SEQUENCES, "a-tune+aug", "mlp+aug", "mlp+gs", "skip+gs", "mnn+gs")
"""The methods of the paper's table."""

METHODS: Final = {
    "truth": Method(contenders.truth_contender, trained=False, takes_part="simulated"),
    "nominal": Method(contenders.nominal_contender, trained=False),
    "nominal+track": Method(contenders.adapting_contender, trained=False, takes_part="measured"),
    **{
        name: Method(
            trained_contender, transfers=name not in SEQUENCES, package="diffusers" if "diffusion" in name else ""
        )
        for name in TRAINED
    },
    RESIDUAL: Method(trained_contender, takes_part="measured"),
}
"""Every method by name, in the order of the table: controls, then those that learn. `nominal+track` is the nominal
model with coefficients of each track's own, `analytic+mnn` the nominal model with a network that corrects it."""
