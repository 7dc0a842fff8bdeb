"""The bridge to GTSAM: answers from the batch, checks before anything goes back, no leaks, the same minimum."""

import gc
import re
import weakref

import gtsam
import numpy as np
import pytest
import torch

from ballfg.dynamics import nominal_model, rollout
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import Smoother
from ballfg.estimation.observations.registry import OBSERVATIONS
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Values
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY, Bridge, from_gtsam, key_of, nonlinear_graph, to_gtsam
from ballfg.factors.check import check_factor, jacobian_errors
from ballfg.factors.dynamics import ContactFactors, FlightFactors, RestFactors
from ballfg.factors.graph import BallGraph, LevenbergMarquardt
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.factors.position import PositionFactors
from ballfg.factors.prior import coefficient_prior, spin_prior, state_prior
from ballfg.tracks import Track
from tests.places import DOCS

N = 12
NAMES = ("flight.drag.k", "flight.magnus.k")
COEFFICIENT_SIGMA = np.array([0.03, 0.001])


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def problem(rng, *, loss=None, coefficients=False, outlier=False):
    """A short flight: graph, start."""
    model = nominal_model()
    times = torch.arange(N, dtype=torch.float64) * 0.02
    start = torch.tensor([[0.0, 0.0, 0.4, 5.0, 0.5, 1.5, 0.0, 80.0, 20.0]], dtype=torch.float64)
    truth = rollout(model, start, times, Surfaces(-5.0))[0].detach().numpy()
    measured = truth[:, :3] + 0.003 * rng.standard_normal((N, 3))
    if outlier:
        measured[5] += 0.1
    means = np.zeros(0)
    if coefficients:
        parameters = dict(model.named_parameters())
        means = np.array([float(parameters[name].detach()) for name in NAMES])
        model = AugmentedModel(model, NAMES)
    dt = np.full(N - 1, 0.02)
    kinds: list[FactorBatch] = [
        PositionFactors(np.arange(N), measured, np.full((N, 3), 0.003), loss),
        FlightFactors(model, np.arange(N - 1), dt, ProcessNoise().flight(dt)),
        state_prior(0, np.zeros(9), np.repeat([5.0, 20.0, 60.0], 3)),
    ]
    if coefficients:
        kinds.append(coefficient_prior(means * 1.2, COEFFICIENT_SIGMA))
    states = truth + rng.standard_normal((N, 9)) * np.repeat([0.01, 0.3, 10.0], 3)
    return BallGraph(tuple(kinds)), Values(states, means)


def gtsam_minimum(graph, start):
    """GTSAM's own loop, to tolerances of the error."""
    factors, bridges = nonlinear_graph(graph)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-13)
    parameters.setAbsoluteErrorTol(1e-13)
    parameters.setMaxIterations(100)
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, to_gtsam(start), parameters)
    return from_gtsam(optimizer.optimize()), optimizer, bridges


@pytest.mark.parametrize("coefficients", [False, True])
@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 2.0), Loss("cauchy", 3.0)])
def test_gtsams_own_optimizer_reaches_our_minimum(rng, loss, coefficients):
    graph, start = problem(rng, loss=loss, coefficients=coefficients, outlier=loss.name != "squared")
    ours = LevenbergMarquardt(tolerance=1e-9).minimize(graph, start)
    theirs, optimizer, bridges = gtsam_minimum(graph, start)
    assert optimizer.error() == pytest.approx(ours.error, rel=1e-9)
    # GTSAM stops on the error: a relative change of 1e-13 bounds the last step to about 1e-5 standard deviations
    off = np.abs(theirs.states - ours.values.states).max(axis=0)
    assert off[:6].max() < 1e-6
    assert off[6:].max() < 1e-3
    assert theirs.coefficients == pytest.approx(ours.values.coefficients, abs=1e-6)
    # one call for each point that GTSAM looks at: the start, and trial steps, of which few are refused
    assert all(bridge.calls == bridge.misses <= 3 * (optimizer.iterations() + 1) for bridge in bridges)


