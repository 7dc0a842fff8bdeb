"""The marginal likelihood against a dense Gaussian one, and its derivative against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from ballfg.diagnosis.evidence.likelihood import (
    LOST,
    Batches,
    Likelihood,
    Noise,
    Reduced,
    held_out,
    posterior,
    unweighted,
)
from ballfg.diagnosis.evidence.rows import batches_of, random_motion, rows_of
from ballfg.diagnosis.evidence.sizes import Start, settled, slopes_at
from ballfg.state import STATE_DIM

NOISE = Noise(0.1, (0.2, -0.3, 0.4, 0.1), (-0.7, -1.1, -0.4, -1.2, -0.6))


@pytest.fixture(scope="module")
def rows(make_ball, make_launches, make_shots, make_fit):
    """Rows of five shots with a bounce, three with a label; the first states have all nine numbers shown."""
    fit = make_fit(make_ball(), make_shots(make_ball(), make_launches(5, 11), 11, rate=40.0, duration=0.6).stretches)
    (found,) = rows_of(fit, random_motion(fit, ["flight.drag.k", "bounce.restitution.e"]))
    return replace(found, labelled=np.array([True, False, True, True, False]))


@pytest.fixture(scope="module")
def likelihood(rows):
    """With robust weights other than one."""
    rng = np.random.default_rng(3)
    samples = rng.uniform(0.3, 1.0, rows.used.shape)
    return Likelihood(rows, samples, rng.uniform(0.5, 1.0, len(rows.used)), np.full(len(rows.used), 0.25))


@pytest.fixture(scope="module")
def prior(rows):
    count = rows.by_common.shape[-1]
    return np.linspace(0.5, 2.0, count) * 10.0, np.linspace(-0.2, 0.3, count)


def dense_rows(likelihood, noise, precision, away):
    """The residual of all rows at once, first states' columns, and what each size and the priors add to the variance.

    Also a logarithm: places, velocities and labelled spins have the density of what samples and labels show of them.
    """
    rows, parts, logs = likelihood.rows, [], 0.0
    for i, used in enumerate(rows.used):
        kept = np.concatenate((np.repeat(used, 3), np.full(3, True)))
        weights = np.concatenate((np.repeat(likelihood.samples[i], 3), np.repeat(likelihood.spins[i], 3)))[kept]
        # a robust weight divides the variance in the square of the residual, and leaves the normalisation alone
        first = 3 * used.sum()
        number = np.arange(len(weights)) - first  # of a spin row: labels have one size, the others one an axis
        axes = [(number >= 0) & rows.labelled[i], *((number == axis) & ~rows.labelled[i] for axis in range(3))]
        sized = [(number < 0, noise.white), *zip(axes, noise.spin, strict=True)]
        added = [np.diag(np.exp(2.0 * size) / weights * own) for own, size in sized]
        for kind, size in enumerate(noise.random):
            columns = rows.random[i][kept][:, rows.kinds[i] == kind]
            added.append(np.exp(2.0 * size) * columns @ columns.T)
        parts.append((rows.residual[i][kept], rows.by_start[i][kept], rows.by_common[i][kept], added))
        whole = rows.by_start[i][kept]
        shown = np.linalg.svd(whole if rows.labelled[i] else whole[:-3, :6], compute_uv=False)
        logs += 0.5 * np.log(weights).sum() + likelihood.penalty[i] - np.log(shown).sum()
    common = np.concatenate([p[2] for p in parts])
    added = [linalg.block_diag(*(p[3][size] for p in parts)) for size in range(10)] + [common / precision @ common.T]
    left = np.concatenate([p[0] for p in parts]) - common @ away
    return left, linalg.block_diag(*(p[1] for p in parts)), added, logs


def dense(likelihood, noise, precision, away):
    """The density of all rows at once, its noise a full matrix, common unknowns random, first spins free."""
    left, starts, added, logs = dense_rows(likelihood, noise, precision, away)
    variance = sum(added)
    inverse = np.linalg.inv(variance)
    information = starts.T @ inverse @ starts
    solved = starts.T @ inverse @ left
    square = left @ inverse @ left - solved @ np.linalg.solve(information, solved)
    return -0.5 * (np.linalg.slogdet(variance)[1] + np.linalg.slogdet(information)[1] + square) - logs


def test_value_is_that_of_a_dense_gaussian(likelihood, prior):
    reduced, _ = likelihood.reduced(NOISE)
    found = posterior(reduced, *prior).evidence
    assert found == pytest.approx(dense(likelihood, NOISE, *prior), rel=1e-8)


@pytest.mark.parametrize("labelled", [True, False])
def test_value_is_the_same_in_other_units_of_what_has_no_prior(likelihood, prior, labelled):
    """A slower clock, a longer metre or labels in a larger unit alone make no first state more probable."""
    rows = replace(likelihood.rows, labelled=np.full(len(likelihood.rows.labelled), labelled))
    likelihood = replace(likelihood, rows=rows)
    units, free = np.eye(9), 9 if labelled else 6
    units[:free, :free] = np.random.default_rng(3).normal(size=(free, free))
    other = replace(likelihood, rows=replace(rows, by_start=rows.by_start @ units))
    values = [posterior(one.reduced(NOISE)[0], *prior).evidence for one in (likelihood, other)]
    assert values[1] == pytest.approx(values[0], abs=1e-6)


def slopes_of(likelihood, prior):
    batches = Batches((likelihood,))
    reduced, eliminated = batches.reduced(NOISE)
    return slopes_at(batches, NOISE, eliminated, posterior(reduced, *prior), *prior)


def test_batches_of_unlike_lengths_are_the_same_as_one(rows, prior):
    """Three stretches end early: they are narrower, and all numbers and their order are those of one wide batch."""
    used, kinds, random = rows.used.copy(), rows.kinds.copy(), rows.random.copy()
    for number, (samples, own) in {0: (8, 11), 2: (8, 9), 3: (14, 30)}.items():
        used[number, samples:], kinds[number, own:], random[number, ..., own:] = False, -1, 0.0
    there = np.concatenate((np.repeat(used, 3, axis=1), np.full((len(used), 3), True)), axis=1)
    parts = {"residual": rows.residual, "by_start": rows.by_start, "by_common": rows.by_common, "random": random}
    parts = {name: part * there.reshape(*there.shape, *[1] * (part.ndim - 2)) for name, part in parts.items()}
    short, batches = replace(rows, used=used, kinds=kinds, **parts), batches_of(used)
    widths = [int((kinds[batch.numbers] >= 0).sum(axis=1).max()) for batch in batches]
    narrow = [
        replace(
            short,
            numbers=batch.numbers,
            used=used[batch.numbers, : len(batch.rows) // 3 - 1],
            labelled=rows.labelled[batch.numbers],
            kinds=kinds[batch.numbers, :width],
            **{name: batch.of(part) for name, part in parts.items() if name != "random"},
            random=batch.of(parts["random"])[..., :width],
        )
        for batch, width in zip(batches, widths, strict=True)
    ]
    many, one = Batches.of(narrow).reweighted(NOISE), unweighted(short).reweighted(NOISE)
    assert [part.rows.used.shape[1] for part in many.parts] == [8, 14, rows.used.shape[1]]
    assert widths[:2] == [11, 30]
    whole = Batches((one,))
    (found, eliminated), (wide, local) = many.reduced(NOISE), whole.reduced(NOISE)
    np.testing.assert_allclose(found.constant, wide.constant, rtol=1e-9)
    np.testing.assert_allclose(found.gram, wide.gram, rtol=1e-7, atol=1e-9 * np.abs(wide.gram).max())
    at = posterior(found, *prior)
    slopes = slopes_at(many, NOISE, eliminated, at, *prior), slopes_at(whole, NOISE, local, at, *prior)
    np.testing.assert_allclose(slopes[0].slope, slopes[1].slope, rtol=1e-7)
    np.testing.assert_allclose(slopes[0].information, slopes[1].information, rtol=1e-6, atol=1e-6)
    again, beside = many.beside(slopes[0].along, NOISE), one.beside(slopes[1].along[0], NOISE)
    for part in again.parts:
        np.testing.assert_allclose(part.samples, beside.samples[part.rows.numbers, : part.samples.shape[1]], rtol=1e-9)


def test_derivative_is_that_of_differences(likelihood, prior):
    def value(vector):
        return posterior(likelihood.reduced(Noise.of(vector))[0], *prior).evidence

    slope = slopes_of(likelihood, prior).slope
    step = 1e-5
    moved = [NOISE.vector + step * sign * axis for axis in np.eye(10) for sign in (1, -1)]
    differences = np.array([value(v) for v in moved]).reshape(10, 2) @ [1, -1] / (2 * step)
    np.testing.assert_allclose(slope, differences, rtol=1e-6, atol=1e-6 * np.abs(slope).max())


def test_information_is_the_average_of_the_observed_and_the_expected(likelihood, prior):
    """By dense matrices: P y is the residual over the variance, with first states out, and dV / dz = 2 V of a size."""
    found = slopes_of(likelihood, prior).information
    left, starts, added, _ = dense_rows(likelihood, NOISE, *prior)
    inverse = np.linalg.inv(sum(added))
    without = inverse - inverse @ starts @ np.linalg.solve(starts.T @ inverse @ starts, starts.T @ inverse)
    shown = np.stack([2.0 * one @ without @ left for one in added[:10]])
    np.testing.assert_allclose(found, 0.5 * shown @ without @ shown.T, rtol=1e-6, atol=1e-8 * np.abs(found).max())


def test_unknowns_held_have_the_density_that_they_have_where_they_are(likelihood, prior):
    """Against the posterior of the others alone, the first three unknowns at their present values."""
    reduced, _ = likelihood.reduced(NOISE)
    precision, away = prior
    found, total = posterior(reduced, *prior), reduced.gram.sum(axis=0)
    held, kept = found.held(3), np.arange(3, len(total))
    rest = posterior(type(reduced)(reduced.constant, total[None][:, kept][..., kept]), precision[3:], away[3:])
    np.testing.assert_allclose(held.mean, np.append(np.zeros(3), rest.mean), atol=1e-9)
    assert held.square == pytest.approx(rest.square + precision[:3] @ away[:3] ** 2, rel=1e-9)
    assert found.evidence - held.evidence == pytest.approx(0.5 * (held.square - found.square), rel=1e-6)


def test_common_unknowns_are_those_of_generalised_least_squares(likelihood, prior):
    """The posterior's mean maximises the density with the unknowns held, so that its gradient there vanishes."""
    reduced, _ = likelihood.reduced(NOISE)
    found = posterior(reduced, *prior)
    precision, away = prior
    total = reduced.gram.sum(axis=0)
    gradient = total[:-1, -1] - total[:-1, :-1] @ found.mean - precision * (found.mean - away)
    assert np.abs(gradient).max() < 1e-8 * np.abs(total[:-1, -1]).max()
    np.testing.assert_allclose(found.covariance @ (total[:-1, :-1] + np.diag(precision)), np.eye(len(away)), atol=1e-8)


