"""Computes the problem's acceleration in torch for the libraries built on it, and rolls it out."""

import torch
from problem import LOSS_STEPS, ROLLOUT_STEPS, Problem
from torch import Tensor

torch.set_num_threads(1)
torch.set_default_dtype(torch.float64)


def acceleration_of(problem: Problem, drag: Tensor | None = None, magnus: Tensor | None = None):
    """Accelerations (..., 3) of velocities and spins (..., 3); drag and Magnus coefficients (t, 1) may be tensors."""
    layers = [(torch.from_numpy(w), torch.from_numpy(b)) for w, b in problem.layers]
    gravity = torch.from_numpy(problem.gravity)
    k = float(problem.drag) if drag is None else drag
    m = float(problem.magnus) if magnus is None else magnus

    def formula(v: Tensor, w: Tensor) -> Tensor:
        return gravity - k * v.norm(dim=-1, keepdim=True) * v + m * torch.linalg.cross(w, v)

    def network(v: Tensor, w: Tensor) -> Tensor:
        x = torch.cat((v, w, torch.linalg.cross(w, v)), dim=-1)
        for weight, bias in layers[:-1]:
            x = torch.tanh(torch.nn.functional.linear(x, weight, bias))
        return torch.nn.functional.linear(x, *layers[-1])

    return network if layers else formula


def loss_of(problem: Problem, drag: Tensor, magnus: Tensor, p: Tensor, v: Tensor, w: Tensor) -> Tensor:
    """() m^2: the squared position `LOSS_STEPS` explicit steps after a state (1, 3) each."""
    acceleration, dt = acceleration_of(problem, drag, magnus), float(problem.dt)
    for _ in range(LOSS_STEPS):
        a = acceleration(v, w)
        p, v = p + dt * v + 0.5 * dt**2 * a, v + dt * a
    return p.square().sum()


def rollout(problem: Problem):
    """The rollout in torch's eager mode."""
    h, start, acceleration = float(problem.dt), torch.from_numpy(problem.flight)[None], acceleration_of(problem)

    def rate(x: Tensor) -> Tensor:
        v, w = x[:, 3:6], x[:, 6:]
        return torch.cat((v, acceleration(v, w), torch.zeros_like(v)), dim=-1)

    @torch.no_grad()
    def roll():
        x, states = start, []
        for _ in range(ROLLOUT_STEPS):
            k1 = rate(x)
            k2 = rate(x + 0.5 * h * k1)
            k3 = rate(x + 0.5 * h * k2)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(x + h * k3))
            states.append(x)
        return {"states": torch.cat(states).numpy()}

    return roll
