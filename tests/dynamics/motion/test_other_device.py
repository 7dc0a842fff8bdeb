"""Motion on another device than the processor's memory: every tensor that takes part is made there or brought there.

Without such a device it is seen from two sides. Tensors made without naming a device come out on one where values are
lost, and tensors that exist from the import on may only be asked for their copy.
"""

from __future__ import annotations

import sys
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode

from ballfg.dynamics import Architecture, BallModel, Surfaces, build, nominal_model, rollout
from ballfg.dynamics.networks.architecture import DEFAULT_SIZES
from tests.small_networks import SMALL

TABLE = Surfaces(0.0, -0.76, (-1.0, 2.7, -0.8, 0.8))
TIMES = torch.arange(1, 80, dtype=torch.float64) / 50
STARTS = torch.tensor(
    [
        [0.0, 0.0, 0.3, 3.0, 0.5, 2.0, 0.0, 80.0, 20.0],
        [0.0, 0.0, 0.3, 1.0, 0.5, 0.0, 0.0, 80.0, 20.0],  # bounces often
        [2.6, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0, 80.0, 0.0],  # falls over the edge
    ],
    dtype=torch.float64,
)


def models() -> dict[str, BallModel]:
    made: dict[str, BallModel] = {"nominal": nominal_model(0.02)}
    for kind in DEFAULT_SIZES:
        made[kind] = build(Architecture.of(kind, residual=True, **SMALL), radius=0.02, base=nominal_model(0.02))
    return {name: model.requires_grad_(False) for name, model in made.items()}


class Elsewhere(TorchFunctionMode):
    """Answers a request for a constant with a copy, and notes functions that are given the constant itself."""

    def __init__(self, constants: set[int]) -> None:
        super().__init__()
        self.constants, self.mixed = constants, set[str]()

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.Tensor.to and id(args[0]) in self.constants:
            return func(*args, **(kwargs or {})).clone()
        for given in (*args, *(kwargs or {}).values()):
            parts = given if isinstance(given, (list, tuple)) else (given,)
            if any(isinstance(part, torch.Tensor) and id(part) in self.constants for part in parts):
                self.mixed.add(getattr(func, "__name__", str(func)))
        return func(*args, **(kwargs or {}))


def constants() -> set[int]:
    rooms = [vars(module) for name, module in sys.modules.items() if name.startswith("ballfg.") and module]
    found = {id(t) for room in rooms for t in room.values() if type(t) is torch.Tensor and t.dim()}
    assert found
    return found


QUICK = ("nominal", "mnn+gs")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.thorough] * (n not in QUICK)) for n in ("nominal", *DEFAULT_SIZES)]
)
@pytest.mark.usefixtures("networks_in_torch")
def test_all_tensors_of_a_rollout_are_made_or_brought_where_the_states_are(name: str) -> None:
    model = models()[name]
    with torch.no_grad():
        expected = rollout(model, STARTS, TIMES, TABLE)
    with torch.enable_grad(), torch.device("meta"), Elsewhere(constants()) as watched:  # grad: torch does the work
        states = rollout(model, STARTS, TIMES, TABLE)
    assert states.is_cpu
    assert not watched.mixed
    torch.testing.assert_close(states, expected, rtol=0, atol=1e-9)
