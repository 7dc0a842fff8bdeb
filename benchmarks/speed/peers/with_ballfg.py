"""Solves the problem by ballfg: factors of the same residuals, its own Levenberg-Marquardt, compiled derivatives."""

import numpy as np
import torch
from problem import LOSS_STEPS, ROLLOUT_STEPS, Array, Problem
from torch import Tensor

from ballfg.arrays import Index
from ballfg.benchmarks.speed.network import NetworkFlight
from ballfg.dynamics import BallModel, Surfaces, nominal_model, rollout as roll_out
from ballfg.dynamics.compiled.flight import TOGETHER
from ballfg.dynamics.compiled.functions import compiled
from ballfg.dynamics.model_file import model_from_dict
from ballfg.factors.batch import FactorBatch, Noise, Values
from ballfg.factors.graph import BallGraph, LevenbergMarquardt
from ballfg.factors.position import PositionFactors
from ballfg.factors.prior import PriorFactors
from ballfg.learning.gradient.conjugate_gradients import ConjugateGradients, GaussNewtonFactors
from ballfg.learning.gradient.implicit import ImplicitGradient
from ballfg.learning.gradient.objective import BatchObjective
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY

torch.set_num_threads(1)
TOLERANCE = 3e-6
"""Posterior standard deviations of a track to the minimum: the loosest that meets the comparison on all tracks."""
EXACT = 1e-8  # Relative error of the linear solution of a gradient, fine enough for the comparison
HELD = 1e-6
"""rad/s, by which the spin may change over a step: one spin for the flight, within all digits that are compared."""


class EulerFactors(FactorBatch):
    """The state after one explicit step of the acceleration, as the problem has it; the spin stays.

    Args:
        problem: with the step's length and noise.  model: gives accelerations.
        states: (m,) index of each step's first state.
    """

    def __init__(self, problem: Problem, model: BallModel, states: Index) -> None:
        super().__init__(np.stack((states, states + 1), axis=1), STATE_DIM)
        functions = compiled(model)
        assert functions is not None
        self.model, self.dt = model, float(problem.dt)
        self.rates, self.weights = functions.rates, functions.weights(model)[0]
        own = dict(model.named_parameters())
        coefficients = np.array([float(own[name].detach()) for name in functions.rates.names])
        self.root = 1.0 / np.concatenate((problem.step_sigma, np.full(3, HELD)))
        by_rates = np.repeat((-0.5 * self.dt**2, -self.dt, 0.0), 3)  # of position, velocity and spin after the step
        self.scale = (by_rates * self.root)[:, None]
        still = np.eye(STATE_DIM)
        still[range(3), range(3, 6)] = self.dt
        self.still = still * self.root[:, None]
        m = len(states)  # what the rates of all states take and write, and Jacobians by the state after a step
        self.coefficients, self.fixed = np.tile(coefficients, (m, 1)), np.zeros((m, len(coefficients), 6))
        self.moved, self.own = np.zeros((m, STATE_DIM, 6)), np.tile(np.diag(self.root), (m, 1, 1))
        self.moved[:, 3:] = np.eye(6)
        self.rates_of_all, self.slopes_of_all = np.empty((m, 6)), np.empty((m, 6, 6))

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, 9) and Jacobians (k, 9, 9)."""
        before, after = np.ascontiguousarray(inputs[0]), inputs[1]
        n, dt = len(before), self.dt
        a, slope = self.rates_of_all[:n], self.slopes_of_all[:n]
        for begin in range(0, n, TOGETHER):
            part = slice(begin, min(begin + TOGETHER, n))
            given = before[part], self.coefficients[part], self.weights, self.moved[part], self.fixed[part]
            self.rates.compute(*given, a[part], slope[part])
        residual = after - before
        residual[:, POSITION] -= dt * before[:, VELOCITY] + 0.5 * dt**2 * a[:, :3]
        residual[:, VELOCITY] -= dt * a[:, :3]
        by = np.zeros((n, STATE_DIM, STATE_DIM))
        by[:, POSITION, 3:] = slope[:, :3]
        by[:, VELOCITY, 3:] = slope[:, :3]
        by *= self.scale
        by -= self.still
        return residual * self.root, (by, self.own[:n])

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, 9) whitened residuals in torch."""
        return (inputs[1] - _stepped(self.model, inputs[0], self.dt)) * torch.from_numpy(self.root)