def test_local_step_leaves_no_gradient(likelihood, prior):
    total, _ = likelihood.inner(NOISE)
    end = STATE_DIM + likelihood.rows.kinds.shape[1]
    common = 0.1 * prior[1]
    local = likelihood.local_step(NOISE, common)
    left = total[:, :end, -1] - total[:, :end, end:-1] @ common - (total[:, :end, :end] @ local[..., None])[..., 0]
    assert np.abs(left).max() < 1e-8 * np.abs(total[:, :end, -1]).max()


def test_sizes_of_noise_come_back(make_ball, make_launches, make_shots, make_fit):
    """White noise of twice the stated size, and nothing else: random motion stays far below its unit."""
    shots = make_shots(make_ball(), make_launches(30, 17), 17, rate=60.0, duration=0.5).stretches
    fit = make_fit(make_ball(), shots, settle_noise=False)
    rows = rows_of(fit, random_motion(fit, ()))
    halved = [replace(batch, residual=2.0 * batch.residual) for batch in rows]
    precision = fit.problem.common_precision
    _, noise = settled(halved, precision, np.zeros(len(precision)))
    _, plain = settled(rows, precision, np.zeros(len(precision)))
    assert noise.white - plain.white == pytest.approx(np.log(2.0), abs=0.05)
    assert max(noise.random[0], plain.random[0]) < -1.5


