"""Solves the problem by GTSAM from Python: one CustomFactor for each step, with derivatives in numpy."""

import gtsam
import numpy as np
from problem import Array, Problem

TOLERANCE = 1e-10  # Relative change of the error at which it stops
SPIN = 1 << 40  # Key of a track's spin, plus its number; states are numbered from 0


def estimate(problem: Problem, polished: int = 0):
    """Levenberg-Marquardt of GTSAM, one track after another; then some Gauss-Newton steps."""
    tracks, n, _ = problem.measured.shape
    graphs = [_graph(problem, k) for k in range(tracks)]

    def solve() -> dict[str, Array]:
        states, spins = np.empty((tracks, n, 6)), np.empty((tracks, 3))
        for k, (graph, start) in enumerate(graphs):
            parameters = gtsam.LevenbergMarquardtParams()
            parameters.setRelativeErrorTol(TOLERANCE)
            parameters.setAbsoluteErrorTol(0.0)
            found = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()
            for _ in range(polished):
                found = found.retract(graph.linearize(found).optimize())
            states[k], spins[k] = [found.atVector(i) for i in range(n)], found.atVector(SPIN)
        return {"position": states[..., :3], "velocity": states[..., 3:], "spin": spins}

    return solve


def reference(problem: Problem):
    """The solution that others are compared with: an error tells half of the digits, further steps the rest."""
    return estimate(problem, polished=3)


def _graph(problem: Problem, track: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values, n = gtsam.NonlinearFactorGraph(), gtsam.Values(), problem.measured.shape[1]
    of_step = gtsam.noiseModel.Diagonal.Sigmas(problem.step_sigma)
    of_position = gtsam.noiseModel.Isotropic.Sigma(3, float(problem.position_sigma))
    of_label = gtsam.noiseModel.Isotropic.Sigma(3, float(problem.label_sigma))
    step = _step(problem)
    p, v, w = problem.start()
    for k in range(n - 1):
        graph.push_back(gtsam.CustomFactor(of_step, [k, k + 1, SPIN], step))
    for k in range(n):
        graph.push_back(gtsam.CustomFactor(of_position, [k], _seen(problem.measured[track, k])))
        values.insert(k, np.concatenate((p[track, k], v[track, k])))
    graph.push_back(gtsam.PriorFactorVector(SPIN, problem.label[track], of_label))
    values.insert(SPIN, w[track])
    return graph, values


def _seen(position: Array):
    jacobian = np.eye(3, 6)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        if jacobians is not None:
            jacobians[0] = jacobian
        return values.atVector(this.keys()[0])[:3] - position

    return error


def _step(problem: Problem):
    dt, acceleration = float(problem.dt), _network(problem) if problem.layers else _formula(problem)
    identity, zero = np.eye(3), np.zeros((3, 3))

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        first, second, spin = this.keys()
        x, y, w = values.atVector(first), values.atVector(second), values.atVector(spin)
        a, by_v, by_w = acceleration(x[3:], w)
        if jacobians is not None:
            share = 0.5 * dt**2
            jacobians[0] = -np.block([[identity, dt * identity + share * by_v], [zero, identity + dt * by_v]])
            jacobians[1] = np.eye(6)
            jacobians[2] = -np.concatenate((share * by_w, dt * by_w))
        return y - np.concatenate((x[:3] + dt * x[3:] + 0.5 * dt**2 * a, x[3:] + dt * a))

    return error


def _cross(u: Array) -> Array:
    """The matrix of u x ..."""
    return np.array(((0.0, -u[2], u[1]), (u[2], 0.0, -u[0]), (-u[1], u[0], 0.0)))


def _formula(problem: Problem):
    gravity, drag, magnus = problem.gravity, float(problem.drag), float(problem.magnus)

    def acceleration(v: Array, w: Array) -> tuple[Array, Array, Array]:
        speed, spun = np.sqrt(v @ v), _cross(w)
        by_v = -drag * (speed * np.eye(3) + np.outer(v, v) / speed) + magnus * spun
        return gravity - drag * speed * v + magnus * (spun @ v), by_v, -magnus * _cross(v)

    return acceleration


def _network(problem: Problem):
    (w1, b1), (w2, b2), (w3, b3) = problem.layers

    def acceleration(v: Array, w: Array) -> tuple[Array, Array, Array]:
        spun, zero, one = _cross(w), np.zeros((3, 3)), np.eye(3)
        h1 = np.tanh(w1 @ np.concatenate((v, w, spun @ v)) + b1)
        h2 = np.tanh(w2 @ h1 + b2)
        by_x = ((w3 * (1.0 - h2**2)) @ w2 * (1.0 - h1**2)) @ w1
        features = np.block([[one, zero], [zero, one], [spun, -_cross(v)]])
        slopes = by_x @ features
        return w3 @ h2 + b3, slopes[:, :3], slopes[:, 3:]

    return acceleration
