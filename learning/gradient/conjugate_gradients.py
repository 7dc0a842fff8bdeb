"""Solves with the exact Hessian by conjugate gradients, preconditioned with the Gauss-Newton triangle.

The Hessian of a batch of tracks is block diagonal, one block per track. All blocks are solved in lockstep: one product
with the whole Hessian serves all of them, while each track has its own step lengths. The Gauss-Newton matrix R^T R,
whose triangle the last elimination has left, differs from a block only by the curvature of the residuals, so
that a few steps are enough.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ballfg.factors.linear.elimination import Root
from ballfg.factors.linear.substitution import substitute_back, substitute_forward

Product = Callable[[Tensor], Tensor]


class NotAMinimum(ValueError):  # noqa: N818 - the name is the statement
    """The objective is not at a minimum that a gradient could pass through, for tracks given by number in the batch."""

    def __init__(self, message: str, tracks: Sequence[int]) -> None:
        super().__init__(message)
        self.tracks = tuple(tracks)


class GaussNewtonFactors:
    """The factorisations R^T R of the Gauss-Newton matrices of several tracks, which solves all of them at once.

    Args: roots: the triangle R of each of t tracks, all with p coefficients; w is the width of a state with biases.
    """

    def __init__(self, roots: Sequence[Root]) -> None:
        self.roots = tuple(roots)
        self.tracks, self.lengths = len(roots), np.array([len(root.states) for root in roots])
        self.width, self.coefficients = roots[0].width, len(roots[0].coefficients)

    def solve(self, vector: Tensor) -> Tensor:
        """R^-1 R^-T times a vector (n,) in the order of `Layout`: the solution (n,), in SI units."""
        solution = np.array(vector.detach().numpy())
        split, ends = self.lengths.sum() * self.width, np.cumsum(self.lengths) * self.width
        shared = solution[split:].reshape(self.tracks, self.coefficients)
        for k, (root, end) in enumerate(zip(self.roots, ends, strict=True)):
            states = solution[end - self.lengths[k] * self.width : end].reshape(-1, self.width)
            substitute_forward(root, states, shared[k])
            substitute_back(root, states, shared[k])
        return torch.from_numpy(solution)


@dataclass
class ConjugateGradients:
    """Preconditioned conjugate gradients on blocks, in lockstep.

    Args:
        owners: (n,) block number of each entry of a vector.
        tolerance: largest residual of a block relative to the right side, in the metric of the preconditioner.
        max_iterations: largest number of products with the Hessian.
    """

    factors: GaussNewtonFactors
    owners: Tensor
    tolerance: float = 1e-10
    max_iterations: int = 50
    iterations: int = field(default=0, init=False)  # Products with the Hessian in the last solution

    def precondition(self, vector: Tensor) -> Tensor:
        """The Gauss-Newton solution (n,), in SI units, of a right side `vector` (n,) in those of the gradient."""
        return self.factors.solve(vector)

    def __call__(self, product: Product, right: Tensor) -> Tensor:
        """The solution x of H x = right.

        Args:
            product: H times a vector (n,).
            right: (n,) in the units of the gradient.
        Returns: (n,) in SI units of the states and coefficients.
        Raises: NotAMinimum: H has a direction of negative curvature, or the iteration does not converge.
        """
        solution = torch.zeros_like(right)
        residual = right.clone()
        direction = conditioned = self.precondition(residual)
        size = self._dot(residual, conditioned)
        goal = self.tolerance**2 * size
        for self.iterations in range(self.max_iterations + 1):  # noqa: B020 - kept for the reader
            if bool((size <= goal).all()):
                return solution
            if self.iterations == self.max_iterations:
                break
            image = product(direction)
            bend = self._dot(direction, image)
            active = size > goal
            if wrong := (~(bend > 0.0) & active).nonzero()[:, 0].tolist():
                raise NotAMinimum(
                    f"the objective of {len(wrong)} tracks bends downwards where the estimate stands: it is no "
                    "minimum. Leave these tracks out, or solve from another start.",
                    wrong,
                )
            step = torch.where(active, size / bend.where(active, torch.ones_like(bend)), 0.0)[self.owners]
            solution = solution + step * direction
            residual = residual - step * image
            conditioned = self.precondition(residual)
            new = self._dot(residual, conditioned)
            ratio = torch.where(active, new / size.where(active, torch.ones_like(size)), 0.0)[self.owners]
            direction, size = conditioned + ratio * direction, new
        late = (~(size <= goal)).nonzero()[:, 0].tolist()  # NaN too
        raise NotAMinimum(
            f"the Hessian of {len(late)} tracks could not be solved in {self.max_iterations} steps: it is far from the "
            "Gauss-Newton matrix. Solve the estimate more tightly, or use GaussNewtonGradient.",
            late,
        )

    def _dot(self, a: Tensor, b: Tensor) -> Tensor:
        """(t,) inner product of each block."""
        return a.new_zeros(self.factors.tracks).index_add(0, self.owners, a * b)
