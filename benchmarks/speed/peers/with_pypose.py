"""Solves the problem by PyPose: Levenberg-Marquardt with a dense Jacobian from torch's autograd."""

import pypose as pp
import torch
from problem import Array, Problem
from torch import nn
from with_torch import residual_of, rollout

TOLERANCE = 1e-9
"""Relative change of the error at which it stops."""
STEPS = 20
MOST_TRACKS = 4
"""At once; four take seconds."""
DAMPING = 1e-10
"""Damping of the first step: negligible, which is the quickest here."""


class Flight(nn.Module):
    """All whitened residuals of the unknowns, which are its parameters."""

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        p, v, w = (torch.from_numpy(part) for part in problem.start())
        self.p, self.v, self.w = nn.Parameter(p), nn.Parameter(v), nn.Parameter(w)
        self.steps = residual_of(problem)
        self.measured, self.label = torch.from_numpy(problem.measured), torch.from_numpy(problem.label)
        self.noise = float(problem.position_sigma), float(problem.label_sigma)

    def forward(self, _: object) -> torch.Tensor:
        """(r,) residuals."""
        seen, labelled = (self.p - self.measured) / self.noise[0], (self.w - self.label) / self.noise[1]
        return torch.cat([part.reshape(-1) for part in (self.steps(self.p, self.v, self.w), seen, labelled)])


def solver(problem: Problem, task: str):
    """Steps until the error stays."""
    if task == "rollout":
        return rollout(problem)
    if task != "estimate":
        raise NotImplementedError(f"no {task}")
    if len(problem.measured) > MOST_TRACKS:
        raise NotImplementedError(f"its Jacobian is dense: too large for {len(problem.measured)} tracks")

    def solve() -> dict[str, Array]:
        flight = Flight(problem)
        strategy = pp.optim.strategy.Adaptive(damping=DAMPING, min=DAMPING)
        optimizer, last = pp.optim.LM(flight, solver=pp.optim.solver.Cholesky(), strategy=strategy), float("inf")
        for _ in range(STEPS):
            error = float(optimizer.step(input=None))
            if abs(last - error) <= TOLERANCE * error:
                break
            last = error
        return {name: getattr(flight, short).detach().numpy() for name, short in NAMES.items()}

    return solve


NAMES = {"position": "p", "velocity": "v", "spin": "w"}
