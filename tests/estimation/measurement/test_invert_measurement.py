"""What measurement effects did is undone: states as good as those from tracks without the effects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import ballfg as bf
from ballfg.dynamics import EFFECTS, AnalyticModel, Architecture, Coefficient, build, save_model
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.estimation import Estimate, Settings, Smoother, Status
from ballfg.estimation.measurement import invert_measurement as through_measurement
from ballfg.estimation.measurement.invert_measurement import InvertMeasurement
from ballfg.estimation.registry import ESTIMATORS, make_estimator
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise, SimulationConfig, parse_effects, simulate, write_simulation
from ballfg.simulation.synthetic import SimulatedTrack
from ballfg.state import POSITION, SPIN, VELOCITY
from ballfg.tracks.track import SPIN_LABELS

CONFIG = SimulationConfig(tracks=3, rate=60.0, seed=3, noise=MeasurementNoise(position=0.002, spin=4.0))
BALL, SURFACES = CONFIG.ball.model, CONFIG.ball.surfaces
SETTINGS = Settings(
    position_noise=(0.002,) * 3, process=ProcessNoise(acceleration=0.02, spin=0.5), spin_label_noise=4.0
)
SIGMAS = ((POSITION, 0.002), (VELOCITY, 0.03), (SPIN, 4.0))
"""About how well states are known: m, m/s, rad/s."""


class Bulge(MeasurementEffect):
    """An effect that no catalogue holds: lengths along x are stretched the more, the farther out."""

    name = "bulge"
    sentence = "A lens that was not calibrated."
    decide = "Film a grid."
    coefficients = (Coefficient("strength", 0.0, 0.01, "1/m", -1.0, 1.0),)
    strength: Tensor

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m: x + strength x^2."""
        x = states[..., :1]
        return torch.cat((x + self.strength * x.square(), states[..., 1:3]), dim=-1)


def declared(*effects: Effect) -> AnalyticModel:
    own = [*BALL.flight.values(), *BALL.bounce.values(), *effects]
    return AnalyticModel(own, radius=BALL.radius, inertia_factor=BALL.inertia_factor)


def simulated(effects: tuple[Effect, ...]) -> list[SimulatedTrack]:
    return list(simulate(replace(CONFIG, undeclared=effects)))


@pytest.fixture(scope="module")
def plain() -> list[SimulatedTrack]:
    return simulated(())


@pytest.fixture(scope="module")
def reference(plain) -> list[Estimate]:
    smoother = Smoother(BALL, SURFACES, SETTINGS)
    return [smoother.estimate(s.track) for s in plain]


def rmse(estimates, tracks, block: slice) -> float:
    errors = [(e.states - s.true_states)[:, block] for e, s in zip(estimates, tracks, strict=True)]
    return float(np.sqrt(np.square(np.concatenate(errors)).sum(-1).mean()))


def same_states(estimates, reference, share: float) -> None:
    """The root mean square difference is a small share of what is known of a state."""
    for block, sigma in SIGMAS:
        away = np.concatenate([(e.states - r.states)[:, block] for e, r in zip(estimates, reference, strict=True)])
        assert np.sqrt((away**2).mean()) < share * sigma


CASES = {
    "tilt and scale": ["frame_tilt.x=0.01", "frame_tilt.y=-0.02", "scale.x=0.02"],
    "lag": ["velocity_lag.lag=0.005"],
    "offset": ["time_offset.x=0.004", "time_offset.z=-0.003"],
    "clock and labels": ["time_scale.s=0.01", "spin_label_offset.x=30", "spin_label_scale.s=-0.02"],
    "several": ["velocity_lag.lag=0.003", "radial_bias.offset=0.03", "frame_tilt.x=0.01", "time_scale.s=-0.02"],
}


@pytest.mark.parametrize("texts", CASES.values(), ids=CASES.keys())
def test_states_are_those_of_tracks_without_the_effects(texts, plain, reference) -> None:
    effects = parse_effects(texts)
    tracks = simulated(effects)
    estimator = make_estimator("smoother", declared(*effects), SURFACES, SETTINGS)
    estimates = [estimator.estimate(s.track) for s in tracks]
    assert {e.status for e in estimates} == {Status.OK}
    same_states(estimates, reference, 0.05)
    for block, _ in SIGMAS:
        assert rmse(estimates, tracks, block) == pytest.approx(rmse(reference, plain, block), rel=0.03)
    for estimate, expected, s in zip(estimates, reference, tracks, strict=True):
        assert estimate.times is s.track.times
        assert [c.interval for c in estimate.contacts] == [c.interval for c in expected.contacts]


