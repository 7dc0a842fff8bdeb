"""Solves the problem by PyPose: Levenberg-Marquardt with a dense Jacobian from torch's autograd."""

import pypose as pp
import torch
from problem import Array, Problem
from torch import nn
from with_torch import acceleration_of, rollout

__all__ = ["estimate", "rollout"]
TOLERANCE = 1e-9  # Relative change of the error at which it stops
STEPS = 20
MOST_TRACKS = 4  # At once; four take seconds
DAMPING = 1e-10  # Damping of the first step: negligible, which is the quickest here


class Flight(nn.Module):
    """All whitened residuals of the unknowns, which are its parameters."""

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        self.p, self.v, self.w = (nn.Parameter(torch.from_numpy(part)) for part in problem.start())
        self.acceleration, self.dt = acceleration_of(problem), float(problem.dt)
        self.measured, self.label = torch.from_numpy(problem.measured), torch.from_numpy(problem.label)
        self.step_sigma = torch.from_numpy(problem.step_sigma)
        self.noise = float(problem.position_sigma), float(problem.label_sigma)

    def forward(self, _: object) -> torch.Tensor:
        """(r,) residuals."""
        p, v, w, dt = self.p, self.v, self.w, self.dt
        before = v[:, :-1]
        a = self.acceleration(before, w[:, None].expand_as(before))
        steps = (p[:, 1:] - p[:, :-1] - dt * before - 0.5 * dt**2 * a, v[:, 1:] - before - dt * a)
        flown = torch.cat(steps, dim=-1) / self.step_sigma
        seen, labelled = (p - self.measured) / self.noise[0], (w - self.label) / self.noise[1]
        return torch.cat([part.reshape(-1) for part in (flown, seen, labelled)])


def estimate(problem: Problem):
    """Steps until the error stays."""
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
        found = {"position": flight.p, "velocity": flight.v, "spin": flight.w}
        return {name: part.detach().numpy() for name, part in found.items()}

    return solve
