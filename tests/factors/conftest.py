from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Rows, Values

NAMES = (
    "flight.drag.k",
    "flight.magnus.k",
    "bounce.restitution.e",
    "bounce.friction.mu",
    "bounce.table_height.offset",
)


@pytest.fixture
def model(every_effect: AnalyticModel) -> AnalyticModel:
    return every_effect


@pytest.fixture
def augmented(model: AnalyticModel) -> AugmentedModel:
    return AugmentedModel(model, NAMES)


@pytest.fixture
def coefficients(augmented: AugmentedModel) -> np.ndarray:
    """(5,) away from the model's own."""
    parameters = dict(augmented.model.named_parameters())
    return np.array([float(parameters[name].detach()) for name in NAMES]) * (1.1, 0.9, 0.98, 1.1, 0.5)


def offset(values: Values, variable: int) -> slice:
    """The columns of a variable in the dense Jacobian: states in order, then the coefficients."""
    if variable == COEFFICIENTS:
        return slice(values.states.size, values.states.size + len(values.coefficients))
    return slice(9 * variable, 9 * variable + 9)


@pytest.fixture
def dense() -> Callable[[Sequence[Rows], Values], tuple[np.ndarray, np.ndarray]]:
    """Residual (m,) and Jacobian (m, 9 n + p) of linearised rows, before the loss."""

    def assemble(linearized: Sequence[Rows], values: Values) -> tuple[np.ndarray, np.ndarray]:
        size = values.states.size + len(values.coefficients)
        residuals, jacobians = [], []
        for rows in linearized:
            for i, variables in enumerate(rows.variables.tolist()):
                jacobian = np.zeros((rows.residual.shape[1], size))
                for block, variable in zip(rows.jacobians, variables, strict=True):
                    jacobian[:, offset(values, variable)] += block[i]
                residuals.append(rows.residual[i])
                jacobians.append(jacobian)
        return np.concatenate(residuals), np.concatenate(jacobians)

    return assemble


STEPS = np.repeat((2e-4, 5e-4, 2e-2), 3)
"""m, m/s, rad/s: see `differences`."""


@pytest.fixture
def differences() -> Callable[[Callable[[np.ndarray], np.ndarray], np.ndarray, np.ndarray], np.ndarray]:
    """Derivative (..., d) of f(x) by x (..., d) along the last axis, f row-wise, by fourth-order central differences.

    Steps: 2e-4 m, 5e-4 m/s, 2e-2 rad/s, 1e-3 of a coefficient's size. Over them the motion of a ball in a frame is
    smooth to some 1e-3 of itself, so that truncation (step^4) is below 1e-12; rounding, eps |x| / step, is about 1e-11
    in position and velocity and 1e-10 of the largest element after whitening.
    """

    def jacobian(function, x: np.ndarray, steps: np.ndarray) -> np.ndarray:
        columns = []
        for j, h in enumerate(steps):
            unit = np.zeros(x.shape[-1])
            unit[j] = h
            at = {k: function(x + k * unit) for k in (-2, -1, 1, 2)}
            columns.append((8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * h))
        return np.stack(columns, axis=-1)

    return jacobian


@pytest.fixture
def check_jacobian(differences) -> Callable[[FactorBatch, Values], float]:
    """Worst error of a kind's Jacobians: each row relative to its largest element, or 1e-4 of its block's."""

    def check(kind: FactorBatch, values: Values) -> float:
        rows = kind.linearize(values)
        assert (np.linalg.norm(rows.residual, axis=-1) > 0.1).all(), "a zero residual hides errors"
        inputs = [np.array(values.gather(column)) for column in kind.variables.T]
        worst = 0.0
        for i, given in enumerate(rows.jacobians):
            steps = STEPS if kind.variables[0, i] != COEFFICIENTS else 1e-3 * np.abs(values.coefficients)

            def residual(x: np.ndarray, i: int = i) -> np.ndarray:
                return kind.compute(slice(None), (*inputs[:i], x, *inputs[i + 1 :]))[0]

            expected = differences(residual, inputs[i], steps)
            assert expected.shape == given.shape
            per_row, per_block = np.abs(expected).max(axis=2), np.abs(expected).max(axis=(1, 2))
            scale = np.maximum(per_row, 1e-4 * per_block[:, None])[..., None]
            worst = max(worst, float((np.abs(given - expected) / scale).max()))
        print(f"{type(kind).__name__}: {worst:.1e}")  # shown by -s
        return worst

    return check
