"""Labels and their probability to be wrong: as often wrong as stated, and silence where all err alike."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from ballfg.diagnosis.generic_test import ALARM, LabelCheck, LabelVerdict, percent
from ballfg.diagnosis.residual_tests.label_check import (
    NONE_WRONG,
    RIGHT,
    RIGHT_SPREAD,
    SHARES,
    WRONG,
    LabelledFlight,
    LabelPosterior,
    _mixture,
    judged,
    label_test,
    wrong_error,
)

STATED, FAR = 4.0, 120.0
"""rad/s, errors of labels that are right and wrong."""
LABELS = 20


def log_normal(away, covariance):
    """Log density of a normal vector, up to the constant."""
    _, size = np.linalg.slogdet(covariance)
    return -0.5 * (away @ np.linalg.solve(covariance, away) + size)


def posterior(label, spin, covariance, error):
    """That of a spin which the flight shows with a covariance, after a label with an error: in closed form."""
    known = np.linalg.inv(covariance)
    total = np.linalg.inv(known + np.eye(3) / error**2)
    mean = total @ (known @ spin + label / error**2)
    return LabelPosterior(label, error, log_normal(label - spin, covariance + error**2 * np.eye(3)), mean, total)


def flight(name, rng, off):
    """A label that is off by (3,) rad/s, and a flight that shows the spin to some 15 rad/s, one axis worse."""
    root = np.diag([10.0, 15.0, rng.uniform(20.0, 60.0)]) @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
    covariance, spin = root.T @ root, 100.0 * rng.standard_normal(3)
    shown = spin + root.T @ rng.standard_normal(3)
    label = spin + off
    return LabelledFlight(name, *(posterior(label, shown, covariance, error) for error in (STATED, FAR)))


def recording(rng, share, error=STATED, count=LABELS):
    """Flights with their labels, a share of them wrong by `FAR` per axis; and whether each is wrong."""
    bad = rng.random(count) < share
    sizes = np.where(bad, FAR, error)
    return [flight(f"{i:02d}", rng, size * rng.standard_normal(3)) for i, size in enumerate(sizes)], bad


def test_densities_for_other_errors_are_those_of_the_flight() -> None:
    rng = np.random.default_rng(1)
    covariance, spin, label = np.diag([100.0, 400.0, 1e5]), 50.0 * rng.standard_normal(3), 80.0 * rng.standard_normal(3)
    asked = np.array([2.0, 4.0, 30.0, 300.0])
    exact = [log_normal(label - spin, covariance + error**2 * np.eye(3)) for error in asked]
    for error in (STATED, FAR):
        found = posterior(label, spin, covariance, error).log_densities(asked)
        np.testing.assert_allclose(found, exact, rtol=1e-9)


def test_mixture_is_that_of_all_its_terms() -> None:
    rng = np.random.default_rng(2)
    right = rng.normal(-3.0, 2.0, (3, len(RIGHT)))
    wrong = rng.normal(-4.0, 2.0, (3, len(RIGHT) * len(WRONG)))
    stated = np.exp(-0.5 * (np.log(RIGHT) / RIGHT_SPREAD) ** 2)
    stated /= stated.sum()
    none = NONE_WRONG * sum(p * np.exp(right[:, r].sum()) for r, p in enumerate(stated))
    total, each = none, np.zeros(3)
    for r, w, share in itertools.product(range(len(RIGHT)), range(len(WRONG)), SHARES):
        prior = (1.0 - NONE_WRONG) * stated[r] / (len(WRONG) * len(SHARES))
        densities = np.exp(np.stack((right[:, r], wrong[:, r * len(WRONG) + w])))
        for chosen in itertools.product((0, 1), repeat=3):  # every way in which labels are right or wrong
            case = prior * np.prod([densities[c, i] * (share if c else 1.0 - share) for i, c in enumerate(chosen)])
            total += case
            each += case * np.array(chosen)
    probability, p_all_right = _mixture(right, wrong)
    np.testing.assert_allclose(probability, each / total, rtol=1e-9)
    assert p_all_right == pytest.approx(none / total, rel=1e-9)


def test_labels_are_as_often_wrong_as_stated() -> None:
    rng, said, true = np.random.default_rng(3), [], []
    for share in np.tile(np.linspace(0.05, 0.6, 12), 12):
        flights, bad = recording(rng, share)
        found = {v.track: v.probability for v in judged(flights).verdicts}
        said += [found[f.name] for f in flights]
        true += bad.tolist()
    said, true = np.array(said), np.array(true)
    for low, high in ((0.0, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 1.0)):
        inside = (said >= low) & (said <= high)
        error = np.sqrt(max(0.25 / inside.sum() ** 2, (said * (1.0 - said))[inside].sum() / inside.sum() ** 2))
        assert abs(true[inside].mean() - said[inside].mean()) < 3.0 * error
    assert (said[true] > 0.95).mean() > 0.85


@pytest.mark.parametrize("error", [STATED, 2.0 * STATED, 3.0 * STATED])
def test_labels_that_are_right_or_all_err_more_than_stated_are_not_accused(error) -> None:
    rng = np.random.default_rng(4)
    assert not any(judged(recording(rng, 0.0, error)[0]).contradicted for _ in range(60))


def test_a_single_label_of_another_shot_is_named() -> None:
    rng = np.random.default_rng(5)
    flights, _ = recording(rng, 0.0)
    found = judged([*flights, flight("odd", rng, np.array([0.0, 200.0, -200.0]))])
    (wrong,) = found.contradicted
    assert (wrong.track, wrong.probability > 0.999) == ("odd", True)
    assert wrong.off == pytest.approx(283.0, abs=3.0 * wrong.sigma)
    assert found.p_all_right < ALARM
    assert found.where.startswith("label: 1 of 21 spin labels contradict their flights, typically by 2")


def test_labels_that_contradict_throughout_are_found() -> None:
    flights, bad = recording(np.random.default_rng(6), 0.8, count=40)
    found = judged(flights)
    wrong = {f.name for f, is_bad in zip(flights, bad, strict=True) if is_bad}
    named = {v.track for v in found.contradicted}
    assert len(named & wrong) > 0.8 * len(wrong)
    assert len(named - wrong) <= 1


def test_no_label_is_judged_where_there_is_none() -> None:
    assert judged([]) is None


def test_doubt_in_all_keeps_single_labels_unaccused() -> None:
    verdicts = (LabelVerdict("a", 0.96, 90.0, 20.0), LabelVerdict("b", 0.1, 30.0, 20.0))
    assert LabelCheck(0.01, verdicts).contradicted == ()
    assert LabelCheck(0.001, verdicts).contradicted == verdicts[:1]
    assert "none of 2 spin labels" in LabelCheck(0.01, verdicts).where


def test_share_is_of_the_labels_contradicted_before() -> None:
    before = LabelCheck(1e-9, tuple(LabelVerdict(n, 0.99, 90.0, 20.0) for n in "abcd"))
    now = LabelCheck(1e-4, (LabelVerdict("a", 0.99, 90.0, 20.0), LabelVerdict("b", 0.1, 10.0, 20.0)))
    assert label_test(now, before).share == 0.25
    assert label_test(now).share == 1.0
    assert label_test(now).p_value == 1e-4
    assert label_test(LabelCheck(0.9, now.verdicts), before).share == 0.0


def test_percents_round_towards_doubt() -> None:
    assert [percent(p) for p in (0.951, 0.9899, 0.9951, 0.99999, 1.0)] == ["95 %", "98 %", "99.5 %", "99.9 %", "99.9 %"]


def test_a_wrong_label_is_that_of_another_shot() -> None:
    labels = 90.0 * np.random.default_rng(7).standard_normal((4000, 3))
    assert wrong_error(labels, 60.0) == pytest.approx(np.sqrt(2.0) * 90.0, rel=0.05)
    assert wrong_error(np.zeros((5, 3)), 60.0) == 60.0
