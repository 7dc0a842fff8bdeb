"""Labels that contradict flights: chi-square without any, silence where all err alike, names where some do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from ballfg.diagnosis.remains.generic import generic_tests
from ballfg.diagnosis.remains.label_check import LEAST_LABELS, _distances, check_labels

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # torch's own
TRACKS, LABEL_NOISE = 24, 4.0


@pytest.fixture(scope="module")
def shots(make_ball, make_launches, make_shots):
    return make_shots(make_ball(), make_launches(TRACKS, 5), 5).stretches


def checked(fit):
    return check_labels(fit, fit.linearised())


def test_distances_are_chi_square(make_ball, make_fit, shots) -> None:
    fit = make_fit(make_ball(), shots, settle_noise=False)
    system = fit.linearised()
    distance, _ = _distances(fit, system, np.arange(TRACKS))
    assert stats.kstest(distance, stats.chi2(3).cdf).pvalue > 0.01
    found = checked(fit)
    assert found.p_value > 0.01
    assert found.contradicted == ()


def test_labels_that_all_err_more_than_stated_raise_no_alarm(make_ball, make_fit, make_launches, make_shots) -> None:
    loose = make_shots(make_ball(), make_launches(TRACKS, 6), 6, label=2.0 * LABEL_NOISE).stretches
    assert checked(make_fit(make_ball(), loose, settle_noise=False)).p_value > 0.005


def test_labels_of_other_shots_are_named(make_ball, make_fit, shots) -> None:
    labels = shots.labels.clone()
    labels[[3, 11]] += torch.tensor([0.0, 120.0, -90.0], dtype=torch.float64)
    fit = make_fit(make_ball(), replace(shots, labels=labels), settle_noise=False)
    found = checked(fit)
    assert set(found.contradicted) == {"003", "011"}
    assert found.typical == pytest.approx(150.0, rel=0.1)
    (test,) = [t for t in generic_tests(fit) if t.name == "label"]
    assert test.p_value < 1e-4
    assert test.share == 1.0
    assert test.where.startswith("label: 2 of 24 spin labels contradict their flights, typically by 1")


def test_labels_that_contradict_throughout_are_counted(make_ball, make_fit, shots) -> None:
    labels = shots.labels.clone()
    labels[4:] *= -1.0
    found = checked(make_fit(make_ball(), replace(shots, labels=labels), settle_noise=False))
    assert found.p_value < 1e-10
    assert len(found.contradicted) >= TRACKS - 6  # some spin so little that the sign hardly matters
    assert not {"000", "001", "002", "003"} & set(found.contradicted)


def test_few_labels_are_not_judged(make_ball, make_fit, shots) -> None:
    assert checked(make_fit(make_ball(), shots.take(range(LEAST_LABELS - 1)), settle_noise=False)) is None
