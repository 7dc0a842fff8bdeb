"""Sparse regression over generic terms: the selection against an exhaustive search, planted forces found again."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from ballfg.diagnosis.fit.fit import values_of
from ballfg.diagnosis.residual_tests.sparse import MOST_TERMS, describe, fit_with_terms, select, sparse_terms
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effects.generic import GenericFlight
from ballfg.dynamics.model_file import model_from_dict, model_to_dict

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # torch's own
FORCE = {"y_one": 0.5, "x_x": -0.6}
PENALTY = 12.0


@pytest.fixture(scope="module")
def pushed(make_known_ball, make_known_fit, make_launches, make_shots):
    return make_known_fit(make_shots(make_known_ball(GenericFlight(**FORCE)), make_launches(12, 5), 5).stretches)


@pytest.fixture(scope="module")
def calm(make_known_ball, make_known_fit, make_launches, make_shots):
    return make_known_fit(make_shots(make_known_ball(), make_launches(12, 6), 6).stretches)


def regression(strengths, seed, *, alike=0.0):
    """Information and score of a linear model with unit noise; its columns have a part in common."""
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((200, len(strengths))) + alike * rng.standard_normal((200, 1))
    seen = columns @ strengths + rng.standard_normal(200)
    return columns.T @ columns, columns.T @ seen


@pytest.mark.parametrize("alike", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(5))
def test_selection_is_that_of_an_exhaustive_search(alike, seed):
    strengths = np.array((0.0, 1.0, 0.0, 0.0, -0.8, 0.0, 0.6))
    information, score = regression(strengths, seed, alike=alike)

    def worth(chosen):
        of = list(chosen)
        return score[of] @ np.linalg.solve(information[np.ix_(of, of)], score[of]) - PENALTY * len(of) if of else 0.0

    every = (c for size in range(8) for c in itertools.combinations(range(7), size))
    assert sorted(select(information, score, PENALTY)) == list(max(every, key=worth))


def test_nothing_is_selected_from_noise():
    assert select(*regression(np.zeros(40), 0), PENALTY) == []


def test_a_term_that_later_ones_replace_is_dropped():
    # the sum of two is chosen first, then each; the sum is then superfluous
    rng = np.random.default_rng(1)
    one, two, noise = rng.standard_normal((3, 400))
    columns = np.stack((one + two + 0.3 * rng.standard_normal(400), one, two), axis=-1)
    seen = one + two + 0.2 * noise
    information, score = columns.T @ columns / 0.04, columns.T @ seen / 0.04
    assert sorted(select(information, score, PENALTY)) == [1, 2]


def test_a_copy_of_a_term_is_not_selected_beside_it():
    information, score = regression(np.array((1.0, 0.5)), 2)
    copy = [0, 1, 0]
    assert sorted(select(information[np.ix_(copy, copy)], score[copy], PENALTY)) in ([0, 1], [1, 2])


def test_selection_ends():
    information, score = np.eye(30), np.full(30, 10.0)
    assert len(select(information, score, PENALTY)) == MOST_TERMS


@pytest.fixture(scope="module")
def described(pushed):
    terms = sparse_terms(pushed)
    assert terms is not None
    return terms, fit_with_terms(pushed, terms)


def test_planted_force_is_found_again(pushed, described):
    terms, after = described
    shape = terms.hypotheses[0].shape
    shift = FORCE["x_x"] * (shape["center_x"] - 1.4)
    # x_x is about another centre than the planted one: what that shifts is a force of its own
    wanted = {f"flight.generic_flight.{name}": value for name, value in (FORCE | {"x_one": shift}).items()}
    found = values_of(after, terms.estimates, {})
    assert set(found) in (set(wanted), set(wanted) - {"flight.generic_flight.x_one"})
    for name, value in found.items():
        assert abs(value.value - wanted[name]) < 4.0 * value.sigma
        assert value.sigma < 0.1
    assert pushed.cost - after.cost > 0.4 * terms.explained
    words = describe(terms, after)
    assert "generic_flight.y_one = " in words
    assert "1/s^2" in words


def test_model_with_terms_is_a_model_file(described):
    model = described[1].problem.model
    assert isinstance(model, AnalyticModel)
    assert model_to_dict(model_from_dict(model_to_dict(model))) == model_to_dict(model)


def test_no_term_is_found_where_nothing_is(calm):
    assert sparse_terms(calm) is None
