"""The likelihood of the observations: against the dense Gaussian marginal of scipy, and its gradient by differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import Covariance, multivariate_normal
from torch import Tensor

from ballfg.dynamics import Surfaces
from ballfg.estimation.filters.window_velocity import window_velocities
from ballfg.estimation.segmentation.result import Segmentation
from ballfg.factors.linear.covariance import NeighbourCovariances, marginal_covariances
from ballfg.factors.loss import Loss
from ballfg.learning.end_to_end.learnables import NoiseScales
from ballfg.learning.gradient.objective import negative_log_likelihood
from tests.learning.estimates import (
    NOISE,
    SETTINGS,
    STARTS,
    Estimates,
    ball,
    directional,
    factors_of,
    measured,
    usual_ball,
)

GRAVITY = ball(gravity={"g": 9.81})
LABEL = np.array([-5.0, -80.0, 30.0])
PLAIN = replace(SETTINGS, loss=Loss(), spin_loss=Loss(), label_loss=Loss())
G_SIGMA = 0.5


def likelihood(estimates: Estimates) -> Tensor:
    found = estimates.solve()
    graphs, minima = [s.graph for s in found], [s.minimum.values for s in found]
    return negative_log_likelihood(graphs, minima, factors_of(found), estimates.noise.noise())


def falling(*, coefficients: bool = False, **changes) -> Estimates:
    """Two tracks of different length, the first with a spin label, of balls that meet no surface."""
    labels = dict(zip(("spin_x", "spin_y", "spin_z"), LABEL.tolist(), strict=True))
    tracks = [replace(t, labels=labels if k == 0 else {}) for k, t in enumerate(measured(GRAVITY, STARTS[:2], (13, 9)))]
    noise = NoiseScales(replace(NOISE, contact_tangential=0.0), learned=True)
    settings = replace(PLAIN, coefficients={"flight.gravity.g": G_SIGMA} if coefficients else {}, **changes)
    return Estimates(GRAVITY, tracks, settings, noise, surfaces=Surfaces(-100.0))


def minus_log_marginal(estimates: Estimates, k: int) -> float:
    """Of positions and label of track k, all states and the coefficient integrated out, by scipy."""
    track, settings, noise = estimates.tracks[k], estimates.settings, estimates.noise
    g_sigma, process = settings.coefficients.get("flight.gravity.g", 0.0), replace(NOISE, **noise.values())
    start = np.repeat((5.0, settings.velocity_prior, 2000.0), 3) ** 2
    if track.spin_label is None:
        start[6:] = 1 / (1 / start[6:] + 1 / settings.spin_prior**2)
    mean = np.concatenate((track.positions[0], np.zeros(6), [9.81]))
    covariance = np.diag([*start, g_sigma**2])
    means, blocks = [mean], {(0, 0): covariance}
    for i, h in enumerate(np.diff(track.times)):
        F = np.eye(10)
        F[:3, 3:6] = h * np.eye(3)
        F[2, 9], F[5, 9] = -(h**2) / 2, -h
        Q = np.zeros((10, 10))
        Q[:9, :9] = process.flight(np.array([h]))[0]
        means.append(F @ means[-1])
        for j in range(i + 1):
            blocks[i + 1, j] = F @ blocks[i, j]
            blocks[j, i + 1] = blocks[i + 1, j].T
        blocks[i + 1, i + 1] = F @ blocks[i, i] @ F.T + Q
    n = len(track)
    whole = np.block([[blocks[i, j] for j in range(n)] for i in range(n)])
    seen = [10 * i + axis for i in range(n) for axis in range(3)]
    values = list(track.positions.reshape(-1))
    sigmas = [s * noise.position_scale() for s in settings.position_noise] * n
    if track.spin_label is not None:
        seen, values = [*seen, 6, 7, 8], [*values, *track.spin_label]
        sigmas += [settings.spin_label_noise * noise.spin_scale()] * 3
    cut = whole[np.ix_(seen, seen)] + np.diag(np.square(sigmas))
    fading = np.exp(-np.abs(track.times[:, None] - track.times) / settings.memory_time)
    cut[: 3 * n, : 3 * n] += np.kron(fading, np.diag(np.square(settings.memory)))
    way = settings.stamp_jitter * window_velocities(track.times, track.positions)
    for i in range(n):
        cut[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += np.outer(way[i], way[i])
    root = Covariance.from_cholesky(np.linalg.cholesky(cut))
    return -multivariate_normal(np.concatenate(means)[seen], root).logpdf(values)


NOISES = ((0.0, 0.0, 0.0), (0.7, -0.4, 0.3), (-0.5, 0.6, -0.8))
"""Logs of the scales of the process noise, of the positions', of the labels'."""


TRACKER = {"memory": (0.003, 0.002, 0.004), "memory_time": 0.03, "stamp_jitter": 0.0005}
CASES = pytest.mark.parametrize(
    "case",
    [{}, {"coefficients": True}, TRACKER, {"coefficients": True, **TRACKER}],
    ids=["states", "coefficient", "memory and jitter", "all of it"],
)


@CASES
def test_it_is_the_marginal_of_a_linear_problem(case) -> None:
    """Up to one constant a track, whatever the noise. 2e-7 is seen: scipy's marginal holds 25 m^2 beside 4e-6 m^2."""
    estimates = falling(**case)
    apart = []
    for process, position, spin in NOISES:
        with torch.no_grad():
            estimates.noise.process.fill_(process)
            estimates.noise.position.fill_(position)
            estimates.noise.spin.fill_(spin)
        dense = [minus_log_marginal(estimates, k) for k in range(2)]
        apart.append(likelihood(estimates).detach().numpy() - dense)
    print(np.ptp(apart, axis=0))  # shown by -s
    assert np.ptp(apart, axis=0).max() < 1e-6


