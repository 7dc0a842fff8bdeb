"""Solves the problem by Theseus: batched Gauss-Newton in torch, with the gradient through its solution."""

import importlib.util
import warnings

import theseus as th
import torch
from problem import Array, Problem
from with_torch import acceleration_of, loss_of, rollout

__all__ = ["estimate", "gradient", "rollout"]
warnings.simplefilter("ignore")
STEPS = 20
TOLERANCE = 1e-10  # Relative change of the error at which it stops


def estimate(problem: Problem):
    """A layer that solves all tracks as one batch."""
    optimizer, inputs = layer(problem)
    n = problem.measured.shape[1]

    def solve() -> dict[str, Array]:
        with torch.no_grad():
            found, _ = optimizer.forward(inputs)
        whole = torch.stack([found[f"x{k}"] for k in range(n)], dim=1)
        return {"position": whole[..., :3].numpy(), "velocity": whole[..., 3:].numpy(), "spin": found["w"].numpy()}

    return solve


def gradient(problem: Problem):
    """Forward, and backward by one differentiable Gauss-Newton step, which Theseus calls implicit."""
    optimizer, inputs = layer(problem)
    last = f"x{problem.measured.shape[1] - 1}"

    def solve() -> dict[str, Array]:
        k = torch.tensor([[float(problem.drag)]], requires_grad=True)
        m = torch.tensor([[float(problem.magnus)]], requires_grad=True)
        found, _ = optimizer.forward(inputs | {"drag": k, "magnus": m}, optimizer_kwargs={"backward_mode": "implicit"})
        loss = loss_of(problem, k, m, found[last][:, :3], found[last][:, 3:], found["w"])
        return {"gradient": torch.cat(torch.autograd.grad(loss, (k, m))).reshape(-1).numpy()}

    return solve


def layer(problem: Problem) -> tuple[th.TheseusLayer, dict[str, torch.Tensor]]:
    """The problem as a layer, and its start."""
    n, dt = problem.measured.shape[1], float(problem.dt)

    def step(optim_vars, aux_vars):
        x, y, w = (variable.tensor for variable in optim_vars)
        a = acceleration_of(problem, *(variable.tensor for variable in aux_vars))(x[..., 3:], w)
        return y - torch.cat((x[..., :3] + dt * x[..., 3:] + 0.5 * dt**2 * a, x[..., 3:] + dt * a), dim=-1)

    def seen(optim_vars, aux_vars):
        return optim_vars[0].tensor[..., :3] - aux_vars[0].tensor

    spin, label = th.Vector(3, name="w"), th.Vector(tensor=torch.from_numpy(problem.label), name="label")
    values = {"drag": float(problem.drag), "magnus": float(problem.magnus)}
    laws = [th.Variable(torch.tensor([[value]]), name=name) for name, value in values.items()]
    states = [th.Vector(6, name=f"x{k}") for k in range(n)]
    of_step = th.DiagonalCostWeight(torch.from_numpy(1.0 / problem.step_sigma)[None])
    of_position = th.ScaleCostWeight(1.0 / float(problem.position_sigma))
    objective = th.Objective(dtype=torch.float64)
    for k in range(n - 1):
        ends = [states[k], states[k + 1], spin]
        objective.add(th.AutoDiffCostFunction(ends, step, 6, of_step, aux_vars=laws, name=f"step{k}"))
    for k in range(n):
        where = th.Variable(torch.from_numpy(problem.measured[:, k].copy()), name=f"z{k}")
        objective.add(th.AutoDiffCostFunction([states[k]], seen, 3, of_position, aux_vars=[where], name=f"seen{k}"))
    of_label = th.ScaleCostWeight(1.0 / float(problem.label_sigma))
    objective.add(th.Difference(spin, label, of_label, name="labelled"))
    sparse = importlib.util.find_spec("sksparse") is not None
    linear = th.CholmodSparseSolver if sparse else th.CholeskyDenseSolver
    optimizer = th.GaussNewton(
        objective, linear, max_iterations=STEPS, abs_err_tolerance=0.0, rel_err_tolerance=TOLERANCE
    )
    p, v, w = (torch.from_numpy(part) for part in problem.start())
    inputs = {f"x{k}": torch.cat((p[:, k], v[:, k]), dim=-1) for k in range(n)}
    return th.TheseusLayer(optimizer), inputs | {"w": w}
