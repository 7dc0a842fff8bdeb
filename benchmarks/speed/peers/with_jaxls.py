"""Solves the problem by jaxls: compiled sparse Gauss-Newton in JAX, with CHOLMOD if scikit-sparse is installed."""

import importlib.util
import os

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import jax.numpy as jnp
import jaxls
import numpy as np
from problem import ROLLOUT_STEPS, Array, Problem

jax.config.update("jax_enable_x64", True)

TOLERANCE = 1e-10
"""Relative change of the cost: the loosest power of ten that meets the comparison on all tracks."""


class State(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(6)):
    """Position and velocity."""


class Spin(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(3)):
    """Spin of a track."""


def solver(problem: Problem, task: str):
    """A compiled function that solves the problem, or rolls its network out."""
    acceleration = acceleration_of(problem)
    if task == "rollout":
        return _rollout(problem, acceleration)
    if task != "estimate":
        raise NotImplementedError(f"jaxls has no {task}")
    dt, step_sigma = float(problem.dt), jnp.asarray(problem.step_sigma)

    @jaxls.Cost.factory
    def step(values, one: State, other: State, spin: Spin) -> jax.Array:
        x, y, w = values[one], values[other], values[spin]
        a = acceleration(x[3:], w)
        after = jnp.concatenate((x[:3] + dt * x[3:] + 0.5 * dt**2 * a, x[3:] + dt * a))
        return (y - after) / step_sigma

    @jaxls.Cost.factory
    def seen(values, one: State, position: jax.Array) -> jax.Array:
        return (values[one][:3] - position) / float(problem.position_sigma)

    @jaxls.Cost.factory
    def labelled(values, spin: Spin, label: jax.Array) -> jax.Array:
        return (values[spin] - label) / float(problem.label_sigma)

    tracks, n, _ = problem.measured.shape
    number = np.arange(tracks * n).reshape(tracks, n)
    owner = np.repeat(np.arange(tracks), n - 1)
    costs = [
        step(State(number[:, :-1].reshape(-1)), State(number[:, 1:].reshape(-1)), Spin(owner)),
        seen(State(number.reshape(-1)), jnp.asarray(problem.measured.reshape(-1, 3))),
        labelled(Spin(np.arange(tracks)), jnp.asarray(problem.label)),
    ]
    states, spins = State(number.reshape(-1)), Spin(np.arange(tracks))
    analyzed = jaxls.LeastSquaresProblem(costs, [states, spins]).analyze()
    p, v, w = problem.start()
    given = jnp.asarray(np.concatenate((p, v), axis=2).reshape(-1, 6))
    start = jaxls.VarValues.make([states.with_value(given), spins.with_value(jnp.asarray(w))])
    linear = "cholmod" if importlib.util.find_spec("sksparse") else "conjugate_gradient"

    def solve() -> dict[str, Array]:
        found = analyzed.solve(
            start,
            linear_solver=linear,
            trust_region=None,
            termination=jaxls.TerminationConfig(cost_tolerance=TOLERANCE, parameter_tolerance=TOLERANCE),
            verbose=False,
        )
        whole = np.asarray(found[states]).reshape(tracks, n, 6)
        return {"position": whole[..., :3], "velocity": whole[..., 3:], "spin": np.asarray(found[spins])}

    return solve


def acceleration_of(problem: Problem):
    """A (3,) of a velocity and a spin."""
    layers = [(jnp.asarray(w), jnp.asarray(b)) for w, b in problem.layers]
    gravity, drag, magnus = jnp.asarray(problem.gravity), float(problem.drag), float(problem.magnus)

    def formula(v: jax.Array, w: jax.Array) -> jax.Array:
        return gravity - drag * jnp.sqrt(v @ v) * v + magnus * jnp.cross(w, v)

    def network(v: jax.Array, w: jax.Array) -> jax.Array:
        x = jnp.concatenate((v, w, jnp.cross(w, v)))
        for weight, bias in layers[:-1]:
            x = jnp.tanh(weight @ x + bias)
        return layers[-1][0] @ x + layers[-1][1]

    return network if layers else formula


def _rollout(problem: Problem, acceleration):
    h, start = float(problem.dt), jnp.asarray(problem.flight)

    def rate(x: jax.Array) -> jax.Array:
        return jnp.concatenate((x[3:6], acceleration(x[3:6], x[6:]), jnp.zeros(3)))

    def step(x: jax.Array, _):
        k1 = rate(x)
        k2 = rate(x + 0.5 * h * k1)
        k3 = rate(x + 0.5 * h * k2)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(x + h * k3))
        return x, x

    roll = jax.jit(lambda x: jax.lax.scan(step, x, None, length=ROLLOUT_STEPS)[1])
    return lambda: {"states": np.asarray(roll(start))}
