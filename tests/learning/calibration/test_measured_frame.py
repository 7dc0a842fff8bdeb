"""A model that says how the camera's frame is tilted is calibrated as on tracks of an upright frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ballfg.dynamics import AnalyticModel, nominal_model
from ballfg.learning.calibration.calibrate import calibrate, fitted_noise
from ballfg.learning.calibration.problem import Problem, Step, population_model, population_settings, pose
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.simulation import MeasurementNoise, SimulationConfig, parse_effects, write_simulation
from ballfg.tracks import read_dataset

TILT = parse_effects(["frame_tilt.x=-0.03", "frame_tilt.y=0.04"])  # rad
CONFIG = SimulationConfig(tracks=16, rate=60.0, seed=11, noise=MeasurementNoise(position=0.002, spin=4.0))


def calibrated(folder: Path, config: SimulationConfig, model: AnalyticModel) -> tuple[Problem, Step]:
    write_simulation(folder, config)
    problem = pose(read_dataset(folder), model, CalibrationConfig())
    return problem, list(calibrate(problem))[-1]


def test_a_stated_tilt_of_the_frame_changes_nothing(tmp_path: Path) -> None:
    upright = nominal_model()
    tilted = AnalyticModel([*upright.flight.values(), *upright.bounce.values(), *TILT], radius=upright.radius)
    problem, expected = calibrated(tmp_path / "upright", CONFIG, upright)
    other, found = calibrated(tmp_path / "tilted", replace(CONFIG, undeclared=TILT), tilted)
    assert found.skipped == ()
    assert (np.abs(np.subtract(found.mean, expected.mean)) < 0.5 * np.array(expected.sigma)).all()
    np.testing.assert_allclose(found.sigma, expected.sigma, rtol=0.1)
    noises = [
        fitted_noise(one, population_model(one, last), population_settings(one, last), errors=False)
        for one, last in ((problem, expected), (other, found))
    ]
    plain, undone = (noise.noise for noise in noises if noise is not None)
    assert np.isclose(undone.contact_velocity, plain.contact_velocity, rtol=0.3)
    assert np.isclose(undone.coefficients["flight.drag.k"], plain.coefficients["flight.drag.k"], rtol=0.3)