def test_the_best_of_several_starts_counts(rows, prior):
    """A start with noise that the samples do not have may end elsewhere; beside the usual one it does no harm."""
    starts = (Start(Noise(-1.0, (1.0,) * 4, (2.0, 2.0, 2.0, 1.0, 1.0))), None)
    values = [
        posterior(one.reduced(noise)[0], *prior).evidence
        for one, noise in (settled([rows], *prior, s) for s in ((starts[0],), (None,), starts))
    ]
    assert values[2] > max(values) - 0.05


@pytest.mark.parametrize("part", ["residual", "by_start", "by_common"])
def test_a_path_far_off_all_samples_has_hardly_any_density(rows, prior, part):
    """A fit may end with a flight that left the room: it must lose, and not by chance of rounding win."""
    far = getattr(rows, part).copy()
    far[0] *= 1e100
    likelihood, noise = settled([replace(rows, **{part: far})], *prior)
    assert posterior(likelihood.reduced(noise)[0], *prior).evidence < -1e6


@pytest.mark.parametrize("bad", [0, 4])
def test_a_model_that_rounding_left_indefinite_has_no_density_and_bears_nothing_out(likelihood, prior, bad):
    reduced, _ = likelihood.reduced(NOISE)
    gram = reduced.gram.copy()
    gram[bad, 0, 0] = -10.0 * (np.abs(gram[:, 0, 0]).sum() + prior[0][0])
    broken, halves = Reduced(reduced.constant, gram), np.array([True, False, True, False, False])
    found = posterior(broken, *prior)
    assert found.evidence == -np.inf
    assert found.gain() == 0.0
    assert (held_out(broken, *prior, halves) == LOST).all()
    assert (held_out(reduced, *prior, halves) > LOST).all()


def test_common_columns_that_first_states_nearly_explain_keep_their_digits(likelihood, prior):
    """First states have no prior here: what of a common column they explain, however large, changes nothing."""
    rows = replace(likelihood.rows, labelled=np.full(len(likelihood.rows.labelled), True))
    of_states = np.random.default_rng(5).normal(size=(len(rows.used), 9, rows.by_common.shape[-1]))
    plain, far = (
        replace(likelihood, rows=replace(rows, by_common=rows.by_common + size * rows.by_start @ of_states))
        for size in (0.0, 1e4)
    )
    (found, _), (reference, _) = far.reduced(NOISE), plain.reduced(NOISE)
    total, _ = far.inner(NOISE)
    assert 1e-6 < np.finfo(float).eps * np.diagonal(total, axis1=1, axis2=2).max() < 1.0
    np.testing.assert_allclose(found.constant, reference.constant, rtol=1e-9)
    np.testing.assert_allclose(found.gram, reference.gram, atol=1e-6)
