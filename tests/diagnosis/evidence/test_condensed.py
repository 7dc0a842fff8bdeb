"""Evidence of further columns after an elimination, against that of all columns at once."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.diagnosis.evidence.condensed import Condensed
from ballfg.diagnosis.evidence.likelihood import LOST, Reduced, held_out, posterior

OWN, FURTHER = 4, 5
HALVES = np.array([True, False, False, True, True, False])


@pytest.fixture
def tracks():
    rng = np.random.default_rng(5)
    rows = rng.standard_normal((len(HALVES), 30, OWN + FURTHER + 1))
    return Reduced(rng.standard_normal(len(HALVES)), rows.swapaxes(1, 2) @ rows)


@pytest.fixture
def priors():
    rng = np.random.default_rng(6)
    return np.exp(rng.standard_normal(OWN)), rng.standard_normal(OWN)


@pytest.mark.parametrize("columns", [[], [2], [4, 0, 1]])
def test_it_is_the_evidence_of_all_columns_at_once(tracks, priors, columns):
    precision, away = priors
    columns = np.array(columns, dtype=np.intp)
    own = np.linspace(0.5, 2.0, len(columns))
    listed = np.array([*range(OWN), *(OWN + columns), OWN + FURTHER])
    part = Reduced(tracks.constant, tracks.gram[:, listed[:, None], listed])
    whole, far = np.append(precision, own), np.append(away, np.zeros(len(columns)))
    expected = posterior(part.of(np.full(len(HALVES), True)), whole, far)
    found = Condensed.of(tracks, precision, away, HALVES)
    one = found.whole(columns, own)
    assert one.evidence == pytest.approx(expected.evidence, rel=1e-12)
    assert one.mean == pytest.approx(expected.mean[OWN:], rel=1e-9)
    assert one.covariance == pytest.approx(expected.covariance[OWN:, OWN:], rel=1e-9)
    assert found.held_out(columns, own) == pytest.approx(held_out(part, whole, far, HALVES), rel=1e-9)


def test_rounding_that_leaves_nothing_has_no_evidence(tracks, priors):
    gram = tracks.gram.copy()
    gram[:, OWN, OWN] = -1e6
    found = Condensed.of(Reduced(tracks.constant, gram), *priors, HALVES)
    assert found.whole(np.array([0]), np.ones(1)).evidence == -np.inf
    assert (found.held_out(np.array([0]), np.ones(1)) == LOST).all()
    assert np.isfinite(found.whole(np.array([1]), np.ones(1)).evidence)
