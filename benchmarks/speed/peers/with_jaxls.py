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

TOLERANCES = (1e-10, 1e-11)
"""Relative change of the cost, and that of many tracks with the network: the loosest powers of ten that reach the
minimum."""


class State(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(6)):
    """Position and velocity."""


class Spin(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(3)):
    """Spin of a track."""


def estimate(problem: Problem):
    """One compiled function of the measurements: analysis and solution, of several tracks as one problem.

    One track after another takes as long, and tracks side by side by `jax.vmap` longer.
    """
    acceleration, dt, step_sigma = acceleration_of(problem), float(problem.dt), jnp.asarray(problem.step_sigma)
    tracks, n, _ = problem.measured.shape
    linear = "cholmod" if importlib.util.find_spec("sksparse") else "conjugate_gradient"
    tolerance = TOLERANCES[tracks > 1 and bool(problem.layers)]
    termination = jaxls.TerminationConfig(cost_tolerance=tolerance, parameter_tolerance=tolerance)

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

    number = np.arange(tracks * n).reshape(tracks, n)
    before, after, owner = number[:, :-1].ravel(), number[:, 1:].ravel(), np.repeat(np.arange(tracks), n - 1)

    def solve_all(measured: jax.Array, label: jax.Array, begin: jax.Array, turn: jax.Array):
        states, spins = State(jnp.arange(tracks * n)), Spin(jnp.arange(tracks))
        costs = [
            step(State(jnp.asarray(before)), State(jnp.asarray(after)), Spin(jnp.asarray(owner))),
            seen(states, measured.reshape(-1, 3)),
            labelled(spins, label),
        ]
        analyzed = jaxls.LeastSquaresProblem(costs, [states, spins]).analyze()
        start = jaxls.VarValues.make([states.with_value(begin.reshape(-1, 6)), spins.with_value(turn)])
        options = {"trust_region": None, "termination": termination, "verbose": False}
        found = analyzed.solve(start, linear_solver=linear, **options)
        return found[states], found[spins]

    p, v, w = problem.start()
    given = [jnp.asarray(part) for part in (problem.measured, problem.label, np.concatenate((p, v), axis=2), w)]
    compiled = jax.jit(solve_all)

    def solve() -> dict[str, Array]:
        states, spins = (np.asarray(part) for part in compiled(*given))
        states = states.reshape(tracks, n, 6)
        return {"position": states[..., :3], "velocity": states[..., 3:], "spin": spins}

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


def rollout(problem: Problem):
    """All Runge-Kutta steps as one compiled scan."""
    h, start, acceleration = float(problem.dt), jnp.asarray(problem.flight), acceleration_of(problem)

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
