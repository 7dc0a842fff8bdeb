"""A tracker's memory as a finding: in the same shape as an effect, and part of the model's noise."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ballfg.diagnosis import diagnose
from ballfg.diagnosis.fit.holdout import hold_out
from ballfg.diagnosis.report.report import content
from ballfg.diagnosis.residual_tests.tracker_errors import look_at_tracker
from ballfg.diagnosis.result import Verdict
from ballfg.dynamics import EFFECTS, load_model, nominal_model
from ballfg.dynamics.model_file import model_to_dict
from ballfg.estimation import dataset_settings, dataset_surfaces, estimate_noise
from ballfg.simulation import MeasurementNoise, SimulationConfig, write_simulation
from ballfg.tracks import read_dataset

MEMORY, TIME, JITTER = 0.004, 0.012, 0.0015


@pytest.fixture(scope="module")
def diagnosis(tmp_path_factory):
    """Ten shots, seen by a tracker with a memory; few effects are looked for, to save time."""
    folder = tmp_path_factory.mktemp("tracker") / "shots"
    noise = MeasurementNoise(position=0.002, memory=MEMORY, memory_time=TIME)
    write_simulation(folder, SimulationConfig(tracks=10, rate=90.0, seed=12, noise=noise))
    dataset = read_dataset(folder)
    model = load_model(folder / "model.yaml", radius=dataset.ball.radius)
    return diagnose(dataset, model, catalogue=[EFFECTS["wind"]])


def test_memory_is_a_finding(diagnosis):
    (finding,) = diagnosis.findings
    assert (finding.name, finding.kind) == ("tracker_memory", "measurement")
    sigma, time = finding.parameters["sigma"], finding.parameters["time"]
    assert (sigma.unit, time.unit) == ("m", "s")
    assert sigma.value == pytest.approx(MEMORY, rel=0.15)
    assert time.value == pytest.approx(TIME, rel=0.25)
    assert finding.p_value < 1e-4
    assert finding.held_out_p < 0.05
    assert finding.held_out_gain > 0.0
    assert finding.delta_bic < 0.0


def test_what_is_left_is_noise(diagnosis):
    assert diagnosis.verdict is Verdict.FOUND
    assert "tracker_memory (sigma 0.00" in diagnosis.sentence
    assert diagnosis.unexplained.where == ""


def test_the_model_states_it(diagnosis):
    noise = model_to_dict(diagnosis.model)["measurement"]["noise"]
    np.testing.assert_allclose(noise["memory"], MEMORY, rtol=0.25)
    assert noise["memory_time"] == diagnosis.findings[0].parameters["time"].value


def test_errors_differ_by_effects_alone(diagnosis):
    """No effect was added, so that the declared model with the same tracker predicts alike."""
    assert diagnosis.before.nis == diagnosis.after.nis
    assert 0.8 < diagnosis.after.intervals_held < 0.97


def test_the_report_lists_it_among_the_effects(diagnosis):
    report = json.loads(json.dumps(content(diagnosis), allow_nan=False))
    assert [effect["name"] for effect in report["effects"]] == ["tracker_memory"]
    assert set(report["effects"][0]["parameters"]) == {"sigma", "time"}
    assert report["error"]["after"]["intervals_held"] == diagnosis.after.intervals_held


@pytest.fixture(scope="module")
def jittered(tmp_path_factory):
    """Thirty shots of a precise tracker whose stamps err by far more than its positions."""
    folder = tmp_path_factory.mktemp("stamps") / "shots"
    noise = MeasurementNoise(position=0.001, jitter=JITTER)
    write_simulation(folder, SimulationConfig(tracks=30, rate=90.0, seed=31, noise=noise))
    return read_dataset(folder)


def test_jitter_is_found_in_its_size_although_the_worst_stamps_look_like_outliers(jittered):
    model = nominal_model(jittered.ball.radius)
    found = look_at_tracker(model, hold_out(jittered, model))
    assert [finding.name for finding in found.findings] == ["stamp_jitter"]
    sigma = found.findings[0].parameters["sigma"]
    assert sigma.value == pytest.approx(JITTER, abs=3.0 * sigma.sigma)
    assert sigma.sigma < 0.05 * JITTER


def test_so_does_the_noise_of_forecasts(jittered):
    model = nominal_model(jittered.ball.radius)
    settings = dataset_settings(jittered, model)
    found = estimate_noise(model, dataset_surfaces(jittered), settings, jittered, position_known=True, errors=False)
    assert found.noise.stamp_jitter == pytest.approx(JITTER, rel=0.1)