def _stepped(model: BallModel, state: Tensor, dt: float) -> Tensor:
    a, v = model.rates(state)[0], state[..., VELOCITY]
    moved = (state[..., POSITION] + dt * v + 0.5 * dt**2 * a, v + dt * a, state[..., SPIN])
    return torch.cat(moved, dim=-1)


def model_of(problem: Problem) -> BallModel:
    """The problem's laws as a model."""
    if problem.layers:  # there is nothing to bounce on
        weights, biases = ([torch.from_numpy(part) for part in parts] for parts in zip(*problem.layers, strict=True))
        return NetworkFlight(nominal_model(), weights, biases)
    gravity = {"g": -float(problem.gravity[2])}
    laws = {"gravity": gravity, "drag": {"k": float(problem.drag)}, "magnus": {"k": float(problem.magnus)}}
    return model_from_dict({"flight": laws, "bounce": {}})


def estimate(problem: Problem):
    """One graph of all tracks, whose states lie behind one another."""
    tracks, n, _ = problem.measured.shape
    optimizer, (graph, start) = LevenbergMarquardt(TOLERANCE * tracks**0.5), _posed(problem, model_of(problem))

    def solve() -> dict[str, Array]:
        states = optimizer.minimize(graph, start).values.states.reshape(tracks, n, STATE_DIM)
        return {"position": states[..., :3], "velocity": states[..., 3:6], "spin": states[:, 0, 6:]}

    return solve


def gradient(problem: Problem):
    """Forward, and backward through the converged estimate by the implicit function theorem."""
    model, optimizer = model_of(problem), LevenbergMarquardt()
    own = dict(model.named_parameters())
    drag, magnus = (own[f"flight.{name}.k"].requires_grad_(True) for name in ("drag", "magnus"))
    graph, start = _posed(problem, model)

    def solve() -> dict[str, Array]:
        minimum = optimizer.minimize(graph, start)
        assert minimum.step is not None
        objective = BatchObjective([graph], [minimum.values])
        layout, factors = objective.layout, GaussNewtonFactors([minimum.step.root])
        point = ImplicitGradient()(
            lambda: layout.pack([minimum.values]),
            lambda at: objective.gradient(at, Noise()),
            ConjugateGradients(factors, layout.owners(), EXACT),
            [drag, magnus],
        )
        state = layout.unpack(point)[0][-1:]
        for _ in range(LOSS_STEPS):
            state = _stepped(model, state, float(problem.dt))
        loss = state[:, POSITION].square().sum()
        return {"gradient": torch.stack(torch.autograd.grad(loss, (drag, magnus))).numpy()}

    return solve


def _posed(problem: Problem, model: BallModel) -> tuple[BallGraph, Values]:
    p, v, w = problem.start()
    tracks, n, _ = p.shape
    number = np.arange(tracks * n).reshape(tracks, n)
    label, root = np.zeros((tracks, STATE_DIM)), np.zeros((tracks, 3, STATE_DIM))
    label[:, SPIN] = problem.label
    root[:, range(3), range(6, 9)] = 1.0 / float(problem.label_sigma)
    steps = EulerFactors(problem, model, number[:, :-1].ravel())
    seen = PositionFactors(
        number.ravel(), problem.measured.reshape(-1, 3), np.full((number.size, 3), float(problem.position_sigma))
    )
    labelled = PriorFactors(number[:, 0].copy(), label, root)
    start = np.concatenate((p, v, np.repeat(w[:, None], n, axis=1)), axis=2).reshape(-1, STATE_DIM)
    return BallGraph((steps, seen, labelled)), Values(start, np.zeros(0))


def rollout(problem: Problem):
    """The network rolled out where there is nothing to bounce on."""
    model, start = model_of(problem), torch.from_numpy(problem.flight)[None]
    times = torch.arange(1, ROLLOUT_STEPS + 1, dtype=torch.float64) * float(problem.dt)
    roll = torch.no_grad()(lambda: roll_out(model, start, times, Surfaces(-1e3))[0].numpy())
    return lambda: {"states": roll()}
