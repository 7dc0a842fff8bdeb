"""Machine code of the filter over linearised tracks, and its derivative by hand, against torch."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from ballfg.estimation import Settings, Smoother
from ballfg.estimation.noise.filter_code import NEXT_TAIL
from ballfg.estimation.noise.linear_filter import LinearFilter, Noise
from ballfg.estimation.noise.linear_tracks import linearise
from ballfg.estimation.noise.marginal import MarginalFit
from ballfg.estimation.noise.parameters import parameters_of
from ballfg.parallel.parts import with_jobs
from ballfg.simulation import MeasurementNoise
from tests.estimation.noise import in_torch

NUMBERS = {
    "position": (1.0, 1.3, 0.8),
    "memory": (4e-6, 1e-6, 2e-6),
    "memory_time": 0.03,
    "stamp_jitter": 1e-8,
    "process": (0.2, 0.1, 0.3, 5.0, 0.01, 0.4, 0.2),
    "spin_label": 20.0,
    "spin_prior": 60.0,
    "coefficients": (1.1,),
}


@pytest.fixture(scope="module")
def linear(recorded):
    """Four tracks of different lengths with bounces; coefficients; a few samples left out, far off, further off."""
    model, surfaces, settings, tracks = recorded(MeasurementNoise(position=0.003, memory=0.002), tracks=4)
    parts = [t.until(float(t.times[0]) + 0.5 + 0.1 * k) for k, t in enumerate(tracks)]
    found = linearise(Smoother(model, surfaces, settings), parts)
    errors, used = found.errors.copy(), found.used.copy()
    errors[0, 20] += 0.010  # its loss grows linearly
    errors[1, 25] += 0.4  # as the smoother would have left it out
    used[2, 10:13] = False
    assert not found.used.all()
    assert len(found.coefficient_sigmas)
    assert (found.kicks[:, :, 1:] != 0.0).any()
    return replace(found, errors=errors, used=used, labelled=np.array([True, False, True, False]))


def noise_of(rows):
    """A row for each track, each a little different, or one for all."""
    factors = np.linspace(1.0, 1.2, rows)
    return Noise(**{n: np.multiply.outer(factors, np.array(v)) for n, v in NUMBERS.items()})


@pytest.mark.parametrize("rows", [1, 4])
@pytest.mark.parametrize("biased", [True, False])
def test_values_and_derivatives_are_those_of_torch(linear, biased, rows):
    tracks, noise = LinearFilter(linear, 10.0, biased=biased), noise_of(rows)
    own, leaves = tracks.run(noise, tracks.measured(noise)), in_torch.leaves(noise)
    results = in_torch.run(tracks, leaves)[:3]
    sizes = [float(theirs.detach().abs().max()) for theirs in results]
    for mine, theirs, size in zip((own.means, own.covariances, own.nll), results, sizes, strict=True):
        np.testing.assert_allclose(mine, theirs.detach().numpy(), rtol=1e-7, atol=1e-9 * size)
    rng, names = np.random.default_rng(0), [f.name for f in fields(noise)]
    for kept in ((0,), (1,), (2,), (0, 1, 2)):  # functions of means, of covariances, of the densities, of all
        by = [(k in kept) * rng.standard_normal(theirs.shape) / sizes[k] for k, theirs in enumerate(results)]
        total = sum((theirs * torch.from_numpy(weight)).sum() for theirs, weight in zip(results, by, strict=True))
        expected = torch.autograd.grad(total, [getattr(leaves, n) for n in names], retain_graph=True, allow_unused=True)
        states = None if kept == (2,) else (by[0], by[1])
        found = tracks.noise_slopes(noise, own, *tracks.slopes(own, by[2], states))
        for name, theirs in zip(names, expected, strict=True):
            mine = getattr(found, name) if rows > 1 else getattr(found, name).sum(axis=0, keepdims=True)
            if theirs is None:
                assert not mine.any()
                continue
            size = float(theirs.abs().max())
            np.testing.assert_allclose(mine, theirs.numpy(), rtol=1e-6, atol=1e-8 * size)


def test_the_case_has_all_that_can_happen_to_a_sample(linear):
    """Samples within the tail, beyond it and far beyond it; `linear` has some that are not used."""
    tracks, noise = LinearFilter(linear, 10.0), noise_of(1)
    squares = in_torch.run(tracks, in_torch.leaves(noise))[-1].detach().numpy()
    assert NEXT_TAIL**2 < squares[0, 20] < 100 * NEXT_TAIL**2 < squares[1, 25]
    assert (squares[linear.used] < NEXT_TAIL**2).sum() > 100


def test_losses_change_by_the_integral_of_their_derivative(linear):
    """From much noise to far too little: a sample that stops to count on the way would make them jump."""
    tracks, parameters = LinearFilter(linear, 10.0), parameters_of(Settings(), linear, position_known=False)
    fit = MarginalFit(tracks, Settings(), parameters, most=1)
    scales = np.linspace(1.0, -4.0, 401)
    losses, gradients = zip(*(fit.at(fit.start + scale) for scale in scales), strict=True)
    slopes, total = np.sum(gradients, axis=2), np.array(losses)
    step = scales[1] - scales[0]
    simpson = step / 3.0 * (slopes[:-2:2] + 4.0 * slopes[1:-1:2] + slopes[2::2])
    np.testing.assert_allclose(simpson, np.diff(total[::2], axis=0), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("jobs", [2, 3, 9])
def test_threads_change_no_bit(linear, jobs):
    """Two and more tracks a thread, and more threads than tracks."""

    def run(tracks):
        noise = noise_of(4)
        found = tracks.run(noise, tracks.measured(noise))
        by, decays = tracks.slopes(found, 0.7, (found.means, found.covariances))
        return found.means, found.covariances, found.nll, by.process, by.memory, by.prior, by.measured, decays

    tracks = LinearFilter(linear, 10.0)
    for one, several in zip(run(tracks), with_jobs(jobs, run, tracks), strict=True):
        np.testing.assert_array_equal(one, several)


def test_a_covariance_that_is_none_is_refused(linear):
    tracks, noise = LinearFilter(linear, 10.0), noise_of(1)
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        tracks.run(noise, -tracks.measured(noise))


def test_a_search_that_steps_too_far_comes_back(linear, monkeypatch):
    """Rounding leaves no density where the first step leads to: the search ends where it would have ended anyway."""
    tracks, calls = LinearFilter(linear, 10.0, biased=True), []
    parameters = parameters_of(Settings(), linear, position_known=False)
    free, whole = MarginalFit(tracks, Settings(), parameters, tolerance=0.001, most=200), LinearFilter.losses

    def losses(self, noise):
        calls.append(1)
        if len(calls) == 3:  # the start is evaluated twice
            raise np.linalg.LinAlgError("the covariance of an innovation is not positive definite")
        return whole(self, noise)

    monkeypatch.setattr(LinearFilter, "losses", losses)
    again = MarginalFit(tracks, Settings(), parameters, tolerance=0.001, most=200)
    assert len(calls) > 4
    begin = free.at(free.start)[0].sum()
    assert begin - again.losses.sum() == pytest.approx(begin - free.losses.sum(), rel=0.02)
    assert begin - free.losses.sum() > 20.0
