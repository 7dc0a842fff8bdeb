"""Spin labels in another frame, found from the flights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.search.candidates import Scored
from ballfg.diagnosis.search.refits import FRAMES_FITTED, frame_hypotheses, refit
from ballfg.dynamics.effects.measurement import SpinLabelFrame, signed_permutations

GENERAL = Hypothesis(SpinLabelFrame, {}, tuple(c.name for c in SpinLabelFrame.coefficients))
MIRROR = np.diag([1.0, -1.0, 1.0])
EXCHANGE = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

FIRST = np.diag([1.0, 1.0, -1.0])
"""The one after the identity in the list of all."""


def matrix(hypothesis):
    return np.array([hypothesis.shape[c.name] for c in SpinLabelFrame.coefficients]).reshape(3, 3)


@pytest.fixture(scope="module")
def data(make_ball, make_launches, make_shots):
    """Twelve shots to all sides, with spins of 100 rad/s per axis."""
    starts = make_launches(12, 41, spread=3.0, spin=100.0)
    return make_shots(make_ball(), starts, 41, duration=0.5, rate=50.0).stretches


@pytest.fixture(scope="module", params=[MIRROR, EXCHANGE, FIRST], ids=["mirrored", "exchanged", "first"])
def wrong(request, data, make_fit, make_ball):
    """A frame and the fit to labels in it."""
    labels = data.labels @ torch.from_numpy(request.param).T
    return request.param, make_fit(make_ball(), replace(data, labels=labels))


def test_the_frame_is_found(wrong):
    frame, before = wrong
    found = frame_hypotheses(before, GENERAL)
    assert len(found) == FRAMES_FITTED
    assert all(h.strengths == () for h in found)
    np.testing.assert_array_equal(matrix(found[0]), frame)


def test_the_refit_reads_the_labels_in_it(wrong):
    frame, before = wrong
    found = frame_hypotheses(before, GENERAL)
    refits = [refit(before, Scored(h, None, 1e-6)) for h in found]
    assert refits[0].delta_bic < refits[1].delta_bic
    assert refits[0].delta_bic < -100.0
    after = refits[0].fit
    spins = after.problem.stretches.labels.numpy() @ np.linalg.inv(frame).T
    assert np.abs(after.unknowns.starts[:, 6:] - spins).max() < 5 * 4.0


def test_all_frames_but_the_one_at_hand():
    frames = signed_permutations().numpy()
    np.testing.assert_array_equal(frames[0], np.eye(3))
    assert len({f.tobytes() for f in frames}) == 48
    assert np.allclose(frames @ frames.swapaxes(1, 2), np.eye(3))