def test_it_tells_one_memory_from_another() -> None:
    """The constant does not depend on memory and jitter: biases' spreads are counted."""
    apart = []
    for tracker in (TRACKER, TRACKER | {"memory": (0.001, 0.004, 0.002)}, TRACKER | {"memory_time": 0.2}):
        estimates = falling(**tracker)
        apart.append(likelihood(estimates).detach().numpy() - [minus_log_marginal(estimates, k) for k in range(2)])
    assert np.ptp(apart, axis=0).max() < 1e-6


@CASES
def test_its_gradient_is_that_of_the_marginal(case) -> None:
    estimates = falling(**case)
    with torch.no_grad():
        estimates.noise.process += torch.tensor([0.4, -0.3, 0.1, 0.2])
        estimates.noise.position.fill_(-0.2)
        estimates.noise.spin.fill_(0.3)
    check_gradient(estimates, lambda: minus_log_marginal(estimates, 0) + minus_log_marginal(estimates, 1), 3e-7)


def check_gradient(estimates: Estimates, value, tolerance: float) -> None:
    leaves = list(estimates.noise.parameters())
    found = torch.autograd.grad(likelihood(estimates).sum(), leaves)
    for leaf, gradient in zip(leaves, found, strict=True):
        for k in range(leaf.numel()):
            direction = torch.eye(leaf.numel(), dtype=torch.float64)[k].view(leaf.shape)
            expected = directional(value, [leaf], [direction], 3e-3)
            got = float(gradient.flatten()[k])
            print(f"{got:.6g} {got - expected:.0e}")  # shown by -s
            assert got == pytest.approx(expected, rel=tolerance, abs=tolerance)


def test_a_scale_of_everything_is_told() -> None:
    """The states do not tell it; the likelihood does: its derivative is (what was seen - what the noise says)."""
    estimates = falling()
    gradient = torch.autograd.grad(likelihood(estimates).sum(), list(estimates.noise.parameters()))
    at_once = float(sum(g.sum() for g in gradient))
    with torch.no_grad():
        for leaf in estimates.noise.parameters():
            leaf -= 0.5
    gradient = torch.autograd.grad(likelihood(estimates).sum(), list(estimates.noise.parameters()))
    too_small = float(sum(g.sum() for g in gradient))
    assert too_small < at_once - 10.0  # much more was seen than such noise says: the scale has to grow


