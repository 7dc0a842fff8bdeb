"""Motion on another device than the processor's memory: every tensor that takes part is made there or brought there.

Without such a device it is seen from two sides. Tensors made without naming a device come out on one where values are
lost, and tensors that exist from the import on may only be asked for their copy.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode

from ballfg.dynamics import Architecture, BallModel, Surfaces, build, nominal_model, rollout
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.compiled import motion
from ballfg.dynamics.networks.architecture import DEFAULT_SIZES
from ballfg.factors.batch import Values
from ballfg.factors.dynamics import ContactFactors, FlightFactors, RestFactors
from ballfg.factors.noise import ProcessNoise

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
        made[kind] = build(Architecture.of(kind, residual=True), radius=0.02, base=nominal_model(0.02))
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


@pytest.mark.parametrize("name", models())
def test_all_tensors_of_a_rollout_are_made_or_brought_where_the_states_are(name: str) -> None:
    model = models()[name]
    with torch.no_grad():
        expected = rollout(model, STARTS, TIMES, TABLE)
    with torch.enable_grad(), torch.device("meta"), Elsewhere(constants()) as watched:  # grad: torch does the work
        states = rollout(model, STARTS, TIMES, TABLE)
    assert states.is_cpu
    assert not watched.mixed
    torch.testing.assert_close(states, expected, rtol=0, atol=1e-9)


KINDS = {
    "flight": lambda model, dt, noise: FlightFactors(model, np.arange(3), dt, noise),
    "contact": lambda model, dt, noise: ContactFactors(model, np.arange(3), dt, noise, np.zeros((3, 1))),
    "rest": lambda model, dt, noise: RestFactors(model, np.arange(3), dt, noise, np.zeros(3)),
}
LOW = np.array([[0.0, 0.0, 0.03 + 0.01 * i, 3.0, 0.5, -2.0, 10.0, 80.0, 20.0] for i in range(4)])


@pytest.mark.parametrize("augmented", [False, True])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", models())
def test_all_tensors_of_factors_are_made_or_brought_where_the_model_is(
    name: str, kind: str, augmented: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = models()[name]
    if augmented:
        model = AugmentedModel(model, [n for n, parameter in model.named_parameters() if not parameter.dim()][:2])
    dt = np.array([0.05, 0.06, 0.07])
    factors = KINDS[kind](model, dt, ProcessNoise().flight(dt))
    coefficients = model.means().detach().numpy().copy() if isinstance(model, AugmentedModel) else np.zeros(0)
    inputs = factors.inputs(Values(LOW, coefficients))
    expected, by_variable = factors.compute(slice(None), inputs)
    on_processor = factors.on(torch.device("cpu"))
    monkeypatch.setattr(motion, "functions_of", lambda model: None)  # machine code is of no use elsewhere
    known = constants()
    given: list[torch.Tensor] = []
    from_numpy = torch.from_numpy

    def noted(array: np.ndarray) -> torch.Tensor:
        given.append(from_numpy(array))
        known.add(id(given[-1]))
        return given[-1]

    monkeypatch.setattr(torch, "from_numpy", noted)
    with torch.device("meta"), Elsewhere(known) as watched:
        residual, jacobians = on_processor.compute(slice(None), inputs)
    assert not watched.mixed
    np.testing.assert_allclose(residual, expected, rtol=1e-9, atol=1e-7)
    for found, wanted in zip(jacobians, by_variable, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