@pytest.mark.parametrize("method", ["online", "ekf", "sliding-window"])
def test_every_estimator_gets_the_track_as_it_happened(method, plain) -> None:
    effects = parse_effects(["velocity_lag.lag=0.005", "frame_tilt.y=0.02", "time_scale.s=0.01"])
    tracks = simulated(effects)[:1]
    through, direct = (make_estimator(method, m, SURFACES, SETTINGS) for m in (declared(*effects), BALL))
    estimates, expected = (
        [e.estimate(s.track) for s in given] for e, given in ((through, tracks), (direct, plain[:1]))
    )
    same_states(estimates, expected, 0.1)
    for estimate, s in zip(estimates, tracks, strict=True):
        assert estimate.times is s.track.times


def test_contacts_are_on_the_written_clock(plain, reference) -> None:
    scale, start = EFFECTS["time_scale"](s=0.02), 1000.0
    track = plain[0].track
    written = replace(track, times=start + 1.02 * track.times)
    estimate = make_estimator("smoother", declared(scale), SURFACES, SETTINGS).estimate(written)
    assert len(estimate.contacts) > 0
    for found, expected in zip(estimate.contacts, reference[0].contacts, strict=True):
        assert found.time == pytest.approx(start + 1.02 * expected.time, abs=1e-6)


def test_an_effect_that_no_catalogue_holds(plain, reference) -> None:
    model = declared(Bulge(strength=0.02))
    x = [s.track.positions[:, 0] - s.true_states[:, 0] for s in plain]  # noise
    bent = [s.true_states[:, 0] + 0.02 * s.true_states[:, 0] ** 2 + noise for s, noise in zip(plain, x, strict=True)]
    tracks = [
        replace(s.track, positions=np.column_stack((b, s.track.positions[:, 1:])))
        for s, b in zip(plain, bent, strict=True)
    ]
    estimator = make_estimator("smoother", model, SURFACES, SETTINGS)
    same_states([estimator.estimate(t) for t in tracks[:1]], reference[:1], 0.1)


def test_coefficients_of_the_track_are_estimated_as_usual(plain) -> None:
    settings = replace(SETTINGS, coefficients={"flight.drag.k": 0.02, "bounce.table_height.offset": 0.003})
    effects = parse_effects(["velocity_lag.lag=0.005"])
    (expected,) = [Smoother(BALL, SURFACES, settings).estimate(s.track) for s in plain[:1]]
    found = make_estimator("smoother", declared(*effects), SURFACES, settings).estimate(simulated(effects)[0].track)
    assert found.coefficient_names == expected.coefficient_names
    away = (found.coefficients - expected.coefficients) / np.sqrt(np.diag(expected.coefficient_covariance))
    assert (np.abs(away) < 0.05).all()


@pytest.mark.thorough
def test_a_residual_model_measures_as_its_base(plain, reference) -> None:
    """Untrained, it is its base; one short track."""
    effects = parse_effects(["frame_tilt.x=0.02"])
    model = build(Architecture.of("mlp+gs", residual=True), radius=BALL.radius, base=declared(*effects), seed=0)
    track, expected = (s.track.until(0.25) for s in (simulated(effects)[0], plain[0]))
    found = make_estimator("smoother", model, SURFACES, SETTINGS).estimate(track)
    same_states([found], [Smoother(BALL, SURFACES, SETTINGS).estimate(expected)], 0.05)


def test_the_side_of_a_bounce_is_the_motion_s_to_tell() -> None:
    """Tracks that end one sample after a bounce: a sample below the table must not pass for one before it."""
    effects = parse_effects(["velocity_lag.lag=0.005"])
    estimator = make_estimator("smoother", declared(*effects), SURFACES, SETTINGS)
    for s in simulated(effects):
        after = int(np.flatnonzero(np.diff(s.true_states[:, 5]) > 0.5)[0]) + 1
        shifted = estimator.undo(s.track.until(float(s.track.times[after]))).track
        away = shifted.positions[-1] - s.true_states[after, POSITION]
        assert np.abs(away).max() < 5 * 0.002  # taken for one before the bounce it is 30 mm off


