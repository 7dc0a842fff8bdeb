"""Spins that flights show, with the scatter of flight and bounces; and labels of simulated sets, right and wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.diagnosis import hold_out
from ballfg.diagnosis.fit.effects import with_effects
from ballfg.diagnosis.residual_tests.label_check import labelled_flights, scattering_model
from ballfg.dynamics import nominal_model
from ballfg.dynamics.effects.measurement import SpinLabelScale
from ballfg.estimation import Settings, Smoother
from ballfg.factors.loss import Loss
from ballfg.state import SPIN
from tests.diagnosis.right_labels import LABEL_NOISE, NOISE, Tally, judged, scattering_set

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # torch's own
MODEL = nominal_model("table_tennis").requires_grad_(False)
SETTINGS = Settings.for_measured(MODEL, position_noise=(NOISE,) * 3, spin_label_noise=LABEL_NOISE)


@pytest.fixture(scope="module")
def scattered():
    """Tracks of the world of `Settings.for_measured` with right labels, in two halves."""
    dataset, _ = scattering_set(11, 1.0, tracks=16)
    return hold_out(dataset, MODEL)


def parts(holdout):
    return (*holdout.search_tracks, *holdout.held_out_tracks)


def test_densities_are_those_of_the_smoothers_spin(scattered) -> None:
    free = replace(SETTINGS, spin_prior=2000.0, spin_loss=Loss("squared"))
    smoother, apart = Smoother(MODEL, scattered.surfaces, free), []
    found_by_name = {f.name: f for f in labelled_flights(MODEL, scattered.surfaces, SETTINGS, parts(scattered))}
    for part in parts(scattered):
        found = found_by_name[part.track.name]
        estimate = smoother.estimate(replace(part.track, labels={}))
        away = part.track.spin_label - estimate.states[0, SPIN]

        def log_density(error, away=away, known=estimate.covariances[0][SPIN, SPIN]):
            total = known + error**2 * np.eye(3)
            return -0.5 * (away @ np.linalg.solve(total, away) + np.linalg.slogdet(total)[1])

        exact = log_density(found.right.error) - log_density(found.wrong.error)
        apart.append(found.right.log_density - found.wrong.log_density - exact)
    assert len(apart) == len(parts(scattered))
    assert np.median(np.abs(apart)) < 0.3  # the flight's likelihood is nearly Gaussian
    assert np.quantile(np.abs(apart), 0.8) < 1.5  # but for balls that nearly slide in a bounce


def test_distances_are_chi_square_with_the_scatter(scattered) -> None:
    squares = []
    for found in labelled_flights(MODEL, scattered.surfaces, SETTINGS, parts(scattered)):
        away = found.wrong.label - found.wrong.mean
        squares.append(away @ np.linalg.solve(found.wrong.covariance, away))
    assert 1.0 < np.median(squares) < 4.5  # of three degrees of freedom: 2.4


def test_scatter_is_not_taken_for_coefficients(scattered) -> None:
    bent = with_effects(MODEL)
    bent.bounce["tangential_restitution"].e_t.fill_(1.0)
    bent.flight["magnus"].k.fill_(0.0038)
    found, settings = scattering_model(bent, MODEL, parts(scattered), scattered)
    values = {name: float(value) for name, value in found.named_parameters()}
    assert values["flight.magnus.k"] == pytest.approx(0.0028, rel=0.07)
    assert values["bounce.tangential_restitution.e_t"] == pytest.approx(0.15, abs=0.2)
    assert 0.1 < settings.process.contact_tangential < 0.4
    assert settings.spin_label_noise == LABEL_NOISE


@pytest.mark.thorough
def test_right_labels_are_not_accused(scattered) -> None:
    labels, _ = judged(scattered.dataset, whole=False)
    assert len(labels.verdicts) == len(parts(scattered))
    assert labels.contradicted == ()
    assert labels.p_all_right > 0.5


def test_wrong_labels_are_found() -> None:
    dataset, bad = scattering_set(12, 0.5, 0.2, tracks=15)
    labels, _ = judged(dataset, whole=False)
    named = {verdict.track for verdict in labels.contradicted}
    assert named <= bad
    assert len(named) >= len(bad) - 1
    assert np.median([verdict.off for verdict in labels.contradicted]) == pytest.approx(100.0, abs=20.0)


def test_labels_are_compared_as_the_model_writes_them(scattered) -> None:
    scaled = with_effects(MODEL, SpinLabelScale(s=0.25))
    some = [replace(part, track=replace(part.track, labels=_times(part.track, 1.25))) for part in parts(scattered)[:4]]
    plain = labelled_flights(MODEL, scattered.surfaces, SETTINGS, parts(scattered)[:4])
    for one, other in zip(labelled_flights(scaled, scattered.surfaces, SETTINGS, some), plain, strict=True):
        np.testing.assert_allclose(one.right.label, other.right.label, atol=1e-9)
        assert one.right.error == pytest.approx(LABEL_NOISE / 1.25)


def _times(track, factor):
    return {
        **track.labels,
        **{f"spin_{axis}": factor * value for axis, value in zip("xyz", track.spin_label, strict=True)},
    }


def test_the_tally_counts_sets_and_labels() -> None:
    tally = Tally()
    tally.add(set(), set(), ("wind",), 25)
    tally.add({"a"}, set(), ("spin_label_scale",), 25)
    tally.add({"a", "x"}, {"a", "b"}, (), 25)
    assert str(tally).startswith("1 of 2 sets with right labels accuse one (1 name an effect")
    assert "1 of 2 wrong labels found (50 %), 1 of 23 right ones" in str(tally)