def test_values_travel_there_and_back(rng):
    _, start = problem(rng, coefficients=True)
    there = to_gtsam(start)
    assert there.size() == N + 1
    assert np.array_equal(there.atVector(gtsam.symbol("x", 3)), start.states[3])
    assert np.array_equal(there.atVector(gtsam.symbol("c", 0)), start.coefficients)
    back = from_gtsam(there)
    assert np.array_equal(back.states, start.states)
    assert np.array_equal(back.coefficients, start.coefficients)
    assert key_of(COEFFICIENTS) == COEFFICIENT_KEY
    assert key_of(4) == STATE_KEY + 4


def test_a_factor_linearises_to_the_rows_of_its_kind(rng):
    graph, start = problem(rng, coefficients=True)
    values = to_gtsam(start)
    for kind in graph.batches:
        rows = kind.linearize(start)
        for row, factor in enumerate(Bridge(kind).factors()):
            matrix, b = factor.linearize(values).jacobian()
            assert np.array_equal(b, -rows.residual[row])
            assert np.array_equal(matrix, np.concatenate([j[row] for j in rows.jacobians], axis=1))
            assert factor.error(values) == pytest.approx(0.5 * float(rows.residual[row] @ rows.residual[row]))


def test_a_miss_evaluates_all_changed_rows_at_once(rng):
    graph, start = problem(rng)
    bridge = Bridge(graph.batches[1])
    factors, values = bridge.factors(), to_gtsam(start)
    for factor in factors:
        factor.linearize(values)
        factor.error(values)
    assert (bridge.calls, bridge.misses) == (1, 1)
    values.update(STATE_KEY + 4, start.states[4] + 1e-9)
    seen = []
    compute = bridge.batch.compute
    bridge.batch.compute = lambda rows, inputs: (seen.append(rows.tolist()), compute(rows, inputs))[1]
    for factor in factors:
        factor.linearize(values)
    assert seen == [[3, 4]]


def test_rows_without_values_are_left_alone(rng):
    graph, start = problem(rng)
    part = gtsam.Values()
    for i in (2, 3):
        part.insert(STATE_KEY + i, start.states[i])
    bridge = Bridge(graph.batches[1])
    assert np.isfinite(bridge.factor(2).error(part))


def test_prepared_rows_are_answered_without_a_call(rng):
    graph, start = problem(rng)
    bridge = Bridge(graph.batches[1], "row")
    rows = np.array([1, 5])
    bridge.prepare(rows, (start.states[rows], start.states[rows + 1]))
    values = to_gtsam(start)
    bridge.factor(5).linearize(values)
    assert (bridge.calls, bridge.misses) == (1, 0)
    bridge.factor(6).linearize(values)
    assert (bridge.calls, bridge.misses) == (2, 1)


def test_an_unknown_policy_is_refused(rng):
    graph, _ = problem(rng)
    with pytest.raises(ValueError, match="on_miss must be 'changed' or 'row'; got 'all'"):
        Bridge(graph.batches[0], "all")


class Bad(FactorBatch):
    """Two factors on one state each, spoiled by `spoil`."""

    def __init__(self, spoil):
        super().__init__(np.array([[0], [1]]), 3)
        self.spoil = spoil

    def compute(self, rows, inputs):
        k = len(inputs[0])
        return self.spoil(inputs[0][:, :3].copy(), (np.tile(np.eye(3, 9), (k, 1, 1)),))


def _set(array, index, value):
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda r, j: (r, ()), "one Jacobian per variable, 1; got 0"),
        (lambda r, j: (r, (None,)), "Jacobian 0 must be a numpy array of shape (2, 3, 9); got NoneType"),
        (lambda r, j: (r, (j[0][:, 0],)), "Jacobian 0 must have shape (2, 3, 9); got (2, 9)"),
        (lambda r, j: (r, (np.pad(j[0], ((0, 0), (0, 0), (0, 1))),)), "must have shape (2, 3, 9); got (2, 3, 10)"),
        (lambda r, j: (r[:, :2], j), "residual must have shape (2, 3); got (2, 2)"),
        (lambda r, j: (r, (j[0].astype(np.float32),)), "Jacobian 0 must be float64; got float32"),
        (lambda r, j: 1 / 0, "division by zero"),
    ],
)
@pytest.mark.parametrize("ask", ["linearize", "error"])
def test_what_is_wrong_raises_before_it_reaches_gtsam(spoil, message, ask):
    values = to_gtsam(Values(np.ones((2, 9)), np.zeros(0)))
    factor = Bridge(Bad(spoil)).factor(0)
    with pytest.raises((ValueError, ZeroDivisionError), match=re.escape(message)):
        getattr(factor, ask)(values)