def test_shifts_that_do_not_settle_are_not_silent(plain, monkeypatch) -> None:
    monkeypatch.setattr(through_measurement, "ROUNDS", 2)
    estimator = make_estimator("smoother", declared(EFFECTS["velocity_lag"](lag=0.02)), SURFACES, SETTINGS)
    assert estimator.estimate(plain[0].track).status is Status.NOT_CONVERGED


@pytest.mark.parametrize("count", [1, 2, 3])
def test_short_tracks(count, plain) -> None:
    track = plain[0].track.until(float(plain[0].track.times[count - 1]))
    for method in ESTIMATORS:
        estimator = make_estimator(method, declared(EFFECTS["velocity_lag"](lag=0.005)), SURFACES, SETTINGS)
        estimate = estimator.estimate(track)
        assert estimate.states.shape == (count, 9)
        assert np.isfinite(estimate.states).all()
        assert (estimate.status is Status.NO_VELOCITY) == (count == 1)


def test_label_noise_is_that_of_the_spin() -> None:
    estimator = make_estimator("ekf", declared(EFFECTS["spin_label_scale"](s=1.0)), SURFACES, SETTINGS)
    assert isinstance(estimator, InvertMeasurement)
    assert estimator.inner.settings.spin_label_noise == pytest.approx(2.0, rel=1e-12)
    assert estimator.settings is SETTINGS


# --- what stays as it was, and what is refused ---------------------------------------------------------------------


@pytest.mark.parametrize("method", ESTIMATORS)
def test_plain_models_get_the_estimator_itself(method) -> None:
    assert type(make_estimator(method, BALL, SURFACES, SETTINGS)) is ESTIMATORS[method]


@pytest.mark.parametrize("method", ESTIMATORS)
def test_an_estimator_by_itself_refuses_measurement_effects(method) -> None:
    with pytest.raises(ValueError, match=f"no measurement effects for the estimator '{method}' by itself"):
        ESTIMATORS[method](declared(EFFECTS["scale"]()), SURFACES, SETTINGS)


def test_a_label_that_stands_for_a_spin_of_no_ball_is_not_used(plain) -> None:
    estimator = make_estimator("smoother", declared(EFFECTS["spin_label_scale"](s=-0.9)), SURFACES, SETTINGS)
    track = plain[0].track
    wild = replace(track, labels={**track.labels, "spin_x": 300.0, "spin_y": 0.0, "spin_z": 0.0})  # read as 3,000 rad/s
    bare = replace(track, labels={n: v for n, v in track.labels.items() if n not in SPIN_LABELS})
    found, expected = estimator.estimate(wild), estimator.estimate(bare)
    np.testing.assert_array_equal(found.states, expected.states)
    assert [note for note in found.notes if "no ball spins" in note]
    assert not [note for note in expected.notes if "no ball spins" in note]


def test_labels_that_hold_almost_nothing_of_the_spin_say_nothing(plain) -> None:
    track = plain[0].track
    zero = replace(track, labels={**track.labels, "spin_x": 0.0, "spin_y": 0.0, "spin_z": 0.0})
    bare = replace(track, labels={n: v for n, v in track.labels.items() if n not in SPIN_LABELS})
    nothing = declared(EFFECTS["spin_label_scale"](s=-0.9999999))
    found = make_estimator("smoother", nothing, SURFACES, SETTINGS).estimate(zero)
    wide = make_estimator("smoother", declared(), SURFACES, replace(SETTINGS, spin_prior=1e5)).estimate(bare)
    sigma = np.sqrt(np.diagonal(wide.covariances, axis1=1, axis2=2))
    assert (np.abs(found.states - wide.states) < 0.1 * sigma).all()


def test_a_model_file_that_states_no_noise_is_undone_for_a_folder(tmp_path: Path) -> None:
    """The noise then comes from the tracks, which are first undone themselves."""
    effects = parse_effects(["frame_tilt.y=0.04"])
    config = replace(CONFIG, tracks=6, undeclared=effects)
    write_simulation(tmp_path / "tilted", config)
    save_model(declared(*effects), tmp_path / "model.yaml")
    found = bf.estimate(tmp_path / "tilted", model=tmp_path / "model.yaml")
    for simulated in simulate(config):
        estimate = found[simulated.track.name]
        error = estimate.states - simulated.true_states
        assert np.abs(simulated.track.positions - simulated.true_states[:, POSITION]).max() > 0.03  # as measured
        for part, sigma in SIGMAS[:2]:
            assert np.sqrt((error[:, part] ** 2).mean()) < 2.0 * sigma
