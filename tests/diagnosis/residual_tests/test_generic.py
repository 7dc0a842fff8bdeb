"""Tests for patterns without a name: alarms as rare as stated, planted patterns found and put into words.

What is left is noise only if the other half of the tracks errs as that noise expects.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from ballfg.diagnosis import diagnose
from ballfg.diagnosis.fit.patterns import EVERYWHERE, PLAUSIBLE, WORLD, Block, blocks_of
from ballfg.diagnosis.fit.response import responses
from ballfg.diagnosis.generic_test import ALARM, PREDICTED
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.hypotheses.signatures import Signatures, hypothesis_columns
from ballfg.diagnosis.report.headline import headline
from ballfg.diagnosis.residual_tests.generic import generic_tests, predicted_test, where
from ballfg.diagnosis.residual_tests.whiteness import REACHES, whiteness
from ballfg.diagnosis.result import Errors, Verdict
from ballfg.diagnosis.search.evaluation import error_of_mean
from ballfg.diagnosis.search.score import pattern_tests
from ballfg.dynamics import EFFECTS, load_model
from ballfg.dynamics.effects.generic import GenericFlight
from ballfg.simulation import SimulationConfig, parse_effects, write_simulation
from ballfg.tracks import read_dataset

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # torch's own
PULL = -0.6
"""1/s^2, along x in proportion to the distance from x = 1.4 m."""


@pytest.fixture(scope="module")
def calm(make_known_ball, make_known_fit, make_launches, make_shots):
    return make_known_fit(make_shots(make_known_ball(), make_launches(16, 3), 3).stretches)


@pytest.fixture(scope="module")
def pulled(make_known_ball, make_known_fit, make_launches, make_shots):
    return make_known_fit(make_shots(make_known_ball(GenericFlight(x_x=PULL)), make_launches(16, 4), 4).stretches)


def left_of_noise(system, rng, kind):
    """(n, m) what first states leave of noise; `uneven`: of another size on each track; `heavy`: with tails."""
    n, m, _ = system.by_start.shape
    drawn = rng.standard_normal((n, m))
    if kind == "uneven":
        drawn *= np.exp(0.3 * rng.standard_normal((n, 1)))
    if kind == "heavy":
        drawn /= np.sqrt(rng.chisquare(5, (n, m)) / 3.0)
    basis, _ = np.linalg.qr(system.by_start)
    return drawn - (basis @ (basis.swapaxes(-1, -2) @ drawn[..., None]))[..., 0]


@pytest.mark.parametrize("kind", ["even", "uneven", "heavy"])
def test_whiteness_raises_no_more_alarms_than_stated(calm, kind):
    system = calm.linearised
    rng, count = np.random.default_rng(0), 60
    results = [whiteness(calm, replace(system, residual=left_of_noise(system, rng, kind))) for _ in range(count)]
    standard = np.array([r.explained / r.spread for r in results])
    np.testing.assert_array_less(np.abs(standard.mean(axis=0)), 4.0 / np.sqrt(count))
    np.testing.assert_array_less(np.abs(standard.std(axis=0) - 1.0), 0.4)
    alarms = sum(r.p_value < 0.05 for r in results)
    assert alarms <= stats.binom.ppf(0.999, count, 0.05)


def test_drift_of_each_track_by_itself_is_not_white(calm):
    system = calm.linearised
    n, k = calm.problem.stretches.times.shape
    rng, size = np.random.default_rng(1), 0.8
    times = calm.problem.stretches.times.numpy()
    wave = np.sqrt(2.0) * size * np.sin(2 * np.pi * times / 0.12 + rng.uniform(0.0, 6.0, (n, 1)))
    drifting = left_of_noise(system, rng, "even")
    drifting[:, : 3 * k] += (wave[..., None] * np.array((1.0, 0.0, 0.0))).reshape(n, -1)
    found = whiteness(calm, replace(system, residual=drifting))
    assert found.p_value < 1e-6
    assert found.reach == REACHES[0]
    # the wave is on one axis of three; within 20 ms it keeps 0.6 of its product (a Gaussian of 20 ms, a period of 120)
    np.testing.assert_allclose(found.drift, 0.003 * size * np.sqrt(0.6 / 3.0), rtol=0.35)


def random_signatures(rng, tracks, directions, common=2, rows=40):
    """Tracks of very unequal information, noise without a pattern."""
    columns = rng.standard_normal((tracks, rows, common + directions + 1))
    columns[..., :-1] *= np.exp(0.5 * rng.standard_normal((tracks, 1, 1)))
    flat, noise = columns[..., :common].reshape(-1, common), columns[..., -1].ravel()
    columns[..., -1] -= (flat @ np.linalg.lstsq(flat, noise, rcond=None)[0]).reshape(tracks, rows)
    return Signatures(columns.swapaxes(-1, -2) @ columns, np.full(common, 1e-6), common)


@pytest.mark.parametrize(("tracks", "directions"), [(6, 1), (12, 3), (25, 6)])
def test_few_and_unequal_tracks_raise_no_more_alarms_than_stated(tracks, directions):
    rng, count = np.random.default_rng(2), 400
    values = np.array(
        [
            pattern_tests(random_signatures(rng, tracks, directions), [np.eye(directions)])[0].p_value
            for _ in range(count)
        ]
    )
    for level in (0.1, 0.01):
        assert (values < level).sum() <= stats.binom.ppf(0.999, count, 1.2 * level)
    assert 0.4 < values.mean() < 0.65


def test_planted_pattern_is_estimated_and_explained():
    rng, strength = np.random.default_rng(3), np.array((0.3, -0.2))
    found = random_signatures(rng, 20, 2)
    gram = found.gram.copy()
    moved = gram[:, :-1, 2:4] @ strength
    gram[:, :-1, -1] += moved
    (pattern,) = pattern_tests(Signatures(gram, found.precision, 2), [np.eye(2)])
    sigma = np.sqrt(np.diagonal(np.linalg.inv(pattern.information)))
    np.testing.assert_array_less(np.abs(pattern.estimate - strength), 4.0 * sigma)
    assert pattern.p_value < 1e-5
    noise = np.sqrt(4.0 * strength @ pattern.information @ strength)
    assert abs(pattern.explained - strength @ pattern.information @ strength) < 4.0 * noise


def test_a_track_that_tells_nothing_of_a_pattern_does_no_harm():
    found = random_signatures(np.random.default_rng(4), 12, 1)
    gram = found.gram.copy()
    gram[3] = 0.0
    (pattern,) = pattern_tests(Signatures(gram, found.precision, 2), [np.eye(1)])
    assert 0.0 < pattern.p_value < 1.0


def test_nothing_is_found_where_nothing_is(calm):
    assert min(t.p_value for t in generic_tests(calm)) > ALARM


def test_a_pull_is_found_and_said_where_it_lives(pulled):
    first = next(t for t in generic_tests(pulled) if t.name == "flight" and "along x" in t.where)
    assert first.p_value < ALARM
    assert first.share == 1.0
    assert first.where.startswith("flight: acceleration along x depends on place along x, up to ")
    size = float(first.where.split("up to ")[1].split()[0])
    x = pulled.predicted.positions[..., 0]
    np.testing.assert_allclose(size, abs(PULL) * np.percentile(np.abs(x - x.mean()), 95), rtol=0.3)


def test_an_average_over_frames_is_found_at_contacts(make_known_ball, make_known_fit, make_launches, make_shots):
    """A tracker that reports the mean of three frames is late, which no track shows, and cuts corners, which all do."""
    exact = make_shots(make_known_ball(), make_launches(16, 5), 5, rate=200.0, noise=0.0).stretches
    shown = np.moveaxis(exact.positions.numpy(), 1, 0)
    mean = np.moveaxis([shown[max(0, i - 2) : i + 1].mean(axis=0) for i in range(len(shown))], 0, 1)
    noise = np.random.default_rng(5).normal(0.0, 0.001, mean.shape)
    positions, sigmas = torch.from_numpy(mean + noise), torch.full_like(exact.sigmas, 0.001)
    found = generic_tests(make_known_fit(replace(exact, positions=positions, sigmas=sigmas)))
    assert found[0].p_value < ALARM
    assert found[0].where.startswith("measurement: error of position vertically depends on nearness ")
    assert found[0].where.split(" a contact, up to ")[0].split()[-1] in ("before", "after")
    size = float(found[0].where.split("up to ")[1].split()[0])
    assert 2.0 < size < 9.0  # mm: at a contact a velocity turns by 5 m/s, and the mean is off by a third of 5 ms of it


def test_share_is_what_is_left_of_the_start(pulled, make_known_fit):
    explained = make_known_fit(pulled.problem.stretches, GenericFlight(x_x=0.9 * PULL))
    tests = {t.where.split(",")[0]: t for t in generic_tests(explained, pulled)}
    assert max(t.share for t in tests.values() if t.name in ("flight", "time")) < 0.1


def test_columns_of_a_block_are_those_of_the_generic_effect(calm):
    block = blocks_of(calm)[0]
    assert block.quantities[1] == "place along x"
    one, x = (
        hypothesis_columns(calm, [Hypothesis(GenericFlight, {"center_x": 0.0}, (n,))])[..., 0] for n in ("y_one", "y_x")
    )
    scatter = 1.0 / np.ptp(block.values[:, 1]) * np.ptp(x_of(calm))
    place = 4 + 1  # along y, place along x
    np.testing.assert_allclose(block.columns[..., 4], PLAUSIBLE["flight"] * one, atol=2e-3 * np.abs(one).max())
    rest = block.columns[..., place] * scatter - x
    shift = (rest * one).sum() / (one * one).sum()  # a centre is a share of the column that acts everywhere
    np.testing.assert_allclose(rest, shift * one, atol=5e-3 * np.abs(x).max())


def test_every_quantity_of_a_block_differs_over_the_data(calm):
    """They are in units of their scatter. The height of a contact, that of the table, would be the same in all."""
    kinds = set()
    for block in blocks_of(calm):
        changing = [name != EVERYWHERE for name in block.quantities]
        values = block.values.reshape(-1, len(block.quantities))
        np.testing.assert_allclose(values.std(axis=0), changing, atol=1e-9)
        np.testing.assert_allclose(values.mean(axis=0), np.logical_not(changing), atol=1e-9)
        kinds.add(block.kind)
    assert kinds == {"flight", "contact", "measurement"}


def x_of(fitted):
    """m, along x at the nodes of all arcs."""
    return np.concatenate([arc.nodes[..., 0].ravel() for arc in responses(fitted)])


def test_where_names_the_largest_part():
    values = np.stack((np.ones(100), np.linspace(-1.0, 1.0, 100)), axis=-1)
    block = Block("measurement", ("everywhere", "height"), WORLD, values, np.zeros((1, 1, 6)))
    strengths = np.array(((0.0, 0.1), (0.0, 0.0), (0.0, 0.5)))
    assert where(block, strengths) == "measurement: error of position vertically depends on height, up to 4.8 mm"
    strengths = np.array(((0.9, 0.1), (0.0, 0.0), (0.0, 0.5)))
    assert where(block, strengths).startswith("measurement: error of position along x is off everywhere, up to ")


def errors(rmse_mm: float, nis: float, nis_error: float, tracks: int = 8) -> Errors:
    return Errors(rmse_mm, 0.0, nis, 0.0, np.full(tracks, rmse_mm), nis_error=nis_error)


def odd_or_even(folder: Path, rest: int) -> list[dict[str, str]]:
    """Rows of every second track."""
    with (folder / "tracks.csv").open(encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if int(row["trajectory"]) % 2 == rest]


def test_chance_raises_no_alarm():
    """The noise is known from as many tracks as are judged, and errors of a track go together: two are independent."""
    rng, loud = np.random.default_rng(2), 0
    for _ in range(4000):
        known = rng.chisquare(2, 10).mean() / 2.0
        squares = [np.repeat(one / 2.0 / known, 30) for one in rng.chisquare(2, 10)]
        judged = errors(9.0, float(np.mean(squares)), error_of_mean(squares), 10)
        loud += predicted_test(judged, judged, 10).p_value < ALARM
    assert loud < 4000 * 2 * ALARM


@pytest.mark.parametrize(
    ("before", "after", "share"),
    [
        (errors(100.0, 20.0, 2.0), errors(100.0, 20.0, 2.0), 1.0),  # nothing found: all of it is left
        (errors(100.0, 20.0, 2.0), errors(10.0, 2.0, 0.1), 50.0 / 9950.0),
        (errors(50.0, 20.0, 2.0), errors(100.0, 20.0, 2.0), 1.0),  # predictions got worse
    ],
)
def test_the_share_is_that_of_the_squared_error_beyond_the_noise(before, after, share):
    test = predicted_test(before, after, 8)
    assert test.p_value < ALARM
    assert test.share == pytest.approx(share)


def test_without_a_scatter_nothing_is_said():
    for after in (errors(9.0, 2.0, float("nan"), 1), errors(9.0, float("nan"), 0.1), errors(9.0, 0.8, 0.1)):
        assert predicted_test(after, after, 8).p_value == 1.0


def test_balls_thrown_in_turn_are_not_noise(tmp_path):
    """A fan runs at every second shot: the half that is searched sees none of it, and fits well."""
    for name, effects in (("still", ()), ("fan", parse_effects(["wind.x=1"]))):
        write_simulation(tmp_path / name, SimulationConfig(tracks=12, rate=60.0, seed=5, undeclared=effects))
    rows = [row for rest, name in enumerate(("still", "fan")) for row in odd_or_even(tmp_path / name, rest)]
    with (tmp_path / "still" / "tracks.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(sorted(rows, key=lambda row: row["trajectory"]))
    folder = tmp_path / "still"
    model = load_model(folder / "model.yaml")
    diagnosis = diagnose(read_dataset(folder), model, catalogue=[EFFECTS["spin_decay"]])
    assert not diagnosis.findings
    assert diagnosis.verdict is Verdict.UNEXPLAINED
    assert diagnosis.unexplained.where.startswith(f"{PREDICTED}: ")
    assert "noise expects" in headline(diagnosis)