def test_contacts_and_coefficients_of_a_ball_that_bounces() -> None:
    """Not linear any more: Fisher's identity leaves out how J changes as the minimum moves.

    The value itself, solved anew at each noise, gives the differences: a few per cent are seen.
    """
    noise = NoiseScales(NOISE, learned=True)
    settings = replace(PLAIN, coefficients={"flight.drag.k": 0.03, "bounce.restitution.e": 0.02})
    estimates = Estimates(usual_ball(), measured(usual_ball())[1:2], settings, noise)
    assert all(len(s.events.contacts) == 1 for s in estimates.solve())
    check_gradient(estimates, lambda: likelihood(estimates).sum(), 0.06)


def test_robust_losses_count_as_gaussians_with_their_weights() -> None:
    """Samples far in the tail of Huber's loss. How weights follow the noise is left out: 4 % are seen."""
    noise = NoiseScales(NOISE, learned=True)
    estimates = Estimates(GRAVITY, falling().tracks, replace(PLAIN, loss=Loss("huber", 1.5)), noise, Surfaces(-100.0))
    norms = [np.linalg.norm(s.graph.batches[0].linearize(s.minimum.values).residual, axis=1) for s in estimates.solve()]
    assert max(n.max() for n in norms) > 3.0
    check_gradient(estimates, lambda: likelihood(estimates).sum(), 0.05)


def test_pieces_that_nothing_links() -> None:
    """A restart within a track: the likelihood is that of two tracks."""
    (track,), noise = measured(GRAVITY, STARTS[1:2], (13,)), NoiseScales(NOISE, learned=True)
    track = replace(track, labels={})
    whole = Estimates(GRAVITY, [track], PLAIN, noise, Surfaces(-100.0))
    none, cut = np.zeros(0, dtype=np.int64), np.array([5])
    whole.segmentations = [Segmentation((), cut, cut, (), np.zeros(13, dtype=np.int8))]
    halves = [
        replace(track, times=track.times[part], positions=track.positions[part]) for part in (slice(6), slice(6, 13))
    ]
    parts = Estimates(GRAVITY, halves, PLAIN, noise, Surfaces(-100.0))
    assert [len(e.hits) for e in parts.segmentations] == [0, 0]
    assert none.tolist() == parts.segmentations[0].restarts.tolist()
    together, apart = likelihood(whole), likelihood(parts)
    torch.testing.assert_close(together.sum(), apart.sum(), rtol=0, atol=1e-7)
    leaves = [noise.process, noise.position]
    for a, b in zip(torch.autograd.grad(together.sum(), leaves), torch.autograd.grad(apart.sum(), leaves), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-7)


@pytest.mark.parametrize("coefficients", [False, True], ids=["states", "coefficient"])
def test_posterior_covariances_are_the_smoother_s(coefficients) -> None:
    """Those of neighbours are those of a dense inverse, and so is the determinant."""
    for one in falling(coefficients=coefficients).solve():
        n, p = len(one.minimum.values.states), int(coefficients)
        root = one.minimum.step.root
        posterior, expected = NeighbourCovariances.of(root), marginal_covariances(root)
        np.testing.assert_allclose(posterior.states, expected.states, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(posterior.coefficients, expected.coefficients, rtol=1e-9)
        size = 9 * n + p
        information = np.zeros((size, size))
        for rows in one.graph.linearize(one.minimum.values):
            for i, variables in enumerate(rows.variables.tolist()):
                columns = [np.arange(9 * v, 9 * v + 9) if v >= 0 else np.arange(9 * n, size) for v in variables]
                jacobian = np.concatenate([block[i] for block in rows.jacobians], axis=1)
                information[np.ix_(np.concatenate(columns), np.concatenate(columns))] += jacobian.T @ jacobian
        scale = np.sqrt(np.diagonal(information))
        dense = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
        sign, log = np.linalg.slogdet(information / np.outer(scale, scale))
        assert sign == 1.0
        half = 0.5 * log + np.log(scale).sum()
        assert root.log_determinant == pytest.approx(half, abs=1e-7)
        for i in range(n - 1):
            following = dense[9 * i : 9 * i + 9, 9 * i + 9 : 9 * i + 18]
            unit = np.sqrt(np.outer(np.diag(dense)[9 * i : 9 * i + 9], np.diag(dense)[9 * i + 9 : 9 * i + 18]))
            assert np.abs((posterior.cross[i, :, :9] - following) / unit).max() < 1e-6
