"""Coefficients that change along a recording: found, said in numbers, and silent where nothing changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.diagnosis.fit.patterns import DRIFT, drift_block
from ballfg.diagnosis.fit.stretches import joined
from ballfg.diagnosis.generic_test import ALARM
from ballfg.diagnosis.residual_tests.generic import generic_tests

COUNT = 20


@pytest.fixture(scope="module")
def two_sessions(make_ball, make_launches, make_shots, make_fit):
    """Ten shots on a table of restitution 0.95, then ten on one of 0.87."""
    parts = [
        make_shots(make_ball(restitution={"e": e}), make_launches(COUNT // 2, seed), seed).stretches
        for e, seed in ((0.95, 31), (0.87, 32))
    ]
    return make_fit(make_ball(), replace(joined(parts), track=np.arange(COUNT)))


def recording_test(fit):
    (found,) = [t for t in generic_tests(fit) if t.name == DRIFT]
    return found


def test_another_table_is_found_and_said(two_sessions):
    found = recording_test(two_sessions)
    assert found.p_value < ALARM
    assert "bounce.restitution.e changes from 0.9" in found.where
    assert " to 0.8" in found.where


def test_one_session_is_silent(calm_fit):
    assert recording_test(calm_fit).p_value > ALARM


def test_columns_are_those_of_the_coefficients_from_minus_to_plus_one_sigma(calm_fit):
    system = calm_fit.linearised
    block = drift_block(calm_fit, system)
    free = calm_fit.problem.free
    assert block.quantities == tuple(free)
    sigmas = np.array([c.sigma for c in free.values()])
    own = system.by_common[..., : len(free)] * sigmas
    np.testing.assert_allclose(block.columns[0], -own[0], rtol=1e-12)
    np.testing.assert_allclose(block.columns[-1], own[-1], rtol=1e-12)


def test_one_track_tells_nothing_of_changes(calm_fit):
    stretches = calm_fit.problem.stretches
    alone = replace(
        calm_fit, problem=replace(calm_fit.problem, stretches=replace(stretches, track=np.zeros_like(stretches.track)))
    )
    system = calm_fit.linearised
    assert drift_block(alone, system) is None