@pytest.mark.parametrize(
    ("spoil", "what"),
    [
        (lambda r, j: (_set(r, (0, 2), np.nan), j), "residual"),
        (lambda r, j: (r, (_set(j[0], (0, 0, 0), np.inf),)), "Jacobian 0"),
    ],
)
def test_what_is_not_finite_is_a_step_too_long_or_raises(spoil, what):
    """An optimizer that judges a step hears that it leads to infinity; a linearisation there, or iSAM2's, raises."""
    values = to_gtsam(Values(np.ones((2, 9)), np.zeros(0)))
    bridge = Bridge(Bad(spoil))
    assert bridge.factor(0).error(values) == np.inf
    with pytest.raises(ValueError, match="residual and Jacobians must be finite; row 0 is not"):
        bridge.factor(0).linearize(values)
    for ask in ("error", "linearize"):
        with pytest.raises(ValueError, match=f"{what} must be finite; row 0 is not"):
            getattr(Bridge(Bad(spoil), "row").factor(0), ask)(values)


def test_an_exception_leaves_an_optimizer_usable():
    trouble = [True]

    def spoil(r, j):
        if trouble[0]:
            raise ArithmeticError("no")
        return r, j

    graph = BallGraph((Bad(spoil), *(state_prior(i, np.ones(9), np.ones(9)) for i in range(2))))
    factors, _ = nonlinear_graph(graph)
    start = to_gtsam(Values(np.full((2, 9), 3.0), np.zeros(0)))
    with pytest.raises(ArithmeticError, match="no"):
        gtsam.GaussNewtonOptimizer(factors, start).optimize()
    trouble[0] = False
    assert from_gtsam(gtsam.GaussNewtonOptimizer(factors, start).optimize()).states[0, :3] == pytest.approx(0.5)


@pytest.mark.parametrize("order", ["C", "F"])
def test_memory_order_does_not_matter(order):
    def spoil(r, j):
        block = np.arange(54.0).reshape(2, 3, 9)
        return np.asarray(r, order=order), (np.asfortranarray(block) if order == "F" else block,)

    values = to_gtsam(Values(np.ones((2, 9)), np.zeros(0)))
    matrix, _ = Bridge(Bad(spoil)).factor(1).linearize(values).jacobian()
    assert np.array_equal(matrix, np.arange(27.0, 54.0).reshape(3, 9))


def test_nothing_keeps_a_graph_alive(rng):
    graph, start = problem(rng)
    _, optimizer, bridges = gtsam_minimum(graph, start)
    watched = [weakref.ref(bridge) for bridge in bridges] + [weakref.ref(kind) for kind in graph.batches]
    del graph, optimizer, bridges
    gc.collect()
    assert [ref() for ref in watched] == [None] * len(watched)


def test_isam2_lets_go_of_removed_factors(rng):
    graph, start = problem(rng)
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    isam = gtsam.ISAM2(parameters)
    factors, _ = nonlinear_graph(graph)
    bridge = Bridge(state_prior(3, np.zeros(9), np.full(9, 100.0)))
    factors.push_back(bridge.factor(0))
    result = isam.update(factors, to_gtsam(start))
    watched = weakref.ref(bridge)
    del factors, bridge
    gc.collect()
    assert watched() is not None
    isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), list(result.getNewFactorsIndices())[-1:])
    gc.collect()
    assert watched() is None


def test_the_checker_names_the_bad_block(rng):
    graph, start = problem(rng, coefficients=True)
    kind = graph.batches[1]
    assert check_factor(kind, start) < 1e-6
    compute = kind.compute

    def wrong(rows, inputs):
        residual, jacobians = compute(rows, inputs)
        jacobians[2][4, 3, 1] *= 1.01
        return residual, jacobians

    kind.compute = wrong
    with pytest.raises(AssertionError, match=r"FlightFactors: row 4, block 2 \(by c\), entry \(3, 1\)"):
        check_factor(kind, start)
    assert sum(error.relative > 1e-6 for error in jacobian_errors(kind, start)) == 1


