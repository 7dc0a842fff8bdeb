"""Computes the gradient through a solver by the implicit function theorem.

A point x* with g(x*, theta) = 0, g the derivative of an objective by x, moves with the parameters theta as
dx*/dtheta = -H^-1 dg/dtheta, H = dg/dx. The gradient of an outer loss L(x*) by theta is -lambda^T dg/dtheta with
lambda = H^-1 dL/dx*. This takes one linear solution, independent of the solver's iterations.

A method takes the solve, the stationarity condition, the linear solver and the parameters as separate arguments.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

Solve = Callable[[], Tensor]  # Gives the point (n,), without a graph. It may raise anything where it finds none
Stationarity = Callable[[Tensor], Tensor]
"""g: from a point (n,) that requires a gradient to the objective's derivative (n,), differentiable in the point and in
the parameters."""


class LinearSolver(Protocol):
    """Solves with the Hessian, or with an approximation of it."""

    def __call__(self, product: Callable[[Tensor], Tensor], right: Tensor) -> Tensor:
        """The solution x (n,) of product(x) = right (n,)."""
        ...

    def precondition(self, vector: Tensor) -> Tensor:
        """The Gauss-Newton solution (n,) of a right side (n,)."""
        ...


class GradientMethod(ABC):
    """The way from an outer loss on a solution to a gradient of the parameters."""

    @abstractmethod
    def __call__(
        self, solve: Solve, stationarity: Stationarity, linear_solver: LinearSolver, parameters: Sequence[Tensor]
    ) -> Tensor:
        """The solution (n,), in the units of `solve`, differentiable in the parameters.

        Args:
            stationarity: the derivative that is zero there.
            parameters: leaf tensors of any shape and unit that may receive a gradient.
        """


class ImplicitGradient(GradientMethod):
    """The exact gradient, with the full Hessian by products that autograd computes.

    Memory does not depend on the number of the solver's iterations. Where the point is not a minimum, the backward pass
    raises the exception of the linear solver.
    """

    _exact = True

    def __call__(
        self, solve: Solve, stationarity: Stationarity, linear_solver: LinearSolver, parameters: Sequence[Tensor]
    ) -> Tensor:
        """The solution (n,) in the units of `solve`, differentiable in the parameters."""
        wanted = [p for p in parameters if p.requires_grad]
        attached: Tensor = _Solution.apply(solve().detach(), stationarity, linear_solver, self._exact, *wanted)
        return attached


class GaussNewtonGradient(ImplicitGradient):
    """An approximation: the Gauss-Newton matrix for the Hessian, without the curvature of residuals and losses."""

    _exact = False


class UnrolledGradient(GradientMethod):
    """A reference: the derivative of iterations x <- x - M g(x), M the Gauss-Newton inverse at the solution.

    It tends to the exact gradient with the number of iterations; memory and time grow with it.

    Args: iterations: number of unrolled iterations, at least 1.
    Raises: ValueError: a smaller number.
    """

    def __init__(self, iterations: int = 30) -> None:
        if iterations < 1:
            raise ValueError(f"iterations must be at least 1; got {iterations}. 30 are usually enough.")
        self.iterations = iterations

    def __call__(
        self, solve: Solve, stationarity: Stationarity, linear_solver: LinearSolver, parameters: Sequence[Tensor]
    ) -> Tensor:
        """The solution (n,), in the units of `solve`, differentiable in the parameters through the iterations."""
        point = solve().detach().requires_grad_(True)
        for _ in range(self.iterations):
            point = point - _Preconditioned.apply(stationarity(point), linear_solver)
        return point


class _Preconditioned(torch.autograd.Function):
    """A constant symmetric matrix times a vector."""

    @staticmethod
    def forward(ctx: Any, vector: Tensor, linear_solver: LinearSolver) -> Tensor:
        ctx.linear_solver = linear_solver
        return linear_solver.precondition(vector)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        return ctx.linear_solver.precondition(upstream[0]), None


class _Solution(torch.autograd.Function):
    """A solved point whose derivative by the parameters is that of the stationarity condition."""

    @staticmethod
    def forward(
        ctx: Any,
        point: Tensor,
        stationarity: Stationarity,
        linear_solver: LinearSolver,
        exact: bool,
        *parameters: Tensor,
    ) -> Tensor:
        ctx.stationarity, ctx.linear_solver, ctx.exact = stationarity, linear_solver, exact
        ctx.save_for_backward(point, *parameters)
        return point.clone()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        point, *parameters = ctx.saved_tensors
        leaf = point.detach().requires_grad_(True)
        with torch.enable_grad():
            condition = ctx.stationarity(leaf)

        def product(vector: Tensor) -> Tensor:
            (image,) = torch.autograd.grad(condition, leaf, vector, retain_graph=True)
            return image

        solver = ctx.linear_solver
        multiplier = solver(product, upstream[0]) if ctx.exact else solver.precondition(upstream[0])
        gradients = torch.autograd.grad(condition, parameters, -multiplier, allow_unused=True)
        return None, None, None, None, *gradients