class Heights(FactorBatch):
    """r = (z_i - measured_i) / sigma, right or with a mistake of a user's."""

    row_arrays = ("variables", "measured")

    def __init__(self, measured, mistake=None):
        super().__init__(np.arange(len(measured))[:, None], 1)
        self.measured, self.mistake = np.asarray(measured), mistake
        if mistake == "unnamed":
            self.row_arrays = ("variables",)

    def compute(self, rows, inputs):
        measured = self.measured if self.mistake == "unindexed" else self.measured[rows]
        residual = (inputs[0][:, 2:3] - measured[: len(inputs[0]), None]) / 0.01
        jacobian = np.tile(np.eye(1, 9, 2) / 0.01, (len(residual), 1, 1))
        if self.mistake == "flat":
            return residual[:, 0], (jacobian,)
        if self.mistake == "single":
            return residual.astype(np.float32), (jacobian,)
        return residual, jacobian if self.mistake == "bare" else (jacobian,)


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        ("flat", r"Heights.compute: residual must have shape \(3, 1\); got \(3,\)"),
        ("single", "Heights.compute: residual must be float64; got float32"),
        ("bare", "Heights.compute must return one Jacobian per variable, 1; got 3"),
    ],
)
def test_the_smoother_names_what_is_wrong_in_a_batch_of_a_user(mistake, message):
    times = np.arange(20) / 100
    track = Track(times, np.outer(times, [3.0, 0.0, 1.0]) - np.outer(times**2, [0.0, 0.0, 4.9]) + [0.0, 0.0, 0.9])
    with pytest.raises(ValueError, match=message):
        Smoother(nominal_model(), 0.0).estimate(track, factors=[Heights([0.9, 0.9, 0.9], mistake)])


def test_a_factor_on_a_sample_that_a_track_lacks_is_refused():
    track = Track(np.arange(3) / 100, np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"the index of a sample, at most 2; got 3\. Count samples from 0"):
        Smoother(nominal_model(), 0.0).estimate(track, factors=[Heights([0.9] * 4)])


@pytest.mark.parametrize("mistake", ["unnamed", "unindexed"])
def test_the_checker_finds_rows_that_are_not_their_own(mistake):
    """Filters and GTSAM would take the first row's measurement for every one."""
    values = Values(np.tile(np.arange(9.0), (3, 1)), np.zeros(0))
    assert check_factor(Heights([1.0, 2.0, 3.0]), values) < 1e-6
    with pytest.raises(AssertionError, match=r"Heights: row 1 by itself must be that of the whole batch\. Name all"):
        check_factor(Heights([1.0, 2.0, 3.0], mistake), values)


def test_the_checker_passes_every_kind(rng):
    model = nominal_model()
    states = np.tile([0.0, 0.0, 0.05, 4.0, 0.4, -3.0, 20.0, 60.0, -30.0], (3, 1))
    states += rng.standard_normal((3, 9)) * np.repeat([0.003, 0.3, 10.0], 3)
    values = Values(states, np.zeros(0))
    dt, rows = np.array([0.012, 0.018]), np.arange(2)
    covariance = ProcessNoise().flight(dt)
    resting = Values(states * np.array([1, 1, 0, 1, 1, 0, 1, 1, 1]) + np.eye(9)[2] * 0.02, np.zeros(0))
    for kind, point in (
        (FlightFactors(model, rows, dt, covariance), values),
        (ContactFactors(model, rows, dt, covariance, np.zeros((2, 1))), values),
        (RestFactors(model, rows, dt, covariance, np.zeros(2)), resting),
        (PositionFactors(rows, states[:2, :3] + 0.01, np.full((2, 3), 0.002)), values),
        (state_prior(2, np.zeros(9), np.ones(9)), values),
        (spin_prior(rows, np.zeros((2, 3)), np.full((2, 3), 20.0)), values),
    ):
        assert check_factor(kind, point) < 1e-6


def test_the_example_in_the_docs_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # it writes a dataset
    text = (DOCS / "custom_factors.md").read_text(encoding="utf-8")
    names = {"__name__": "example"}
    with OBSERVATIONS.restored():
        for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            exec(compile(block, "docs/custom_factors.md", "exec"), names)
